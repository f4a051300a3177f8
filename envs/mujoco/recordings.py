"""Recordings as a model's sensors would have made them.

Faults that the recording itself reveals are corrected and reported in one line: angles of encoders that wrap after a
turn (`angles`), orientations of another norm or order (`orientations`), and samples that only repeat the one before.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import angles, measured, orientations
from jaxlfi.envs.mujoco.columns import controls_of
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.plausible import beyond_radians, say, sensed
from jaxlfi.io.units import is_unit, parse

NEAR = 0.3
"""Angle in rad within which an orientation is taken for the one that the model begins in."""
WHOLE = 0.1
"""Tolerance in rad for a recording that begins whole turns away from the model."""
LEAST = 5
"""Smallest number of values in motion from which one can tell which samples of a signal are new."""
_MOVES = 5
"""Multiple of a signal's smallest step above which it moves, and cannot rest in between."""
_REGULAR = 0.9
"""Fraction of a signal's values in motion that last equally long where its sensor is slower than the recording."""


def prepared(model: mujoco.MjModel, log: Log, signals: Sequence[str], start: np.ndarray) -> Log:
    """A recording as the model's sensors would have made it.

    Args:
        model: with a sensor for each signal.
        log: of one episode.
        signals: that are measured.
        start: the state that the model begins in.
    """
    if any(name not in log.signals for name in signals):
        return log  # refused when a simulator is made of it
    log = _fresh(_named_units(model, log, signals), signals)
    where, first, changed = measured.places(model, signals), sensed(model, start), dict(log.signals)
    for name, place in zip(signals, where, strict=True):
        if measured.unit(model, name) == "rad":
            changed[name] = _continuous(log, name, float(first[place]), measured.joint_limits(model, name))
    for sensor, count in orientations.parts(model, where).items():
        say(f"{log.name}: {sensor}: {count} of 4 numbers are measured: they are not compared as a rotation")
    for sensor, columns in orientations.groups(model, where).items():
        names = [signals[column] for column in columns]
        rows = np.stack([log.signals[name] for name in names], axis=1)
        found = _rotations(f"{log.name}: {sensor}", rows, first[[where[column] for column in columns]])
        changed |= dict(zip(names, found.T, strict=True))
    for i, name in enumerate(controls_of(model)):
        if name in log.signals and name not in signals and measured.control_units(model, i) == ("rad",):
            beyond_radians(log, name)
    return dataclasses.replace(log, signals=changed)


def renamed(log: Log, known: Sequence[str]) -> Log:
    """A recording with a model's names for its signals where its own add a unit, such as arm_deg for a sensor arm.

    Args:
        log: a recording.
        known: names of the model's sensors and actuators.
    """
    called, units = {}, dict(log.units)
    for name in log.signals:
        base, _, suffix = name.rpartition("_")
        new = base and (base in known or measured.JOINT.fullmatch(base))
        if not new or name in {*known, *log.units} or base in log.signals:
            continue
        if len(suffix) > 1 and is_unit(suffix):  # a single letter may number motors
            called[name], units[base] = base, suffix
            say(f"{log.name}: {name}: read as {base} in {suffix}")
    if not called:
        return log
    return Log(log.times, {called.get(name, name): own for name, own in log.signals.items()}, log.name, units)


def _named_units(model: mujoco.MjModel, log: Log, signals: Sequence[str]) -> Log:
    """The recording with units that only its names state, such as arm_deg."""
    found = {}
    for name in signals:
        _, _, suffix = name.rpartition("_")
        if name in log.units or not is_unit(suffix) or parse(suffix).name != measured.unit(model, name):
            continue
        if suffix and parse(suffix).factor != 1:
            found[name] = suffix
            say(f"{log.name}: {name}: read in {suffix}, as its name says")
    return Log(log.times, log.signals, log.name, {**log.units, **found}) if found else log


def _fresh(log: Log, signals: Sequence[str]) -> Log:
    """The recording without samples that only repeat the one before, if a sensor is slower than the recording."""
    changed = dict(log.signals)
    said: dict[tuple[int, int, int], list[str]] = {}
    for name in signals:
        there = np.flatnonzero(np.isfinite(log.signals[name]))
        values = log.signals[name][there]
        stale, every = repeats(values)
        if not len(stale):
            continue
        if every > 1:
            changed[name] = log.signals[name].copy()
            changed[name][there[stale]] = np.nan
        said.setdefault((len(stale), len(values), every), []).append(name)
    for (count, total, every), names in said.items():
        then = f", a new one comes about every {every} rows: only new ones are compared" if every > 1 else " in motion"
        say(f"{log.name}: {', '.join(names)}: {count} of {total} samples repeat the one before{then}")
    return dataclasses.replace(log, signals=changed) if said else log


