"""Least squares on a task's recordings: the points that fit best, and how far they can be trusted.

Once a posterior has found the region, a few Gauss-Newton steps from its modes give a point as sharp as the recording
allows. The interval of a point allows for correlated residuals: where they persist over time, as those of a wrong model
do, they count as fewer samples than they are (the sandwich estimator of White, 1980, with the covariance that
`discrepancy.estimated` estimates from the residuals). Residuals cannot show an error that the parameters compensate, as
a pendulum's damping compensates an integrator that damps. The integrator's own error is known, however: the point is
found again with the difference that a finer one makes there (defect correction; Stetter, 1978), unless the recording
fits better without, as one simulated by the model itself does. Forces that the model lacks (`forces`) are assumed to be
as large in the directions that parameters compensate as in those that residuals show.

A posterior is polished with the errors that its task's file states instead (`stated`): residuals are then whitened, and
the point is that of generalised least squares (Aitken 1936). Where recordings leave initial states open (`starts`),
residuals count only as far as other starts would not explain them. A parameter that the recording does not inform has
no interval (`jaxlfi.diagnostics.identifiability`).

Time and memory are linear in the length of the recording: covariances of all measurements are never formed, only their
products with the parameters' few directions.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxlfi.diagnostics import identifiability
from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import forces, noise
from jaxlfi.envs.mujoco.discrepancy import Discrepancy, estimated
from jaxlfi.envs.mujoco.forces import UnmodelledForces
from jaxlfi.envs.mujoco.simulator import Drawn, simulator_of
from jaxlfi.tasks.task import Task

STEP = 1e-4
"""Step of central differences, as a fraction of the box's width."""
FORCE_STEP = 1e-3
"""Step of differences by forces, as a fraction of those that act on a joint."""
START_STEP = 0.1
"""Step of differences by starts, in standard deviations."""
LARGER = 100.0
"""Factor on stated forces, which are small: the step of differences is a tenth of them."""
CORRECTIONS = 2
"""Number of times that the point is found again with the integrator's error there."""
AS_GOOD = 1.1
"""Points whose misfit is within this factor of the best one's explain the recording equally well."""
CHECKED = 32
"""Draws of a point's normal distribution that are simulated, to check the derivatives at the point."""
NONLINEAR = 1.0
"""Error of the prediction by derivatives, in standard deviations, above which intervals cannot be trusted."""
AGREEING = 2
"""Starts that must end in the best point: if each ends elsewhere, there may be better points."""
ALIKE_BY = 2.0
"""Difference in log-likelihood within which the end of a start counts as the best point."""
MORE = 4
"""Factor by which more starts are followed, at most, until that many agree."""
_NOISELESS = 1e-3
"""Standard deviation assumed for the noise of a signal without any, as a fraction of the signal's own."""
_FAILED = 1e3
"""Residuals of simulations that fail, in standard deviations."""
_APART = 0.05
"""Points nearer than this fraction of the box's width, in all parameters, are the same."""
_REACHED = 0.002
"""Starts whose ends are nearer than this fraction in all parameters have reached the same point."""
_ALIKE = 0.3
"""Points that differ only in what is not informed are the same if simulations differ by less than this: root mean
square, in standard deviations of the noise."""
_TOGETHER = 16
"""Starts that are simulated together, to limit the memory for long recordings."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """A point of least squares.

    Attributes:
        theta: in natural units, shape [D].
        misfit: root mean square of the residuals in standard deviations of the noise, or of noise and stated errors;
            1 for a model without further error.
        covariance: of the point's coordinates in inference space, shape [D, D]; along what the recording does not
            inform, that of a uniform distribution over the box.
        interval: 90 % interval of each parameter, in natural units, within the box; NaN where the recording does not
            inform it. Shape [D, 2].
        uninformed: directions in inference space that the recording does not inform, shape [D, K].
        at_bound: which parameters ended on a bound of the box, of those that the simulation depends on, shape [D].
        discrepancies: model error of each signal at the point, with the model's own integrator; empty if the errors are
            stated.
        unmodelled_force: size of additional forces that would leave such residuals with the model's own integrator, as
            a fraction of the forces on each joint at the centre of Theta_0; 0 if the errors are stated.
        defect: root mean square of the integrator's error at the point, in standard deviations of the noise; 0 if the
            recording fits better without.
        simulations: number of simulations made.
        nonlinearity: error of the prediction by derivatives at the point, for draws of its normal distribution: root
            mean square of the worst direction, in standard deviations; 0 if residuals are linear.
        reached: number of starts that ended in the best point.
        followed: number of starts that were followed.
    """

    theta: Float[np.ndarray, " dim"]
    misfit: float
    covariance: Float[np.ndarray, "dim dim"]
    interval: Float[np.ndarray, "dim 2"]
    uninformed: Float[np.ndarray, "dim directions"]
    at_bound: Bool[np.ndarray, " dim"]
    discrepancies: tuple[Discrepancy, ...]
    unmodelled_force: float
    defect: float
    simulations: int
    nonlinearity: float = 0.0
    reached: int = 1
    followed: int = 1

    @property
    def doubt(self) -> str:
        """Why the interval cannot be trusted, as a sentence; empty if nothing speaks against it."""
        if self.nonlinearity > NONLINEAR:
            return (
                "Simulations within the interval are not what derivatives at the point predict, as with contacts: "
                "the interval cannot be trusted, and is probably too narrow."
            )
        return f"{self.alone} The interval cannot be trusted." if self.alone else ""

    @property
    def alone(self) -> str:
        """A sentence that says that few starts ended in the best point; empty if several did."""
        if self.followed == 1 or self.reached >= AGREEING:
            return ""
        return f"Only {self.reached} of {self.followed} starts ended in the best point: there may be better ones."

    @property
    def informed(self) -> Bool[np.ndarray, " dim"]:
        """The parameters that the recording informs."""
        return np.isfinite(self.interval).all(axis=1)


class Residuals:
    """Simulated minus recorded, in standard deviations of the noise, and their derivatives.

    Coordinates are those of inference space. All simulations of a derivative are made together.
    """

    def __init__(self, task: Task, observation: np.ndarray | None = None, stated: bool = False):
        """Nothing is simulated yet.

        Args:
            task: of a MuJoCo model.
            observation: another recording in place of the task's own, in the same rows.
            stated: whether residuals are whitened by the model errors that the task simulates.

        Raises:
            ValueError: for a task of another kind, and signals without noise that are constant.
        """
        simulator = simulator_of(task)
        self._log, self.simulator, self.simulations = np.asarray(task.space.log), simulator, 0
        self.observed = simulator.observation if observation is None else simulator.aligned(np.asarray(observation))
        self.observed = np.asarray(self.observed, float)
        columns = [self.observed[own, c] for c, own in enumerate(simulator.there.T)]
        self.noise = np.maximum(simulator.noise, [_NOISELESS * values.std() for values in columns])
        for c, _ in simulator.does.deviations:  # their noise is inferred
            self.noise[c] = max(
                self.noise[c], noise.standard_deviation(columns[c]) if len(columns[c]) >= noise.LEAST else 0
            )
        if constant := [name for name, own in zip(simulator.signals, self.noise, strict=True) if not own > 0]:
            raise ValueError(
                "noise: expected standard deviations above 0 for signals that are constant in the recording, got "
                f"none for {', '.join(constant)}"
            )
        self.measurements = int(simulator.there.sum())
        self.defect = np.zeros(self.observed.shape)
        self.stated = stated and says_errors(task)
        self._by_starts: list[tuple[slice, np.ndarray, np.ndarray]] = []
        self._by_forces: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, coordinates: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, "n rows"]:
        """Residuals of all measurements, for several points."""
        self.simulations += len(coordinates)
        clean, outcome = self.simulator.clean(self.natural(coordinates))
        scaled = self.measured(clean + self.defect - self.observed)
        scaled[outcome != 0] = _FAILED
        return scaled

    def measured(self, rows: Float[np.ndarray, "*n time signals"]) -> Float[np.ndarray, "*n rows"]:
        """Differences of trajectories in standard deviations of the noise, at all measurements.

        Where initial states are uncertain (`starts`), differences that other starts would make count the less, the
        more uncertain those are: all are multiplied by the inverse root of their covariance. The same holds for stated
        model errors.
        """
        scaled = rows / self.noise
        scaled = (self._without_discrepancies(scaled) if self.stated else scaled)[..., self.simulator.there]
        for part, directions, shrink in self._by_starts:
            own = scaled[..., part]
            scaled[..., part] = own + (own @ directions * shrink) @ directions.T
        if self._by_forces is not None:
            directions, shrink = self._by_forces
            scaled = scaled + (scaled @ directions * shrink) @ directions.T
        return scaled

    def _without_discrepancies(self, scaled: Float[np.ndarray, "*n time signals"]) -> np.ndarray:
        """Differences whitened by the discrepancies, as if only noise were random."""
        found, begin = scaled.copy(), 0
        for times in self.simulator.times:
            for c, process in self.simulator.discrepancies.items():
                own = np.flatnonzero(self.simulator.there[begin : begin + len(times), c])
                one = Discrepancy(process.deviation / self.noise[c], process.time)
                found[..., begin + own, c] = one.whitened(times[own], scaled[..., begin + own, c], 1.0)
            begin += len(times)
        return found

    def natural(self, coordinates: Float[np.ndarray, "*n dim"]) -> Float[np.ndarray, "*n dim"]:
        """From inference space to natural units, in double precision, which differences need."""
        return np.where(self._log, np.exp(np.where(self._log, coordinates, 0.0)), coordinates)

    def correct(self, point: Float[np.ndarray, " dim"], integrator: bool = True) -> None:
        """Add from now on what a finer integrator changes at a point; allow for uncertain starts and stated forces.

        What fails is left out, and so is the integrator's error if it is not to be corrected.
        """
        theta = self.natural(point[None])
        self._by_forces = None
        self._by_starts = self._of_starts(theta[0])
        if self.stated and (besides := self.simulator.forces) is not None:
            moved = self.of_forces(point, besides.times(LARGER)) / LARGER
            directions, sizes, _ = np.linalg.svd(moved, full_matrices=False)
            self._by_forces = directions, 1 / np.sqrt(1 + sizes**2) - 1
        self.defect = np.zeros(self.observed.shape)
        if integrator:
            (coarse, failed), (fine, refused) = self.simulator.clean(theta), self.simulator.finer().clean(theta)
            self.simulations += 2
            if not (failed.any() or refused.any()):
                self.defect = (fine - coarse)[0]

    def jacobian(
        self, point: Float[np.ndarray, " dim"], low: np.ndarray, high: np.ndarray
    ) -> Float[np.ndarray, "rows dim"]:
        """Derivatives by central differences within the box; one-sided if one side fails, and 0 if both do."""
        steps = STEP * (high - low) * np.eye(len(point))
        sides = np.clip(np.concatenate([point + steps, point - steps]), low, high)
        values = self(sides)
        failed = (values == _FAILED).all(axis=1)
        if failed.any():
            sides[failed], values[failed] = point, self(point[None])[0]
        ahead, behind = np.split(values, 2)
        distance = np.diagonal(sides[: len(point)] - sides[len(point) :])[:, None]
        return np.divide(ahead - behind, distance, out=np.zeros_like(ahead), where=distance != 0).T

    def of_forces(
        self, point: Float[np.ndarray, " dim"], besides: UnmodelledForces
    ) -> Float[np.ndarray, "rows numbers"]:
        """The effect of each additional force at a point, by differences; 0 if its simulation fails."""
        steps = FORCE_STEP * np.diag(besides.deviations)
        steps = np.concatenate([np.zeros((1, len(steps))), steps])
        self.simulations += len(steps)
        theta = self.natural(np.tile(point, (len(steps), 1)))
        clean, failed = self.simulator.lacking(besides).clean(theta, steps)
        changed = self.measured(clean[1:] - clean[0]) / FORCE_STEP
        return np.where((failed[0] == 0) & (failed[1:, None] == 0), changed, 0.0).T

    def _of_starts(self, theta: Float[np.ndarray, " dim"]) -> list[tuple[slice, np.ndarray, np.ndarray]]:
        """For each episode: the place of its residuals, the directions in which its start moves them, and shrinkage."""
        begins, there = self.simulator.starts, self.simulator.there
        used = np.argwhere(np.any([one.root.any(axis=1) for one in begins], axis=0))
        if not len(used):
            return []
        steps = np.zeros((2 * len(used), *begins[0].root.shape[:2]))
        for k, (dof, column) in enumerate(used):
            steps[[k, k + len(used)], dof, column] = START_STEP, -START_STEP
        self.simulations += len(steps)
        several = Drawn(None, [steps] * len(begins))  # a start moves its own episode only
        clean, failed = self.simulator.clean(np.tile(theta, (len(steps), 1)), drawn=several)
        self._by_starts = []
        ahead, behind = np.split(self.measured(clean), 2)
        moved = np.where((failed == 0).all(), (ahead - behind) / (2 * START_STEP), 0.0)
        counts = [int(own.sum()) for own in np.split(there, np.cumsum([len(own) for own in self.simulator.times])[:-1])]
        found = []
        for end, count in zip(np.cumsum(counts), counts, strict=True):
            part = slice(int(end) - count, int(end))
            directions, sizes, _ = np.linalg.svd(moved[:, part].T, full_matrices=False)
            found.append((part, directions, 1 / np.sqrt(1 + sizes**2) - 1))
        return found


def says_errors(task: Task) -> bool:
    """Whether a task's file states errors of its model: `unmodelled_force`, or `[discrepancy]`."""
    simulator = simulator_of(task)
    return bool(simulator.discrepancies) or simulator.forces is not None


