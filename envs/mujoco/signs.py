"""Signs of a recording: an axis or an actuator whose sign is opposite to the model's.

The model is simulated under the recorded controls, from where the recording begins. Its parameters are only guesses,
but rarely so wrong that it moves against the recording. Where it does, changing a single sign may make both agree.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco import measured, starts
from jaxlfi.envs.mujoco.columns import controls_of
from jaxlfi.envs.mujoco.effects import Effects
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.simulator import Simulator

DURATION = 2.0
"""Seconds that are compared, from the beginning: later the parameters matter more."""
AGAINST, WITH = -0.3, 0.6
"""Correlations below which a signal moves against the model's, and above which both move together."""
LEAST = 0.01
"""Fraction of the larger of the simulated and the recorded motion below which the other one does not count."""
_AXES = tuple(
    getattr(mujoco.mjtSensor, f"mjSENS_{of}{what}") for of in ("JOINT", "TENDON", "ACTUATOR") for what in ("POS", "VEL")
)
"""Sensors along an axis, which has a sign."""


def other(model: mujoco.MjModel, log: Log, signals: Sequence[str]) -> list[str]:
    """Signals and controls whose sign, if only one is changed, makes the model move as the recording does.

    Args:
        model: with a sensor for each signal.
        log: as a task reads it.
        signals: that are compared.

    Returns:
        None of them if the model does not move against the recording, or no single sign explains it.
    """
    controls = controls_of(model)
    if not signals or any(name not in log.signals for name in controls):
        return []
    short = dataclasses.replace(log, **_until(log, DURATION))
    now = _together(model, short, signals)
    if not np.isfinite(now).any() or np.nanmin(now) > AGAINST:
        return []
    turned = [name for name in signals if measured.of_sensor(model, name)[0] in _AXES]
    found = []
    for name in (*controls, *turned):
        flipped = dataclasses.replace(short, signals={**short.signals, name: -np.asarray(short.signals[name])})
        then = _together(model, flipped, signals)
        if np.isfinite(then).any() and np.nanmin(then) > WITH:
            found.append(name)
    return found


def _until(log: Log, duration: float) -> dict[str, Any]:
    rows = np.flatnonzero(log.times <= log.times[0] + duration)
    return {"times": log.times[rows], "signals": {name: np.asarray(own)[rows] for name, own in log.signals.items()}}


def _together(model: mujoco.MjModel, log: Log, signals: Sequence[str]) -> Float[np.ndarray, " signals"]:
    """Correlations of recorded and simulated signals; NaN for those that do not move, or if the simulation fails."""
    nothing, noises = np.full(len(signals), np.nan), dict.fromkeys(signals, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            own = starts.state_of(model, None, {})
            begun = starts.chosen(model, [log], signals, noises, [own], [{}], [None], Effects())
            simulator = Simulator(model, lambda theta: model, [log], signals, noises, begun, threads=1)
            (rows,), (outcome,) = simulator.clean(np.zeros((1, 0)))
        except ValueError:
            return nothing
    if outcome:
        return nothing
    found = nothing
    for column, there in enumerate(simulator.there.T):
        one, two = (values[there, column] - values[there, column][:1] for values in (rows, simulator.observation))
        sizes = np.linalg.norm(one), np.linalg.norm(two)
        if min(sizes) > LEAST * max(sizes):
            found[column] = one @ two / (sizes[0] * sizes[1])
    return found
