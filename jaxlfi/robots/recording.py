"""A control episode as files: a recording that inference reads directly, and further files beside it.

| file | what |
|---|---|
| NAME.csv, .npz, .mcap, or the folder of a LeRobot data set | measured signals and controls, by name, with units |
| NAME.json | why it ended, timing, faults, limits, the robot's information about itself |
| NAME.loop.npz | actions of the policy, commands and observations, period by period |

Signals have the times at which they were measured, controls those at which they were given, in s since the first
command. Estimated signals are not measurements, and are only in NAME.loop.npz.
"""

import dataclasses
import importlib.util
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io import files, lerobot, mcap
from jaxlfi.io.rollout import Rollout, Signal
from jaxlfi.io.serialise import json_safe
from jaxlfi.robots.episode import Log

STATE, ACTION = "observation.state", "action"
SUFFIXES = (".csv", ".npz", ".mcap", "")
"""Suffixes of recordings; a LeRobot data set has none."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """Measured signals and given controls, sorted by time to the nanosecond; of several at one time the last counts.

    Attributes:
        times: times of the measurements, shape [N].
        signals: measured signals by name, shape [N] each.
        given: times of the controls, shape [S].
        controls: controls by name, shape [S] each.
        units: units of both; "" where they are not known.
    """

    times: np.ndarray
    signals: Mapping[str, np.ndarray]
    given: np.ndarray
    controls: Mapping[str, np.ndarray]
    units: Mapping[str, str]

    def __post_init__(self):
        for clock, columns in (("times", "signals"), ("given", "controls")):
            times, several = np.round(np.asarray(getattr(self, clock), float), 9), getattr(self, columns)
            own, last = np.unique(times[::-1], return_index=True)  # the first of each from the end
            rows = len(times) - 1 - last
            object.__setattr__(self, clock, own)
            object.__setattr__(self, columns, {name: np.asarray(values)[rows] for name, values in several.items()})


def require_new(path: Path) -> None:
    """Refuse a path that is not a new recording, before anything moves.

    Raises:
        ValueError: for another suffix, and files that exist.
        ImportError: without the package that writes such a file.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"out: expected a new NAME.csv, NAME.npz, NAME.mcap or folder without a suffix, got {path}")
    for one in (path, *beside(path)):
        if one.exists():
            raise ValueError(f"out: expected a new recording, got {one}, which exists")
    for suffix, package, kind in ((".mcap", "mcap", mcap), ("", "pyarrow", lerobot)):
        if path.suffix == suffix and importlib.util.find_spec(package) is None:
            raise ImportError(kind.INSTALL)


def beside(path: Path) -> tuple[Path, Path]:
    """The files beside a recording: NAME.json and NAME.loop.npz."""
    stem = path.stem if path.suffix else path.name
    return path.with_name(f"{stem}.json"), path.with_name(f"{stem}.loop.npz")


def is_ours(path: Path) -> bool:
    """Whether a recording was written by `write`, with the task's names and units, according to its report."""
    try:
        report = files.read_json(beside(path)[0])
    except ValueError:
        return False
    return isinstance(report, Mapping) and report.get("recording") == path.name