def fit(
    task: Task,
    start: Sequence[float],
    box: Support | None = None,
    observation: np.ndarray | None = None,
    stated: bool = False,
) -> Fit:
    """The least-squares point that is reached from a start, by SciPy's trust-region method.

    Args:
        task: of a MuJoCo model.
        start: in natural units, shape [D].
        box: that the point stays in, in natural units; by default Phi.
        observation: another recording in place of the task's own, in the same rows.
        stated: whether to use the model errors of the task's file, if it states any; otherwise they are estimated.

    Raises:
        ValueError: for a task of another kind.
    """
    residuals = Residuals(task, observation, stated)
    low, high = _bounds(task, box)
    place = np.asarray(task.space.to_inference(np.asarray(start, float)), float)
    return _corrected(task, residuals, _solved(residuals, place, low, high), low, high)


def _corrected(
    task: Task, residuals: Residuals, found: scipy.optimize.OptimizeResult, low: np.ndarray, high: np.ndarray
) -> Fit:
    """The point, found again with the integrator's and the file's errors, and its uncertainty."""
    for _ in range(CORRECTIONS):
        residuals.correct(found.x)
        found = _solved(residuals, found.x, low, high)
    if residuals.defect.any():
        with_defect, residuals.defect = residuals.defect, np.zeros_like(residuals.defect)
        plain = _solved(residuals, found.x, low, high)
        if plain.cost < found.cost:
            found = plain
        else:
            residuals.defect = with_defect
    defect = residuals.measured(residuals.defect)
    force = 0.0
    discrepancies: tuple[Discrepancy, ...] = ()
    if residuals.stated:
        covariance, uninformed = _stated_uncertainty(found, high - low)
    else:
        by_forces = residuals.of_forces(found.x, _typical_forces(task, residuals.natural(found.x)))
        covariance, uninformed, force = _uncertainty(residuals, found, defect, by_forces, high - low)
        discrepancies = _discrepancies(residuals, found.fun - defect)
    interval = intervals(residuals, found.x, np.sqrt(np.diagonal(covariance)), uninformed, low, high)
    margin = 10 * STEP * (high - low)
    moved = identifiability.untouched(uninformed_directions(found.jac, high - low).T / (high - low))
    at_bound = moved & ((found.x - low < margin) | (high - found.x < margin))
    misfit = float(np.sqrt(np.mean(found.fun**2)))
    added = float(np.sqrt(np.mean(defect**2)))
    nonlinearity = _nonlinearity(residuals, found, covariance, uninformed, low, high)
    return Fit(
        theta=residuals.natural(found.x),
        misfit=misfit,
        covariance=covariance,
        interval=interval,
        uninformed=uninformed,
        at_bound=at_bound,
        discrepancies=discrepancies,
        unmodelled_force=force,
        defect=added,
        simulations=residuals.simulations,
        nonlinearity=nonlinearity,
    )


