"""Least squares on a task's recordings: the points that fit best, and how far they can be trusted.

Where a posterior has found the region, a few steps of Gauss-Newton from its modes give a point as sharp as the
recording allows. The interval of a point takes its residuals as they are: where they persist over time, as those of a
wrong model do, they count as fewer samples than they are (the sandwich estimator of White, 1980, with the covariance
that `discrepancy.estimated` reads off the residuals). What residuals cannot show is an error that the parameters make
up for, as a pendulum's damping does for an integrator that damps. The integrator's own error is known, however: the
point is found again with the difference that a finer one makes there (defect correction; Stetter, 1978). And forces
that the model lacks (`forces`) are taken to be as large in the directions that parameters make up for as in those that
residuals show.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import forces
from jaxlfi.envs.mujoco.discrepancy import Discrepancy, estimated
from jaxlfi.envs.mujoco.forces import UnmodelledForces
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.tasks.task import Task

STEP = 1e-4
"""Of central differences, as a fraction of the box's width."""
FORCE_STEP = 1e-3
"""Of differences by forces, as a fraction of those that act on a joint."""
CORRECTIONS = 2
"""How often the point is found again with the integrator's error there."""
_NOISELESS = 1e-3
"""Standard deviation, as a fraction of the signal's own, that stands for the noise of a signal that has none."""
_FAILED = 1e3
"""Residuals of simulations that fail, in standard deviations."""
_APART = 0.05
"""Points nearer than this fraction of the box's width, in all parameters, are the same."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """A point of least squares.

    Attributes:
        theta: in natural units, shape [D].
        misfit: root mean square of the residuals in standard deviations of the noise; 1 for a model without error.
        covariance: of the point's coordinates in inference space, shape [D, D].
        interval: 90 % interval of each parameter, in natural units, within the box; shape [D, 2].
        at_bound: which parameters ended on a bound of the box, shape [D].
        discrepancies: of each signal: what the model, by its own integrator, gets wrong at the point.
        unmodelled_force: how large forces besides the model's own would leave such residuals, those of its own
            integrator, as a fraction of what acts on each joint at the centre of Theta_0.
        defect: root mean square of what the integrator adds at the point, in standard deviations of the noise.
        simulations: that were needed.
    """

    theta: Float[np.ndarray, " dim"]
    misfit: float
    covariance: Float[np.ndarray, "dim dim"]
    interval: Float[np.ndarray, "dim 2"]
    at_bound: Bool[np.ndarray, " dim"]
    discrepancies: tuple[Discrepancy, ...]
    unmodelled_force: float
    defect: float
    simulations: int


class Residuals:
    """Simulated less recorded, in standard deviations of the noise, and their derivatives.

    Coordinates are those of inference space. All simulations of a derivative are done together.
    """

    def __init__(self, task: Task, observation: np.ndarray | None = None):
        """Nothing is simulated yet.

        Args:
            task: of a MuJoCo model.
            observation: another recording in place of the task's own, in the same rows.

        Raises:
            ValueError: for a task of another kind.
        """
        simulator = simulator_of(task)
        self._log, self.simulator, self.simulations = np.asarray(task.space.log), simulator, 0
        self.observed = simulator.observation if observation is None else simulator.aligned(np.asarray(observation))
        self.observed = np.asarray(self.observed, float)
        there = simulator.there
        deviation = np.array([self.observed[own, c].std() for c, own in enumerate(there.T)])
        self.noise = np.maximum(simulator.noise, _NOISELESS * deviation)
        self.defect = np.zeros(self.observed.shape)

    def __call__(self, coordinates: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, "n rows"]:
        """Of all that was measured, for several points."""
        self.simulations += len(coordinates)
        clean, outcome = self.simulator.clean(self.natural(coordinates))
        scaled = ((clean + self.defect - self.observed) / self.noise)[:, self.simulator.there]
        scaled[outcome != 0] = _FAILED
        return scaled

    def natural(self, coordinates: Float[np.ndarray, "*n dim"]) -> Float[np.ndarray, "*n dim"]:
        """From inference space to natural units, in double precision, which differences need."""
        return np.where(self._log, np.exp(np.where(self._log, coordinates, 0.0)), coordinates)

    def correct(self, point: Float[np.ndarray, " dim"]) -> None:
        """Add from now on what a finer integrator changes at a point; nothing where either fails."""
        theta = self.natural(point[None])
        (coarse, failed), (fine, refused) = self.simulator.clean(theta), self.simulator.finer().clean(theta)
        self.simulations += 2
        self.defect = (fine - coarse)[0] if not (failed.any() or refused.any()) else np.zeros(self.observed.shape)

    def jacobian(
        self, point: Float[np.ndarray, " dim"], low: np.ndarray, high: np.ndarray
    ) -> Float[np.ndarray, "rows dim"]:
        """By central differences within the box."""
        steps = STEP * (high - low) * np.eye(len(point))
        sides = np.clip(np.concatenate([point + steps, point - steps]), low, high)
        ahead, behind = np.split(self(sides), 2)
        distance = np.diagonal(sides[: len(point)] - sides[len(point) :])
        return ((ahead - behind) / distance[:, None]).T

    def of_forces(
        self, point: Float[np.ndarray, " dim"], besides: UnmodelledForces
    ) -> Float[np.ndarray, "rows numbers"]:
        """What each of some forces besides the model's own changes at a point, by differences; 0 where one fails."""
        steps = FORCE_STEP * np.diag(besides.deviations)
        steps = np.concatenate([np.zeros((1, len(steps))), steps])
        self.simulations += len(steps)
        theta = self.natural(np.tile(point, (len(steps), 1)))
        clean, failed = self.simulator.lacking(besides).clean(theta, steps)
        changed = ((clean[1:] - clean[0]) / self.noise)[:, self.simulator.there] / FORCE_STEP
        return np.where((failed[0] == 0) & (failed[1:, None] == 0), changed, 0.0).T


