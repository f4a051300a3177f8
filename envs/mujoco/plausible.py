"""What of a recording cannot be right, which is refused, and what looks wrong, which is said in one line."""

import warnings
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import angles, measured, orientations
from jaxlfi.envs.mujoco.effects import STATE
from jaxlfi.envs.mujoco.logs import TIME, Log, RecordingWarning
from jaxlfi.io.units import looks_like, parse

SLOWEST, LONGEST = 100, 0.5
"""Steps of the model, and seconds, between two rows beyond which times without a unit are not taken for seconds."""
FASTEST = 5
"""Rows within a step of the model from which on times look wrong."""
FAR = 6.0
"""Standard deviations of the noise from which on a recording begins elsewhere than the model."""
NOISELESS = 1e-3
"""Standard deviation, as a fraction of the signal's own, that stands for the noise of a signal that has none."""


def check(model: mujoco.MjModel, log: Log, signals: Sequence[str]) -> None:
    """Check units and times of a recording.

    Raises:
        ValueError: for units that the model's sensors and actuators cannot have, and times that are no seconds, in one
            line.
    """
    for name in signals:
        if (own := measured.unit(model, name)) and log.units.get(name, own) != own:
            raise ValueError(f"{log.name}: {name}: expected {own} as the sensor, got {log.units[name]}")
    for i in range(model.nu):
        name = model.actuator(i).name
        expected, given = measured.control_units(model, i), log.units.get(name, "")
        if name not in signals and given and expected and given not in expected:
            raise ValueError(f"{log.name}: {name}: expected {' or '.join(expected)} as the actuator, got {given}")
    _check_times(log, model.opt.timestep)


def beyond_radians(model: mujoco.MjModel, log: Log, name: str) -> bool:
    """Whether an angle without a unit is beyond a turn, or far beyond the joint's limits; that is said."""
    values, limits = log.samples(name)[1], measured.joint_limits(model, name)
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
    """Say where a recording begins elsewhere than the model.

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
        deviation = _deviation(log, name, noises)
        # What depends on parameters may begin somewhat further than at the few that were tried.
        if max(low - first, first - high) > FAR * deviation + (high - low):
            own = f" {unit}" if (unit := measured.unit(model, name)) else ""
            there = f"{low:.4g}" if high - low <= 1e-6 * abs(high) else f"{low:.4g} to {high:.4g}"
            off = max(low - first, first - high) / deviation if deviation else np.inf
            say(
                f"{log.name}: {name}: the recording begins at {first:.4g}{own}, the model at {there}{own}: "
                f"{off:.3g} standard deviations of the noise apart"
            )
    for sensor, columns in oriented.items():
        names = [signals[column] for column in columns]
        first = [begins[name] for name in names]
        if None in first:
            continue
        off = [orientations.angle(np.array(first), own[[where[c] for c in columns]]) for own in values]
        deviation = 2 * float(np.mean([_deviation(log, name, noises) for name in names]))
        if min(off) > FAR * deviation + np.ptp(off):
            apart = min(off) / deviation if deviation else np.inf
            say(
                f"{log.name}: {sensor}: the recording begins {min(off):.3g} rad from the orientation that the model "
                f"begins in: {apart:.3g} standard deviations of the noise"
            )


def sensed(model: mujoco.MjModel, state: np.ndarray) -> np.ndarray:
    """What the sensors of a model measure in a state (`effects.STATE`)."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, STATE)
    mujoco.mj_forward(model, data)
    return data.sensordata.copy()


def say(text: str) -> None:
    """Warn of a recording, in one line."""
    warnings.warn(text, RecordingWarning, stacklevel=2)


def _check_times(log: Log, step: float) -> None:
    between = float(np.median(np.diff(log.times)))
    looks = looks_like(between, min(max(between, 5 * step), 0.1))
    other = f"in {looks} they would be {parse(looks).factor * between:.3g} s apart"
    if between > max(SLOWEST * step, LONGEST):
        text = f"{log.name}: expected times in s, got rows {between:.6g} apart, {between / step:.3g} steps of the model"
        if TIME not in log.units:
            raise ValueError(f"{text}: {other}; name their unit, as 'time [{looks}]' or 'time [s]'")
        if looks != "s":
            say(f"{text}: {other}")
    elif FASTEST * between < step:
        looks = looks_like(between, step)
        other = f": in {looks} they would be {parse(looks).factor * between:.3g} s apart" if looks != "s" else ""
        say(f"{log.name}: rows are {between:.3g} s apart, {step / between:.3g} of them in a step of the model{other}")


def _beginning(log: Log, name: str, step: float) -> float | None:
    """The first sample of a signal; None where it is later than the model's first step."""
    times, values = log.samples(name)
    return float(values[0]) if len(times) and times[0] <= step else None


def _deviation(log: Log, name: str, noises: Mapping[str, float]) -> float:
    return max(noises[name], NOISELESS * float(np.std(log.samples(name)[1])))
