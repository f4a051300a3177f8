"""The least-squares point that MuJoCo's own system identification finds, for comparison. Needs the extra `bench`."""

import dataclasses
import io

import numpy as np
from jaxtyping import Bool, Float

from jaxlfi.diagnostics.identifiability import NORMAL, untouched
from jaxlfi.envs.mujoco.least_squares import Residuals, intervals, uninformed_directions
from jaxlfi.tasks.task import Task

LEVEL = 0.9
"""Level of the intervals."""
_MARGIN = 1e-3
"""Points nearer to a bound than this fraction of the box's width count as on it."""


@dataclasses.dataclass(frozen=True)
class SysidPoint:
    """The result of `mujoco.sysid`; the attributes are those of `least_squares.Fit`, as far as it has them.

    Its intervals assume that the model is right, and are NaN where the recording does not inform a parameter.
    """

    theta: Float[np.ndarray, " dim"]
    misfit: float
    interval: Float[np.ndarray, "dim 2"]
    at_bound: Bool[np.ndarray, " dim"]
    simulations: int


def require_sysid() -> None:
    """Check that `mujoco.sysid` is installed; MuJoCo brings an empty one if its dependencies are missing.

    Raises:
        ImportError: if it is not, with what to install.
    """
    try:
        from mujoco.sysid import calculate_intervals, optimize  # noqa: F401
    except ImportError as error:
        raise ImportError("the estimate of mujoco.sysid needs its packages: pip install 'mujoco[sysid]'") from error


def sysid_point(task: Task, observation: np.ndarray | None = None) -> SysidPoint:
    """The point from the middle of the first guess Theta_0, within Phi; the integrator's error is not subtracted.

    Args:
        task: of a MuJoCo model.
        observation: another recording in place of the task's own, in the same rows.

    Raises:
        ValueError: for a task of another kind.
        ImportError: without `mujoco.sysid`.
    """
    require_sysid()
    residuals, guess, box = Residuals(task, observation), task.support(), task.inference.feasible
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    theta = solved(residuals, 0.5 * (np.asarray(guess.low, float) + np.asarray(guess.high, float)), low, high)
    left, jacobian = residuals(theta[None])[0], residuals.jacobian(theta, low, high)
    half, uninformed = half_widths(left, jacobian), uninformed_directions(jacobian, high - low)
    interval = intervals(residuals, theta, half / NORMAL, uninformed, low, high)
    margin = _MARGIN * (high - low)
    at_bound = untouched(uninformed.T / (high - low)) & ((theta - low < margin) | (high - theta < margin))
    misfit = float(np.sqrt(np.mean(left**2)))
    return SysidPoint(residuals.natural(theta), misfit, interval, at_bound, residuals.simulations)


def solved(
    residuals: Residuals, start: Float[np.ndarray, " dim"], low: np.ndarray, high: np.ndarray
) -> Float[np.ndarray, " dim"]:
    """The point that `mujoco.sysid.optimize` ends at, in inference space."""
    from mujoco.sysid import Parameter, ParameterDict, optimize

    parameters = ParameterDict({"theta": Parameter("theta", start, low, high)})
    residual = lambda x, _: ([residuals(np.reshape(x, (len(start), -1)).T).T], None, None)
    with np.errstate(all="ignore"):
        _, found = optimize(parameters, residual, verbose=False, output=io.StringIO())
    return np.asarray(found.x, float)


def half_widths(left: Float[np.ndarray, " rows"], jacobian: Float[np.ndarray, "rows dim"]) -> Float[np.ndarray, " dim"]:
    """Half-widths of its intervals at a point, from the residuals that are left there."""
    from mujoco.sysid import calculate_intervals

    with np.errstate(all="ignore"):
        return calculate_intervals([left], jacobian, alpha=1 - LEVEL)[1]
