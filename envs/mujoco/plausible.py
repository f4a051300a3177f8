"""Refuses what cannot be right in a recording, and reports what looks wrong in one line."""

import warnings
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import angles, measured, orientations
from jaxlfi.envs.mujoco.columns import controls_of
from jaxlfi.envs.mujoco.effects import STATE
from jaxlfi.envs.mujoco.logs import TIME, Log, RecordingWarning
from jaxlfi.io.units import looks_like, parse

SLOWEST, LONGEST = 40, 0.4
"""Distance of rows, in steps of the model and in s, above which times without a unit are not taken for seconds."""
FASTEST = 5
"""Rows within a step of the model above which times look wrong."""
FAR = 6.0
"""Standard deviations of the noise above which a recording begins elsewhere than the model."""
LEAST = 1e-3
"""Fraction of a signal's standard deviation below which it does not begin elsewhere, however small the noise."""


def check(model: mujoco.MjModel, log: Log, signals: Sequence[str]) -> None:
    """Check units and times of a recording.

    Raises:
        ValueError: for units that the model's sensors and actuators cannot have, and times that are not seconds, in one
            line.
    """
    for name in signals:
        if (own := measured.unit(model, name)) and log.units.get(name, own) != own:
            raise ValueError(f"{log.name}: {name}: expected {own} as the sensor, got {log.units[name]}")
    for i, name in enumerate(controls_of(model)):
        expected, given = measured.control_units(model, i), log.units.get(name, "")
        if name not in signals and given and expected and given not in expected:
            raise ValueError(f"{log.name}: {name}: expected {' or '.join(expected)} as the actuator, got {given}")
    _check_times(log, model.opt.timestep)


def beyond_radians(log: Log, name: str, limits: Sequence[float] | None = None) -> bool:
    """Whether an angle without a unit is beyond a turn, or far beyond the joint's limits; reports it."""
    values = log.samples(name)[1]
    beyond = np.abs(values).max() > angles.TURN
    if limits is not None and (reach := limits[1] - limits[0]) < angles.TURN:
        beyond |= np.abs(values - np.mean(limits)).max() > max(reach, angles.TURN / 2)
    if name in log.units or not beyond:
        return False
    low, high = values.min(), values.max()
    say(
        f"{log.name}: {name}: no unit, read in rad from {low:.4g} to {high:.4g}; if these are degrees, that is "
        f"{np.radians(low):.4g} to {np.radians(high):.4g} rad: say which, as '{name} [deg]' or '{name} [rad]'"
    )
    return True


def check_start(
    model: mujoco.MjModel,
    log: Log,
    signals: Sequence[str],
    noises: Mapping[str, float],
    starts: Sequence[np.ndarray],
) -> None:
    """Warn where a recording begins elsewhere than the model.

    Only positions and velocities are compared, as accelerations and forces depend on what is inferred.

    Args:
        model: with a sensor for each signal.
        log: of one episode.
        signals: that are compared.
        noises: their standard deviations.
        starts: what the model's sensors may measure at the beginning (`sensed`), at several parameter vectors.
    """
    where, values = measured.places(model, signals), np.array(starts)
    begins = {name: _beginning(log, name, model.opt.timestep) for name in signals}
    oriented = orientations.groups(model, where)
    turned = {column for columns in oriented.values() for column in columns}
    for number, (name, first) in enumerate(begins.items()):
        if number in turned or first is None or not measured.kinematic(model, name):
            continue
        low, high = values[:, where[number]].min(), values[:, where[number]].max()
        off, spread = max(low - first, first - high), float(np.std(log.samples(name)[1]))
        # What depends on parameters may start somewhat outside the range of the few that were tried.
        if off > max(FAR * noises[name], LEAST * spread) + (high - low):
            own = f" {unit}" if (unit := measured.unit(model, name)) else ""
            there = f"{low:.4g}" if high - low <= 1e-6 * abs(high) else f"{low:.4g} to {high:.4g}"
            say(
                f"{log.name}: {name}: the recording begins at {first:.4g}{own}, the model at {there}{own}"
                f"{_in_noises(off, noises[name])}"
            )
    for sensor, columns in oriented.items():
        names = [signals[column] for column in columns]
        begun = [begins[name] for name in names]
        if None in begun:
            continue
        off = [orientations.angle(np.array(begun), own[[where[c] for c in columns]]) for own in values]
        noise = 2 * float(np.mean([noises[name] for name in names]))  # an angle is twice that of its quaternions
        if min(off) > max(FAR * noise, LEAST) + np.ptp(off):
            say(
                f"{log.name}: {sensor}: the recording begins {min(off):.3g} rad from the orientation of the model"
                f"{_in_noises(min(off), noise)}"
            )


def sensed(model: mujoco.MjModel, state: np.ndarray) -> np.ndarray:
    """What the sensors of a model measure in a state (`effects.STATE`)."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, STATE)
    mujoco.mj_forward(model, data)
    return data.sensordata.copy()


def say(text: str) -> None:
    """Issue a one-line warning about a recording."""
    warnings.warn(text, RecordingWarning, stacklevel=2)


def unit_of_times(log: Log, step: float) -> str | None:
    """The likely unit of times that are too far apart to be in s; None if they are not.

    Args:
        log: whose times are taken for s.
        step: of the model, in s.
    """
    between = _between(log)
    if between < max(SLOWEST * step, LONGEST):
        return None
    return looks_like(between, min(5 * step, LONGEST), ("ms", "us", "ns"))


def _between(log: Log) -> float:
    return float(log.times[-1]) / (len(log.times) - 1)


def _check_times(log: Log, step: float) -> None:
    between = _between(log)
    if looks := unit_of_times(log, step):
        text = f"{log.name}: expected times in s, got rows {between:.6g} apart, {between / step:.3g} steps of the model"
        other = f"in {looks} they would be {parse(looks).factor * between:.3g} s apart"
        if TIME not in log.units:
            raise ValueError(f"{text}: {other}; give them in s, or with their unit, as 'time [{looks}]' or 'time [s]'")
        say(f"{text}: {other}")
    elif FASTEST * between < step:
        looks = looks_like(between, 5 * step)
        other = f": in {looks} they would be {parse(looks).factor * between:.3g} s apart" * (looks != "s")
        say(f"{log.name}: rows are {between:.3g} s apart, {step / between:.3g} of them in a step of the model{other}")


def _beginning(log: Log, name: str, step: float) -> float | None:
    """The first sample of a signal; None where it is later than the model's first step."""
    times, values = log.samples(name)
    return float(values[0]) if len(times) and times[0] <= step else None


def _in_noises(off: float, noise: float) -> str:
    return f": {off / noise:.3g} standard deviations of the noise apart" if noise else ""
