"""The signals of a recording, their counterparts in a model, and anomalies.

A recording is processed as in a task: it is renamed, converted, checked and corrected. The warnings of these steps are
its anomalies (`recordings`, `plausible`, `columns`). What a task would refuse is reported as well, and skipped.
"""

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from types import MappingProxyType

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import angles, columns, logs, matching, measured, noise, plausible, recordings, signs
from jaxlfi.envs.mujoco.effects import initial_state
from jaxlfi.envs.mujoco.log_files import TIME, Recorded
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.matching import Place
from jaxlfi.envs.mujoco.renaming import Called, renamed
from jaxlfi.io import clocks
from jaxlfi.io.units import is_unit, parse

GAP = 2.5
"""Multiple of a signal's median interval above which an interval is a gap."""
RUN, OFTEN = 5, 0.02
"""Consecutive samples at the end of a signal's range, and a fraction of all, from which on it may be saturated."""
TURNS = 3.0
"""Turns above which an angle without a unit is read in degrees."""


@dataclasses.dataclass(frozen=True)
class Signal:
    """A signal of a recording.

    Attributes:
        name: in the recording.
        unit: of the numbers as a task reads them, "" if unknown.
        place: its counterpart in the model; None if unknown.
        nearest: the most similar names in the model, if it has no counterpart.
        called: its entry for the table `signals` of a task's file; None if it needs none.
        samples: number of samples.
        rate: in Hz, by the median interval; NaN for fewer than two samples.
        gaps: number of much longer intervals.
        longest: longest interval, in s.
        low: its smallest value.
        high: its largest value.
        noise: the estimated standard deviation of its noise; None where it cannot be estimated.
        odd: its anomalies, a line each.
    """

    name: str
    unit: str
    place: Place | None
    nearest: tuple[str, ...]
    called: Called | None
    samples: int
    rate: float
    gaps: int
    longest: float
    low: float
    high: float
    noise: float | None
    odd: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Inspected:
    """A recording.

    Attributes:
        name: of its file.
        rows: number of rows.
        duration: in s.
        signals: by their names in the recording.
        odd: anomalies of the whole recording, a line each.
        time: the entry of times for the table `signals`; None if they need none.
        usable: whether a task can read it with that table.
        log: as a task reads it, without what it would refuse; its signals have the model's names.
        measured: the signals of the log that the model's sensors can be compared with.
        opposite: signals and controls of which one seems to have the opposite sign.
    """

    name: str
    rows: int
    duration: float
    signals: Mapping[str, Signal]
    odd: tuple[str, ...]
    time: Called | None
    usable: bool
    log: Log
    measured: tuple[str, ...]
    opposite: tuple[str, ...] = ()


def sensing(spec: mujoco.MjSpec) -> Callable[[tuple[str, ...]], mujoco.MjModel]:
    """The function that makes a model with a sensor for each of some signals; it caches models."""

    @functools.cache
    def made(compared: tuple[str, ...]) -> mujoco.MjModel:
        own = spec.copy()
        measured.add_sensors(own, compared)
        return own.compile()

    return made


def inspect_all(spec: mujoco.MjSpec, model: mujoco.MjModel, several: Sequence[Recorded]) -> list[Inspected]:
    """Inspect recordings of one machine: a unit or a sign that one of them reveals applies to all.

    Args:
        spec: of the model.
        model: as compiled.
        several: recordings as stored in their files.

    Raises:
        ValueError: if nothing of a recording can be read, in one line.
    """
    of_signals = sensing(spec)
    found = [inspect(of_signals, model, one) for one in several]
    units = {
        name: own.unit for one in found for name, signal in one.signals.items() if (own := signal.called) and own.unit
    }
    turned = frozenset(name for one in found for name, own in _of_signals(one) if own and own.scale < 0)
    return [
        inspect(of_signals, model, raw, units, turned)
        if any(
            (name in units and (own is None or not own.unit)) or (name in turned and (own is None or own.scale > 0))
            for name, own in _of_signals(one)
        )
        else one
        for raw, one in zip(several, found, strict=True)
    ]


def _of_signals(one: Inspected) -> Iterator[tuple[str, Called | None]]:
    return ((name, signal.called) for name, signal in one.signals.items())


