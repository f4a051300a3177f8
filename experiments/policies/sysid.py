"""The least-squares point for the same rollout, by the Gauss-Newton method of `mujoco.sysid`.

Residuals are those of the gripper and of the DLO's keypoints in all 16 states, divided by the standard deviations of
the detector that inference assumes. The cubes are not touched in an exploratory rollout. The search begins at the
centre of Theta_0 and is bounded by Phi. Needs the extra `bench` (mujoco[sysid]).
"""

import io
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip import trajectory
from jaxlfi.envs.whip.parameters import FEASIBLE, INITIAL, MILLIMETRES, median
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.vision.camera import project
from jaxlfi.envs.whip.vision.keypoints import MASK, ON_DLO, along
from jaxlfi.io import files, provenance

ARCS = (0.25, 0.5, 0.75, 1.0)
"""Places of the detector's keypoints on the DLO, as fractions of its length."""
STEP = 0.02
"""Step of finite differences, in the units of the search: length in 0.1 m, and ln E."""
CONFIDENCE = 0.9
"""Level of intervals, as for posteriors in the tables."""


def residuals(rollout: recordings.Recording) -> Callable[[np.ndarray], np.ndarray]:
    """The residuals of simulations with respect to a rollout.

    Returns:
        A function from points (length in 0.1 m, ln E), shape [2, K], to residuals in standard deviations, shape [160,
        K].
    """
    engine, actions = pick("auto"), jnp.asarray(rollout.actions, jnp.float32)
    states = jnp.asarray(recordings.trajectory(rollout), jnp.float32)
    observed = states[:, 2 : 2 + 2 * ON_DLO].reshape(-1, ON_DLO, 2)
    deviation = float(np.hypot(MASK.noise, MASK.bias))

    @jax.jit
    @jax.vmap
    def simulated(point):
        view, _ = trajectory.seen(engine, median(0.1 * point[0], jnp.exp(point[1])), actions[:-1])
        keypoints = project(rollout.camera, jax.vmap(along, in_axes=(0, None))(view.dlo, jnp.asarray(ARCS)))
        parts = (keypoints - observed) / deviation, (view.gripper - states[:, :2]) / MASK.slip
        return jnp.concatenate([part.ravel() for part in parts])

    return lambda points: np.asarray(simulated(jnp.asarray(points.T, jnp.float32)), float).T


def fit(path: Path, rollout: recordings.Recording) -> None:
    """Write the least-squares point of a rollout, its intervals, and its mean squared residual, as JSON.

    Raises:
        ValueError: if the extra is not installed.
    """
    try:
        from mujoco.sysid import Parameter, ParameterDict, calculate_intervals, optimize
    except ImportError as error:
        raise ValueError(f"sysid: expected mujoco[sysid] (extra `bench`), got {error}") from error
    far = residuals(rollout)
    low, high = (np.array([10 * bound[0], np.log(bound[1])]) for bound in np.asarray([FEASIBLE.low, FEASIBLE.high]))
    start = np.array([5 * (INITIAL.low[0] + INITIAL.high[0]), 0.5 * np.log(INITIAL.low[1] * INITIAL.high[1])])
    parameters = ParameterDict({"theta": Parameter("theta", start, low, high)})
    residual = lambda x, _: ([far(np.reshape(x, (2, -1)))], None, None)
    _, found = optimize(parameters, residual, verbose=False, eps=STEP, max_iters=50, output=io.StringIO())
    left = far(found.x[:, None])[:, 0]
    jacobian = (far(found.x[:, None] + STEP * np.eye(2)) - far(found.x[:, None] - STEP * np.eye(2))) / (2 * STEP)
    _, half = calculate_intervals([left], jacobian, alpha=1 - CONFIDENCE)
    natural = lambda point: [MILLIMETRES[0] * 0.1 * point[0], float(np.exp(point[1]))]
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_json(
        path,
        {
            "theta": natural(found.x),
            "interval": [natural(found.x - half), natural(found.x + half)],
            "confidence": CONFIDENCE,
            "mean_square_residual": float(np.mean(np.square(left))),
            "at_a_bound": bool(np.any((found.x < low + 1e-3) | (found.x > high - 1e-3))),
            **provenance.environment(),
        },
    )