def fit(task: Task, start: Sequence[float], box: Support | None = None, observation: np.ndarray | None = None) -> Fit:
    """The point of least squares that is reached from a start, by SciPy's trust-region method.

    Args:
        task: of a MuJoCo model.
        start: in natural units, shape [D].
        box: that the point stays in, in natural units; by default Phi.
        observation: another recording in place of the task's own, in the same rows.

    Raises:
        ValueError: for a task of another kind.
    """
    residuals = Residuals(task, observation)
    low, high = _bounds(task, box)
    found = _solved(residuals, np.asarray(task.space.to_inference(np.asarray(start, float)), float), low, high)
    for _ in range(CORRECTIONS):
        residuals.correct(found.x)
        found = _solved(residuals, found.x, low, high)
    by_forces = residuals.of_forces(found.x, _typical_forces(task, residuals.natural(found.x)))
    covariance = _covariances(residuals, _discrepancies(residuals, found.fun))
    size, widened = forces.estimated(found.fun, found.jac, by_forces)
    covariance += (size * widened) ** 2 * by_forces @ by_forces.T
    covariance = _sandwich(found.jac, covariance)
    defect = (residuals.defect / residuals.noise)[residuals.simulator.there]
    discrepancies = _discrepancies(residuals, found.fun - defect)
    force, _ = forces.estimated(found.fun - defect, found.jac, by_forces)
    reach = 1.6449 * np.sqrt(np.diagonal(covariance))
    ends = np.clip(np.stack([found.x - reach, found.x + reach]), low, high)
    natural = residuals.natural(np.concatenate([found.x[None], ends]))
    margin = 10 * STEP * (high - low)
    at_bound = (found.x - low < margin) | (high - found.x < margin)
    misfit = float(np.sqrt(np.mean(found.fun**2)))
    added = float(np.sqrt(np.mean(defect**2)))
    return Fit(
        natural[0], misfit, covariance, natural[1:].T, at_bound, discrepancies, force, added, residuals.simulations
    )