def inspect(
    of_signals: Callable[[tuple[str, ...]], mujoco.MjModel],
    model: mujoco.MjModel,
    raw: Recorded,
    units: Mapping[str, str] = MappingProxyType({}),
    turned: Set[str] = frozenset(),
) -> Inspected:
    """Inspect a recording.

    Args:
        of_signals: makes the model with a sensor for each of some signals (`sensing`).
        model: as compiled.
        raw: the recording as stored in its file.
        units: of signals for which the recording has none.
        turned: signals and controls whose sign is opposite to the model's, unless jaxlfi recorded it.

    Raises:
        ValueError: where nothing of it can be read, in one line.
    """
    turned = frozenset() if raw.by_us else turned
    ordered = raw.in_order()
    odd, own = list(ordered.faults), dict[str, list[str]]()
    kept, refused = _readable(ordered)
    for name, text in refused.items():
        own.setdefault(name, []).append(text)
    with _caught() as said:
        places = matching.places(model, {name: _si(kept.units[name]) for name in kept.signals}, raw.name)
        log, places, called = _read(of_signals, model, kept, places, units, turned, own, odd)
        names = {(place.name if (place := places[name]) else name): name for name in kept.signals}
        control = columns.controls_of(model)
        compared = tuple(one.name for one in places.values() if one and one.name not in control)
        sensors = of_signals(compared)
        log = _as_task(sensors, log, compared, odd)
    _attribute(said, raw.name, names, own, odd)
    noises = {name: _noise(log.signals[new]) for new, name in names.items()}
    start = plausible.sensed(sensors, initial_state(sensors, {}))
    known = {new: value for new, name in names.items() if (value := noises[name]) is not None}
    with _caught() as said:
        plausible.check_start(sensors, log, [one for one in compared if one in known], known, [start])
    _attribute(said, raw.name, names, own, odd)
    opposite = tuple(names[one] for one in signs.other(sensors, log, compared))
    if len(opposite) == 1 and not raw.by_us and opposite[0] not in turned:
        return _turned(inspect(of_signals, model, raw, units, turned | {*opposite}), *opposite)
    _say_signs(opposite, raw.by_us, own, odd)
    signals = {}
    for name in raw.signals:
        place, new = places.get(name), next((new for new, old in names.items() if old == name), name)
        if name not in kept.signals:
            signals[name] = _unread(name, tuple(own[name]))
            continue
        times, values = log.samples(new)
        texts = [*own.get(name, []), *_peculiar(raw.signals[name], values)]
        near = () if place else tuple(matching.nearest(model, name))
        unit = log.units.get(new, "") or (_unit(sensors, place) if place else "")
        signals[name] = Signal(
            *(name, unit, place, near, called.get(name), len(values), *_intervals(times)),
            *(float(values.min()), float(values.max()), noises[name], tuple(dict.fromkeys(texts))),
        )
    return Inspected(
        *(raw.name, len(raw.times), float(log.times[-1]), signals, tuple(dict.fromkeys(odd)), called.get(TIME)),
        *(not ordered.faults, log, compared, opposite),
    )


OPPOSITE = (
    f"seems to have the opposite sign: over the first {signs.DURATION:g} s the model moves against the recording, and "
    "with it if that is changed"
)


def _turned(found: Inspected, name: str) -> Inspected:
    """An inspected recording in which a signal's sign was changed, with a line that says so."""
    signal = found.signals[name]
    odd = (*signal.odd, f"{OPPOSITE}: changed, by scale = -1 in [signals]")
    return dataclasses.replace(found, signals={**found.signals, name: dataclasses.replace(signal, odd=odd)})


def _say_signs(several: Sequence[str], by_us: bool, own: dict[str, list[str]], odd: list[str]) -> None:
    """Report the signal whose sign seems to be wrong, or the signals of which one seems to have the wrong sign."""
    text = f"{OPPOSITE}; as jaxlfi recorded it, change it in [robot.names]" if by_us else OPPOSITE
    if len(several) == 1:
        own.setdefault(several[0], []).append(text)
    elif several:
        odd.append(f"one of {', '.join(several)} {text}")


def _readable(raw: Recorded) -> tuple[Recorded, dict[str, str]]:
    """A recording without the signals that cannot be read, and why they cannot."""
    refused, units = {}, dict(raw.units)
    for name, values in raw.signals.items():
        samples = np.asarray(values, float)
        if np.isnan(samples).all():
            refused[name] = "has no samples"
        elif np.isinf(samples).any():
            rows = np.flatnonzero(np.isinf(samples))
            refused[name] = f"is infinite in {clocks.listed(rows)}"
        elif not is_unit(units.get(name, "")):
            refused[name] = f"is in {units[name]!r}, which is not a known unit: give one in [signals]"
    signals = {name: values for name, values in raw.signals.items() if name not in refused}
    units = {name: unit for name, unit in units.items() if name not in refused}
    if not signals:
        raise ValueError(f"{raw.name}: expected signals with finite samples, got none")
    return dataclasses.replace(raw, signals=signals, units=units, faults=()), refused