def write(path: Path, recording: Recording, log: Log, report: Mapping[str, Any], names: Sequence[str]) -> None:
    """Write the files of an episode; if nothing was measured, only the report and the loop.

    Args:
        path: a new recording.
        recording: measured signals and given controls.
        log: log of the episode.
        report: report of the episode.
        names: names of the numbers of an observation.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    report_file, loop_file = beside(path)
    kept = ("times", "observations", "asked", "actions", "targets", "held", "lateness")
    extras = {f"extras/{name}": value for name, value in log.extras.items()}
    arrays = {name: getattr(log, name) for name in kept} | {"signals": np.array(list(names))}
    files.write_arrays(loop_file, arrays | extras)
    if len(recording.times):
        _write(path, recording, report, 1 / log.period)
    files.write_json(report_file, {**report, "recording": path.name if len(recording.times) else None})


def _write(path: Path, recording: Recording, report: Mapping[str, Any], rate: float) -> None:
    if path.suffix == ".csv":
        files.write_bytes(path, _table(recording).encode())
    elif path.suffix == ".npz":
        times, columns = merged(recording)
        files.write_arrays(
            path, {"times [s]": times} | {_heading(recording, name): one for name, one in columns.items()}
        )
    elif path.suffix == ".mcap":
        mcap.write(path, rollout(recording, report))
    else:
        fps = round(float(1 / np.median(np.diff(recording.times))), 6) if len(recording.times) > 1 else rate
        lerobot.write(path, [rollout(recording, report)], STATE, fps)


def timing(log: Log) -> dict[str, Any]:
    """Timing of the loop: measured periods, lateness and missed deadlines; times in s, None where there are none.

    The age is the median age of measurements when the commands made from them were sent.
    """
    sent = np.isfinite(log.lateness)
    moments = np.arange(len(log.lateness))[sent] * log.period + log.lateness[sent]
    late = log.lateness[sent]
    # Of successive slots only: missed ones are counted separately.
    periods = np.diff(moments)[np.diff(np.flatnonzero(sent)) == 1]
    of = lambda values, function: float(function(values)) if len(values) else None
    return {
        "period": log.period,
        "measured_period": of(periods, np.mean),
        "jitter": of(periods, np.std),
        "lateness": {f"{q}": of(late, lambda values, q=q: np.quantile(values, q / 100)) for q in (50, 95, 99, 100)},
        "age": of(log.ages[np.isfinite(log.ages)], np.median),
        "missed": log.missed,
        "skipped": int(np.sum(~sent)),
        "held": int(log.held.sum()),
    }


def timing_line(log: Log) -> str:
    """The timing of the loop in words."""
    found = timing(log)
    if found["measured_period"] is None:
        return "one control" if len(log.targets) else "no control"
    late = {name: 1e3 * value for name, value in found["lateness"].items()}
    return (
        f"{len(log.targets)} controls at {1 / log.period:g} Hz: a period of {1e3 * found['measured_period']:.4g} ms "
        f"(standard deviation {1e3 * found['jitter']:.2g} ms); late by {late['50']:.2g} ms in the median, "
        f"{late['95']:.2g} ms at 95 %, {late['100']:.2g} ms at most; {found['missed']} deadlines missed, "
        f"{found['held']} periods without a usable observation"
    )


def merged(recording: Recording) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All columns at all times, NaN where there is no sample."""
    times = np.unique(np.concatenate([recording.times, recording.given]))
    columns = {}
    for own, several in ((recording.given, recording.controls), (recording.times, recording.signals)):
        rows = np.searchsorted(times, own)
        for name, values in several.items():
            columns[name] = np.full(len(times), np.nan)
            columns[name][rows] = values
    return times, {name: column for name, column in columns.items() if np.isfinite(column).any()}


def rollout(recording: Recording, report: Mapping[str, Any]) -> Rollout:
    """A recording for the formats of robotics, in which signals and controls have times of their own."""
    signals = {}
    for topic, times, several in (
        (STATE, recording.times, recording.signals),
        (ACTION, recording.given, recording.controls),
    ):
        if several and len(times):
            units = tuple(recording.units[name] for name in several)
            signals[topic] = Signal(times, np.stack(list(several.values()), axis=1), tuple(several), units)
    return Rollout(signals, json_safe(dict(report)), str(report.get("environment", "")))


def _heading(recording: Recording, name: str) -> str:
    return f"{name} [{recording.units[name]}]" if recording.units[name] else name


def _table(recording: Recording) -> str:
    times, columns = merged(recording)
    lines = [",".join(["time [s]", *(_heading(recording, name) for name in columns)])]
    for row in zip(times, *columns.values(), strict=True):
        lines.append(",".join("" if math.isnan(value) else repr(float(value)) for value in row))
    return "\n".join(lines) + "\n"