def _nonlinearity(
    residuals: Residuals,
    found: scipy.optimize.OptimizeResult,
    covariance: Float[np.ndarray, "dim dim"],
    uninformed: Float[np.ndarray, "dim directions"],
    low: np.ndarray,
    high: np.ndarray,
) -> float:
    """The error of derivatives for draws of the point's normal distribution, along what the recording informs.

    By the derivatives at the point, the residuals of each draw's simulation tell where it was drawn. With contacts and
    dry friction, across whose kinks derivatives do not hold, they tell something else.
    """
    width = high - low
    along = scipy.linalg.null_space(uninformed.T / width) if uninformed.size else np.eye(len(width))
    if not along.size or not np.isfinite(covariance).all():
        return 0.0
    factor = np.linalg.cholesky(along.T @ (covariance / np.outer(width, width)) @ along)
    half = np.random.default_rng(0).standard_normal((CHECKED // 2, len(factor)))
    drawn = np.concatenate([half, -half])
    offsets = (drawn @ factor.T @ along.T) * width
    inside = ((found.x + offsets > low) & (found.x + offsets < high)).all(axis=1)
    if not inside.any():
        return 0.0
    effects = found.jac @ (width[:, None] * (along @ factor))  # of a standard deviation in each direction
    said = (residuals(found.x + offsets[inside]) - found.fun) @ np.linalg.pinv(effects).T
    return float(np.sqrt(np.mean((said - drawn[inside]) ** 2, axis=0)).max())


def intervals(
    residuals: Residuals,
    point: Float[np.ndarray, " dim"],
    deviations: Float[np.ndarray, " dim"],
    uninformed: Float[np.ndarray, "dim directions"],
    low: Float[np.ndarray, " dim"],
    high: Float[np.ndarray, " dim"],
) -> Float[np.ndarray, "dim 2"]:
    """90 % intervals in natural units; NaN where the recording does not inform a parameter.

    Args:
        residuals: of the recording.
        point: in inference space.
        deviations: standard deviations there.
        uninformed: directions that the recording does not inform.
        low: of the box, in inference space.
        high: of the box.
    """
    reach = identifiability.NORMAL * deviations
    ends = np.clip(np.stack([point - reach, point + reach]), low, high)
    known = identifiability.untouched(uninformed.T / (high - low)) & (
        np.ptp(ends, axis=0) < identifiability.LIKE_THE_BOX * (high - low)
    )
    return np.where(known, residuals.natural(ends), np.nan).T


def uninformed_directions(
    jacobian: Float[np.ndarray, "rows dim"], width: np.ndarray
) -> Float[np.ndarray, "dim directions"]:
    """Directions in inference space that white noise alone leaves as wide as the box.

    Args:
        jacobian: of residuals in standard deviations of the noise.
        width: of the box, in inference space.
    """
    sizes, rows = identifiability.directions(jacobian * width)
    return (width * rows[~_seen(sizes, rows)]).T


def best_fits(
    task: Task,
    starts: Float[np.ndarray, "n dim"],
    keep: int = 4,
    box: Support | None = None,
    observation: np.ndarray | None = None,
    counted: Callable[[Sequence[int]], Iterable[int]] = iter,
    stated: bool = False,
) -> list[Fit]:
    """Distinct least-squares points from the best of several starts, the best first.

    Where the misfit has many minima, starts end in different ones, and the best of few is rarely the best of all. More
    starts are followed until several end in the best point (multistart; Boender and Rinnooy Kan 1987).

    Args:
        task: of a MuJoCo model.
        starts: in natural units, such as draws of a posterior or of a box.
        keep: smallest number of starts that are followed; at most `MORE` times as many are.
        box: that the points stay in, in natural units; by default Phi.
        observation: another recording in place of the task's own, in the same rows.
        counted: iterates over the starts that are followed, as a progress bar does.
        stated: whether to use the model errors of the task's file, if it states any.
    """
    residuals = Residuals(task, observation, stated)
    starts = np.asarray(starts, float)
    places = np.asarray(task.space.to_inference(starts))
    parts = [residuals(places[first : first + _TOGETHER]) for first in range(0, len(places), _TOGETHER)]
    misfits = np.concatenate([np.mean(part**2, axis=1) for part in parts])
    low, high = _bounds(task, box)

    def followed(row: int) -> tuple[Residuals, scipy.optimize.OptimizeResult]:
        own = Residuals(task, observation, stated)
        return own, _solved(own, places[row], low, high)

    best, enough = np.argsort(misfits)[: MORE * keep].tolist(), min(AGREEING, keep)
    ends = [followed(row) for row in counted(best[:keep])]
    for row in counted(best[keep:]) if _agreeing(ends) < enough else ():
        ends.append(followed(row))
        if _agreeing(ends) >= enough:
            break
    apart = _apart(ends, high - low)[:keep]
    fits = [_corrected(task, *apart[place], low, high) for place in counted(range(len(apart)))]
    different: list[Fit] = []
    for one in sorted(fits, key=lambda one: one.misfit):
        if not any(_same(task, residuals, one, other) for other in different):
            different.append(one)
    spent, reached = len(starts) + sum(own.simulations for own, _ in ends), _agreeing(ends)
    return [dataclasses.replace(one, simulations=spent, reached=reached, followed=len(ends)) for one in different]


def _agreeing(ends: Sequence[tuple[Residuals, scipy.optimize.OptimizeResult]]) -> int:
    """How many starts ended in a point as likely as the best one; less likely points nearby do not count."""
    costs = np.array([found.cost for _, found in ends])
    worse = (costs - costs.min()) / max(1.0, 2 * costs.min() / ends[0][0].measurements)
    return int(np.sum(worse < ALIKE_BY))


def _apart(
    ends: Sequence[tuple[Residuals, scipy.optimize.OptimizeResult]], width: np.ndarray
) -> list[tuple[Residuals, scipy.optimize.OptimizeResult]]:
    """The distinct points that were reached, the best first: corrections of the same point lead to the same point."""
    found: list[tuple[Residuals, scipy.optimize.OptimizeResult]] = []
    for one in sorted(ends, key=lambda one: one[1].cost):
        if not any((np.abs(one[1].x - other.x) <= _REACHED * width).all() for _, other in found):
            found.append(one)
    return found


def as_good(fits: Sequence[Fit]) -> list[Fit]:
    """The points that explain the recording as well as the first one, which is the best."""
    return [one for one in fits if one.misfit <= AS_GOOD * fits[0].misfit]


def _same(task: Task, residuals: Residuals, one: Fit, other: Fit) -> bool:
    """Whether two points are the same, or differ only along directions that the recording does not inform."""
    low, high = _bounds(task, None)
    places = np.asarray(task.space.to_inference(np.stack([one.theta, other.theta])), float)
    apart = np.abs(places[1] - places[0]) > _APART * (high - low)
    if not apart.any() or (apart & one.informed & other.informed).any():
        return not apart.any()
    simulated = residuals(places)
    return bool(np.sqrt(np.mean((simulated[1] - simulated[0]) ** 2)) < _ALIKE)


def _uncertainty(
    residuals: Residuals,
    found: scipy.optimize.OptimizeResult,
    defect: Float[np.ndarray, " rows"],
    by_forces: Float[np.ndarray, "rows numbers"],
    width: Float[np.ndarray, " dim"],
) -> tuple[Float[np.ndarray, "dim dim"], Float[np.ndarray, "dim directions"], float]:
    """The point's covariance, the directions that are not informed, and the size of forces that the model lacks.

    That size is for the model with its own integrator; the covariance is that of the corrected point.
    """
    processes = _discrepancies(residuals, found.fun)

    def spread(along: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        size, widened = forces.estimated(found.fun, along, by_forces)
        weights = along / sizes
        by_parameters = weights.T @ by_forces
        return _form(residuals, processes, weights) + (size * widened) ** 2 * by_parameters @ by_parameters.T

    covariance, uninformed, along = _covariance(found.jac * width, width, spread)
    force, _ = forces.estimated(found.fun - defect, along, by_forces)
    return covariance, uninformed, force


def _stated_uncertainty(
    found: scipy.optimize.OptimizeResult, width: Float[np.ndarray, " dim"]
) -> tuple[Float[np.ndarray, "dim dim"], Float[np.ndarray, "dim directions"]]:
    """The point's covariance from independent residuals, and the directions that are not informed.

    If residuals are larger than the stated errors allow, the covariance is larger by the same factor (Birge 1932).
    """
    larger = max(1.0, float(np.mean(found.fun**2)))
    return _covariance(found.jac * width, width, lambda along, sizes: np.diag(larger / sizes**2))[:2]


def _covariance(
    jacobian: Float[np.ndarray, "rows dim"],
    width: Float[np.ndarray, " dim"],
    spread: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[Float[np.ndarray, "dim dim"], Float[np.ndarray, "dim directions"], Float[np.ndarray, "rows k"]]:
    """A point's covariance, the directions that are not informed, and those in which residuals inform it.

    Args:
        jacobian: in units of the box's width.
        width: of the box.
        spread: the covariance along directions, by their orthonormal effects on the residuals and the effects' sizes.
    """
    sizes, rows = identifiability.directions(jacobian)
    seen = _seen(sizes, rows)
    while True:
        along = jacobian @ rows[seen].T / sizes[seen]  # orthonormal
        found = spread(along, sizes[seen])
        narrow = identifiability.says_more(np.sqrt(np.diagonal(found)), rows[seen])
        if narrow.all():
            break
        seen[np.flatnonzero(seen)[~narrow]] = False
    covariance = rows[seen].T @ found @ rows[seen] + rows[~seen].T @ rows[~seen] / 12
    return covariance * np.outer(width, width), (width * rows[~seen]).T, along


def _seen(sizes: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Directions along which white noise leaves less than the box's width."""
    deviations = np.divide(1.0, sizes, out=np.full(len(sizes), np.inf), where=sizes > 0)
    return identifiability.says_more(deviations, rows)


def _solved(
    residuals: Residuals, start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> scipy.optimize.OptimizeResult:
    margin = STEP * (high - low)  # SciPy's method starts inside its bounds
    return scipy.optimize.least_squares(
        lambda point: residuals(point[None])[0],
        np.clip(start, low + margin, high - margin),
        jac=lambda point: residuals.jacobian(point, low, high),
        bounds=(low, high),
        x_scale=high - low,
    )


def _typical_forces(task: Task, point: Float[np.ndarray, " dim"]) -> UnmodelledForces:
    """Typical forces at the centre of Theta_0, as in inference; at `point` if the centre cannot be simulated."""
    simulator = simulator_of(task)
    centre = np.asarray(task.space.to_natural(task.support().centre), float)
    _, failed = simulator.clean(centre[None])
    return simulator.typical_forces(point if failed[0] else centre)


def _bounds(task: Task, box: Support | None) -> tuple[np.ndarray, np.ndarray]:
    inner = task.inference.feasible if box is None else task.space.box_to_inference(box)
    return np.asarray(inner.low, float), np.asarray(inner.high, float)


def _discrepancies(residuals: Residuals, scaled: np.ndarray) -> tuple[Discrepancy, ...]:
    """The discrepancy of each signal, in its unit."""
    there, lengths = residuals.simulator.there, [len(own) for own in residuals.simulator.times]
    values = np.full(there.shape, np.nan)
    values[there] = scaled
    values *= residuals.noise
    episodes = np.split(values, np.cumsum(lengths)[:-1])
    return tuple(
        estimated([own[:, c] for own in episodes], residuals.simulator.times, deviation)
        for c, deviation in enumerate(residuals.noise)
    )


def _form(
    residuals: Residuals, processes: Sequence[Discrepancy], weights: Float[np.ndarray, "measured n"]
) -> Float[np.ndarray, "n n"]:
    """`weights.T @ covariance @ weights` for white noise and discrepancies, in variances of the noise."""
    there, lengths = residuals.simulator.there, [len(own) for own in residuals.simulator.times]
    place = np.cumsum(there.ravel()).reshape(there.shape) - 1
    total = weights.T @ weights
    begin = 0
    for length, times in zip(lengths, residuals.simulator.times, strict=True):
        for c, (process, deviation) in enumerate(zip(processes, residuals.noise, strict=True)):
            own = there[begin : begin + length, c]
            total += process.form(times[own], weights[place[begin : begin + length, c][own]]) / deviation**2
        begin += length
    return total