def _read(
    of_signals: Callable[[tuple[str, ...]], mujoco.MjModel],
    model: mujoco.MjModel,
    raw: Recorded,
    places: dict[str, Place | None],
    units: Mapping[str, str],
    turned: Set[str],
    own: dict[str, list[str]],
    odd: list[str],
) -> tuple[Log, dict[str, Place | None], dict[str, Called]]:
    """A recording with the model's names and units, the counterparts of its signals, and their entries for the file."""
    control = columns.controls_of(model)
    sensors = of_signals(tuple(place.name for place in places.values() if place and place.name not in control))
    called: dict[str, Called] = {}
    for name, place in list(places.items()):
        if place is None:
            continue
        expected = _units(sensors, place)
        given = raw.units.get(name, "") or place.unit
        if expected and given and parse(given).name not in expected:
            own.setdefault(name, []).append(
                f"is in {given}, and {place.what} in {' or '.join(expected)}: not taken for it"
            )
            places[name] = None
            continue
        unit = units.get(name) if not given else None
        if not given and not unit and _in_degrees(sensors, place, np.asarray(raw.signals[name], float)):
            unit = "deg"
            own.setdefault(name, []).append(_degrees(np.asarray(raw.signals[name], float)))
        one = Called(None if place.sure else place.name, unit, scale=-1.0 if name in turned else 1.0)
        if one != Called():
            called[name] = one
    if (looks := _time_unit(model, raw)) is not None:
        called[TIME] = Called(None, looks)
        odd.append(f"times have no unit and look like {looks}: read so, unless [signals] says another")
    (new,) = renamed([raw], called)
    return logs.log_of(new), places, called


def _as_task(sensors: mujoco.MjModel, log: Log, compared: Sequence[str], odd: list[str]) -> Log:
    """A recording as a task reads it; what the task would refuse is added to the anomalies."""
    named = [
        [one(i).name for i in range(n)]
        for one, n in ((sensors.actuator, sensors.nu), (sensors.sensor, sensors.nsensor))
    ]
    log = recordings.renamed(log, [*named[1], *named[0]])
    log = columns.arranged(log, named[0], named[1])
    try:
        plausible.check(sensors, log, compared)
    except ValueError as error:
        odd.append(str(error).removeprefix(f"{log.name}: "))
    columns.warn_of_clamped(log, sensors)
    if missing := [name for name in columns.controls_of(sensors) if name not in log.signals]:
        odd.append(f"has no control of {', '.join(missing)}")
    return recordings.prepared(sensors, log, compared, initial_state(sensors, {}))


def _units(sensors: mujoco.MjModel, place: Place) -> tuple[str, ...]:
    """The units that a number of the model may have; none if the model does not say."""
    controls = columns.controls_of(sensors)
    if place.name in controls:
        return measured.control_units(sensors, controls.index(place.name))
    unit = measured.unit(sensors, place.name)
    return (unit,) if unit else ()


def _unit(sensors: mujoco.MjModel, place: Place) -> str:
    units = _units(sensors, place)
    return units[0] if len(units) == 1 else ""


def _in_degrees(sensors: mujoco.MjModel, place: Place, values: np.ndarray) -> bool:
    """Whether an angle that has no unit is far beyond what it could be in rad, and could be in degrees."""
    if _units(sensors, place) != ("rad",):
        return False
    reach = float(np.nanmax(np.abs(values)))
    if reach > TURNS * angles.TURN:
        return True
    controls = columns.controls_of(sensors)
    if place.name in controls:
        actuator = controls.index(place.name)
        limits = sensors.actuator_ctrlrange[actuator] if sensors.actuator_ctrllimited[actuator] else None
    else:
        limits = measured.joint_limits(sensors, place.name)
    if limits is None:
        return False
    farthest = 1.2 * float(np.max(np.abs(limits)))
    return reach > max(farthest, angles.TURN / 2) and np.radians(reach) <= farthest


def _degrees(values: np.ndarray) -> str:
    low, high = np.nanmin(values), np.nanmax(values)
    return f"looks like degrees, from {low:.4g} to {high:.4g} without a unit: read so, unless [signals] says another"


def _time_unit(model: mujoco.MjModel, raw: Recorded) -> str | None:
    """The likely unit of times without one, if they cannot be seconds."""
    if raw.units.get(TIME) or np.asarray(raw.times).dtype.kind == "M" or TIME in raw.signals:
        return None
    with _caught():
        log = logs.log_of(dataclasses.replace(raw, signals={}))
    return None if TIME in log.units else plausible.unit_of_times(log, model.opt.timestep)