def repeats(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Samples that only repeat the one before although the signal moves, and the number of rows between new ones.

    A signal at rest repeats itself, too. Only values count, therefore, that differ from the one before and the one
    after by much more than the signal's resolution. If nearly all of them last equally long, the sensor is slower than
    the recording: a value that lasts longer is then new again after that many rows.

    Args:
        values: samples of a signal, shape [T].

    Returns:
        Their numbers, and the rows; 1 if repetitions are irregular.
    """
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    lengths, steps = np.diff(np.append(begins, len(values))), np.abs(np.diff(values[begins]))
    if len(steps) < LEAST:
        return np.zeros(0, int), 1
    large = steps > _MOVES * steps.min()
    moving = 1 + np.flatnonzero(large[:-1] & large[1:])
    # At its ends a signal may rest between two large steps, as a force of contact is 0 in between.
    inner = values[begins[moving]]
    moving = moving[(inner != values.min()) & (inner != values.max()) & (inner != 0)]
    if len(moving) < LEAST:
        return np.zeros(0, int), 1
    every = int(np.median(lengths[moving]))
    if every > 1 and np.mean(np.abs(lengths[moving] - every) <= 1) >= _REGULAR:
        new = np.concatenate([np.arange(b, b + n, every) for b, n in zip(begins, lengths, strict=True)])
        left = np.repeat(begins + lengths, -(-lengths // every)) - new
        keep = (left >= every) | np.isin(new, begins)  # a run of one more than usual ends with no new one
        return np.setdiff1d(np.arange(len(values)), new[keep]), every
    stale = np.concatenate([np.arange(begins[m] + 1, begins[m] + lengths[m]) for m in moving])
    return (stale if len(stale) >= max(LEAST, 0.01 * len(values)) else np.zeros(0, int)), 1


def _continuous(log: Log, name: str, start: float, limits: Sequence[float] | None) -> np.ndarray:
    """An angle without the jumps of its encoder, which begins in the same turn as the model."""
    times, recorded = log.samples(name)
    in_degrees = name not in log.units and np.abs(recorded).max() > 1.1 * angles.TURN
    found = angles.Unwrapped(recorded) if in_degrees else angles.unwrapped(times, recorded, start, limits)
    if not found.count and beyond_radians(log, name, limits):
        return log.signals[name]
    if not found.count and (count := angles.jumps(recorded)):
        jumps = f"jumps {_times(count)} by about {np.ptp(recorded):.3g} rad between two samples"
        say(f"{log.name}: {name}: {jumps}: left unchanged; if its encoder wraps there, unwrap it")
    values, turns = found.values, found.turns
    if not found.count and limits is None:
        turns = angles.whole_turns(start - values[0], WHOLE)
        values = values + turns * angles.TURN
    if not (found.count or turns):
        return log.signals[name]
    period = found.period or angles.TURN
    what = [f"wraps after {period:.4g} rad, {_times(found.count)}: made continuous"] if found.count else []
    if turns:
        done = "added" if turns > 0 else "taken off"
        what.append(f"{period:.4g} rad {done} {_times(abs(turns))}, as the model begins there")
    if found.ambiguous:
        what.append(f"up to {found.fastest:.2g} of that between two samples, which may have been the other way round")
    say(f"{log.name}: {name}: {'; '.join(what)}")
    changed = np.full(len(log.times), np.nan)
    changed[np.isfinite(log.signals[name])] = values
    return changed


def _rotations(where: str, rows: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Orientations of norm 1 in the order w, x, y, z, without changes of sign.

    Args:
        where: source of the rows, for messages.
        rows: shape [T, 4], NaN where there is no sample.
        start: the model's initial orientation.
    """
    there = np.isfinite(rows).all(axis=1)
    norms = np.linalg.norm(rows, axis=1)
    if lost := int(np.sum(there & (norms == 0))):
        say(f"{where}: {lost} of {there.sum()} orientations are 0: treated as missing")
        there &= norms > 0
    if not there.any():
        raise ValueError(f"{where}: expected rows with all four numbers of an orientation, got none")
    low, high = norms[there].min(), norms[there].max()
    if max(abs(low - 1), abs(high - 1)) > 0.01:
        say(f"{where}: orientations have norms of {low:.4g} to {high:.4g}: normalised to 1")
    first = rows[there][0]
    own, other = orientations.angle(first, start), orientations.angle(np.roll(first, 1), start)
    if other < NEAR and own < NEAR:
        if not np.allclose(rows[there], rows[there][:, :1]) and other < 2 * own + 0.01:
            say(f"{where}: read as w, x, y, z: it begins where x, y, z, w would be the same")
    elif other < NEAR:
        say(f"{where}: recorded as x, y, z, w: as w, x, y, z it would begin {own:.2g} rad from the model")
        rows = np.roll(rows, 1, axis=1)
    return orientations.continuous(rows, start)


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")