def best_fits(
    task: Task,
    starts: Float[np.ndarray, "n dim"],
    keep: int = 4,
    box: Support | None = None,
    observation: np.ndarray | None = None,
    counted: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> list[Fit]:
    """Points of least squares from the best of several starts, the best first; those that are the same only once.

    Args:
        task: of a MuJoCo model.
        starts: in natural units, such as draws of a posterior or of a box.
        keep: how many of them are followed.
        box: that the points stay in, in natural units; by default Phi.
        observation: another recording in place of the task's own, in the same rows.
        counted: goes through the starts that are followed, as a progress bar does.
    """
    residuals = Residuals(task, observation)
    starts = np.asarray(starts, float)
    misfits = np.mean(residuals(np.asarray(task.space.to_inference(starts))) ** 2, axis=1)
    fits = [fit(task, starts[row], box, observation) for row in counted(np.argsort(misfits)[:keep].tolist())]
    low, high = _bounds(task, None)
    different: list[Fit] = []
    for one in sorted(fits, key=lambda one: one.misfit):
        places = np.asarray(task.space.to_inference(np.stack([one.theta, *(other.theta for other in different)])))
        if (np.abs(places[1:] - places[0]) > _APART * (high - low)).any(axis=1).all():
            different.append(one)
    spent = len(starts) + sum(one.simulations for one in fits)
    return [dataclasses.replace(one, simulations=spent) for one in different]


def _solved(
    residuals: Residuals, start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> scipy.optimize.OptimizeResult:
    margin = STEP * (high - low)  # SciPy's method starts inside of its bounds
    return scipy.optimize.least_squares(
        lambda point: residuals(point[None])[0],
        np.clip(start, low + margin, high - margin),
        jac=lambda point: residuals.jacobian(point, low, high),
        bounds=(low, high),
        x_scale=high - low,
    )


def _typical_forces(task: Task, point: Float[np.ndarray, " dim"]) -> UnmodelledForces:
    """Those at the centre of Theta_0, as inference takes them; at a point where the centre cannot be simulated."""
    simulator = simulator_of(task)
    centre = np.asarray(task.space.to_natural(task.support().centre), float)
    _, failed = simulator.clean(centre[None])
    return simulator.typical_forces(point if failed[0] else centre)


def _bounds(task: Task, box: Support | None) -> tuple[np.ndarray, np.ndarray]:
    inner = task.inference.feasible if box is None else task.space.box_to_inference(box)
    return np.asarray(inner.low, float), np.asarray(inner.high, float)


def _discrepancies(residuals: Residuals, scaled: np.ndarray) -> tuple[Discrepancy, ...]:
    """Of each signal, in its unit."""
    there, lengths = residuals.simulator.there, [len(own) for own in residuals.simulator.times]
    values = np.full(there.shape, np.nan)
    values[there] = scaled
    values *= residuals.noise
    episodes = np.split(values, np.cumsum(lengths)[:-1])
    return tuple(
        estimated([own[:, c] for own in episodes], residuals.simulator.times, noise)
        for c, noise in enumerate(residuals.noise)
    )


def _covariances(residuals: Residuals, discrepancies: Sequence[Discrepancy]) -> Float[np.ndarray, "measured measured"]:
    """Of all that was measured, in variances of the noise: white noise and discrepancies."""
    there, lengths = residuals.simulator.there, [len(own) for own in residuals.simulator.times]
    rows, signals = there.shape
    whole = np.zeros((rows, signals, rows, signals))
    for c, (process, noise) in enumerate(zip(discrepancies, residuals.noise, strict=True)):
        begin = 0
        for length, times in zip(lengths, residuals.simulator.times, strict=True):
            own = slice(begin, begin + length)
            whole[own, c, own, c] = process.covariance(times) / noise**2
            begin += length
    flat = whole.reshape(rows * signals, rows * signals)[there.ravel()][:, there.ravel()]
    return flat + np.eye(len(flat))


def _sandwich(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    bread = np.linalg.pinv(jacobian)
    return bread @ covariance @ bread.T