def _unread(name: str, odd: tuple[str, ...]) -> Signal:
    nan = float("nan")
    return Signal(name, "", None, (), Called(read=False), 0, nan, 0, nan, nan, nan, None, odd)


def _intervals(times: np.ndarray) -> tuple[float, int, float]:
    """The rate of samples in Hz, the number of gaps, and the longest interval in s."""
    steps = np.diff(times)
    if not len(steps):
        return float("nan"), 0, float("nan")
    usual = float(np.median(steps))
    return 1 / usual, int(np.sum(steps > GAP * usual)), float(steps.max())


def _noise(values: np.ndarray) -> float | None:
    """The standard deviation of a signal's noise, at least its resolution's; None where it cannot be estimated."""
    values = values[np.isfinite(values)]
    steps = np.abs(np.diff(values))
    if len(values) < noise.LEAST or not steps.any():
        return None
    return max(noise.standard_deviation(values), float(steps[steps > 0].min()) / np.sqrt(12))


def _peculiar(recorded: np.ndarray, values: np.ndarray) -> Iterator[str]:
    """The anomalies of a signal in itself.

    Args:
        recorded: as stored in its file, shape [T].
        values: as a task reads them, without missing ones.
    """
    low, high = float(values.min()), float(values.max())
    if low == high:
        yield f"is constant, {low:.6g}"
        return
    for end, what in ((high, "largest"), (low, "smallest")):
        at = values == end
        edges = np.flatnonzero(np.diff(np.concatenate([[0], at.astype(int), [0]])))
        longest = int((edges[1::2] - edges[::2]).max(initial=0))
        if end and longest >= RUN and at.mean() >= OFTEN and len(np.unique(values)) > 2 * RUN:
            yield f"is at its {what} value, {end:.6g}, in {at.sum()} of {len(at)} samples: saturated, or at rest there"
    missing = np.flatnonzero(np.isnan(np.asarray(recorded, float)))
    if len(missing) and not _regular(np.asarray(recorded, float)):
        yield f"has no sample in {len(missing)} of {len(recorded)} rows, the first in {clocks.listed(missing[:1])}"


def _regular(recorded: np.ndarray) -> bool:
    """Whether samples are missing because of a slower clock, which has one only every few rows."""
    steps = np.diff(np.flatnonzero(np.isfinite(recorded)))
    return bool(len(steps) and np.median(steps) > 1)


@contextlib.contextmanager
def _caught() -> Iterator[list[warnings.WarningMessage]]:
    """Collect all warnings in a list."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        yield said


def _attribute(
    said: Sequence[warnings.WarningMessage],
    where: str,
    names: Mapping[str, str],
    own: dict[str, list[str]],
    odd: list[str],
) -> None:
    """Assign warnings to the signals that they are about, or to the whole recording."""
    for warning in said:
        text = str(warning.message).removeprefix(f"{where}: ")
        head, colon, rest = text.partition(": ")
        several = [names[new] for new in _listed(head, names)] if colon else []
        for name in several:
            own.setdefault(name, []).append(rest)
        if not several:
            odd.append(text)


def _listed(head: str, names: Mapping[str, str]) -> list[str]:
    """The signals that the beginning of a line lists: one, several, or a sensor of several numbers."""
    if head in names:
        return [head]
    parts = head.split(", ")
    if all(part in names for part in parts):
        return parts
    return [new for new in names if (match := columns.INDEXED.fullmatch(new)) and match["sensor"] == head]


def together(several: Sequence[Inspected]) -> dict[str, Signal]:
    """The signals of all recordings, combined by name."""
    found: dict[str, Signal] = {}
    for one in several:
        for name, signal in one.signals.items():
            found[name] = _joined(found[name], signal) if name in found else signal
    return found


def _joined(first: Signal, other: Signal) -> Signal:
    if not (first.samples and other.samples):
        kept = first if first.samples else other
        return dataclasses.replace(kept, odd=(*first.odd, *other.odd))
    return dataclasses.replace(
        first,
        samples=first.samples + other.samples,
        rate=float(np.nanmin([first.rate, other.rate])),
        gaps=first.gaps + other.gaps,
        longest=max(first.longest, other.longest),
        low=min(first.low, other.low),
        high=max(first.high, other.high),
        noise=first.noise if first.noise is not None else other.noise,
        odd=(*first.odd, *other.odd),
    )


def _si(unit: str) -> str:
    return parse(unit).name
