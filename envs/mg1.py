"""The M/G/1 queue: one server, Poisson arrivals, uniform service times, observed by its departures only."""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.task import Task

NAMES = ("service min", "service max", "arrival rate")
"""theta_1..theta_3 of the paper."""

SUPPORTS = {
    "ok": Support([0.0, 0.0, 0.0], [10.0, 10.0, 0.35]),
    "misspecified": Support([3.0, 0.0, 0.0], [10.0, 7.0, 0.35]),
    "broad": Support([0.0, 0.0, 0.0], [20.0, 20.0, 0.5]),
    "unmirrored": Support([3.0, 2.0, 0.0], [10.0, 7.0, 0.35]),
}
"""The named supports of the paper's appendix on M/G/1. "misspecified" excludes the truth in theta_1, but not its mirror
image (5, 1, 0.2), which is the same queue (see `task`); "unmirrored", which is ours, excludes both."""

FEASIBLE = SUPPORTS["broad"]
"""Phi: the broad support, as for Lotka-Volterra. No rate in it is negative."""

PERCENTILES = (0.0, 25.0, 50.0, 75.0, 100.0)

RATE_FLOOR = 1e-3
"""Minimum arrival rate of simulations, 1 / time.

All boxes of the paper include a rate of 0, to which draws may be clipped and at which no job would ever arrive. At this
minimum, jobs arrive 200 times more slowly than at the truth and never queue; lower rates would only stretch the same
data further, and rates this low are 0.3 % of the "ok" support.
"""


# ---------------------------------------------------------------------------------------------------- the queue


def waiting_times(service: Float[Array, " jobs"], gaps: Float[Array, " jobs"]) -> Float[Array, " jobs"]:
    """Waiting time of each job between its arrival and the start of its service.

    Lindley's recursion: W_0 = 0 and W_i = max(0, W_{i-1} + s_{i-1} - a_i), as a scan over jobs. The closed form
    d_i = S_i + max_{j <= i} (A_j - S_{j-1}) needs no loop, but it computes waits of a few time units as differences of
    clocks that reach tens of thousands. That costs two digits of single precision, and its cumulative sum and maximum
    were the slowest on CPU. The recursion keeps only the current backlog. As an associative scan over jobs it is as
    exact and about as fast; the plain scan is simpler.

    Args:
        service: service times s, shape [J].
        gaps: inter-arrival times a, the first one from time 0 to the first arrival, shape [J].
    """

    def wait(previous, surplus):
        current = jnp.maximum(previous + surplus, 0.0)
        return current, current

    start = jnp.zeros_like(service[0])
    _, waits = lax.scan(wait, start, service[:-1] - gaps[1:])
    return jnp.concatenate([start[None], waits])


def interdeparture_times(service: Float[Array, " jobs"], gaps: Float[Array, " jobs"]) -> Float[Array, " jobs"]:
    """d_i - d_{i-1} = s_i + max(0, u_i - d_{i-1}) for every job, with d_0 = 0 (appendix on M/G/1).

    The server idles before job i for as long as its arrival u_i comes after the departure d_{i-1}, which is
    max(0, a_i - W_{i-1} - s_{i-1}). The first is the time from 0 to the first departure, a_1 + s_1, as in Papamakarios
    and Murray (2016). None is shorter than its service time, even in floating point.

    Args:
        service: service times, shape [J].
        gaps: inter-arrival times, shape [J].
    """
    waits = waiting_times(service, gaps)
    idle = jnp.maximum(gaps[1:] - waits[:-1] - service[:-1], 0.0)
    return service + jnp.concatenate([gaps[:1], idle])


def draw_jobs(
    key: jax.Array, theta: Float[Array, "3"], jobs: int, floor: float = RATE_FLOOR
) -> tuple[Float[Array, " jobs"], Float[Array, " jobs"]]:
    """Service times and inter-arrival times of `jobs` jobs.

    Args:
        key: consumed.
        theta: two bounds of the service time, in either order, and the arrival rate, shape [3].
        jobs: number of jobs J.
        floor: minimum arrival rate; lower ones are raised to it.

    Returns:
        service times, uniform between the bounds, and gaps, exponential with the rate, shape [J] each.
    """
    key_service, key_gaps = jax.random.split(key)
    low, high = jnp.minimum(theta[0], theta[1]), jnp.maximum(theta[0], theta[1])
    service = jax.random.uniform(key_service, (jobs,), minval=low, maxval=high)
    gaps = jax.random.exponential(key_gaps, (jobs,)) / jnp.maximum(theta[2], floor)
    return service, gaps


# ---------------------------------------------------------------------------------------------- observations


def percentiles_of(values: Float[Array, " jobs"], percentiles: Sequence[float]) -> Float[Array, " obs"]:
    """Percentiles of values in any order, linear between order statistics (NumPy's default), shape [S].

    Args:
        values: shape [J].
        percentiles: each in [0, 100].
    """
    position = np.asarray(percentiles, np.float64) / 100.0 * (len(values) - 1)
    below = np.floor(position).astype(int)
    above = np.minimum(below + 1, len(values) - 1)
    ordered = jnp.sort(values)
    return ordered[below] + (position - below).astype(np.float32) * (ordered[above] - ordered[below])


def _as_departed(values: Array) -> Array:
    return values


ORDERS: dict[str, Callable[[Array], Array]] = {"sorted": jnp.sort, "departure": _as_departed}
"""The order in which a trajectory lists its inter-departure times."""


# ------------------------------------------------------------------------------------------------------ whitening


class Whitening(struct.PyTreeNode):
    """An affine map that gives summaries mean 0 and standard deviation 1 over pilot simulations.

    Attributes:
        mean: mean of the pilot simulations' summaries, shape [S].
        matrix: matrix that multiplies centred summaries from the right, shape [S, S].
    """

    mean: Float[Array, " obs"]
    matrix: Float[Array, "obs obs"]

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n obs"]:
        """Whiten summaries."""
        return jnp.matmul(x - self.mean, self.matrix, precision="highest")


def zscore(pilots: np.ndarray) -> Whitening:
    """Standardise each summary separately; a constant one is only centred.

    Args:
        pilots: summaries of pilot simulations, shape [N, S].
    """
    pilots = np.asarray(pilots, np.float64)
    return _whitening(pilots.mean(axis=0), np.eye(pilots.shape[1]), pilots.std(axis=0))


def pca(pilots: np.ndarray) -> Whitening:
    """Principal components, the largest first, each of variance 1: whitening as in Papamakarios and Murray (2016).

    A component's sign is arbitrary; here its largest loading is positive. Directions that do not vary are only
    centred.

    Args:
        pilots: summaries of pilot simulations, shape [N, S].
    """
    pilots = np.asarray(pilots, np.float64)
    variance, axes = np.linalg.eigh(np.cov(pilots, rowvar=False, ddof=0).reshape((pilots.shape[1],) * 2))
    variance, axes = variance[::-1], axes[:, ::-1]
    largest = axes[np.argmax(np.abs(axes), axis=0), np.arange(len(variance))]
    return _whitening(pilots.mean(axis=0), axes * np.sign(largest), np.sqrt(np.maximum(variance, 0.0)))


def _whitening(mean: np.ndarray, axes: np.ndarray, deviation: np.ndarray) -> Whitening:
    scale = np.where(deviation > 1e-6 * (1 + deviation.max()), deviation, 1.0)
    return Whitening(jnp.asarray(mean, jnp.float32), jnp.asarray(axes / scale, jnp.float32))


WHITENINGS: dict[str, Callable[[np.ndarray], Whitening]] = {"zscore": zscore, "pca": pca}
"""Whitenings by name."""


@functools.cache
def pilot(
    jobs: int = 50, percentiles: tuple[float, ...] = PERCENTILES, floor: float = RATE_FLOOR, count: int = 10_000
) -> np.ndarray:
    """Percentiles of simulations from the uniform prior over the "ok" support, the same in every call, shape [N, S].

    Args:
        jobs: number of jobs J.
        percentiles: which percentiles of the inter-departure times, each in [0, 100].
        floor: minimum arrival rate.
        count: number of simulations N.
    """
    key_theta, key_jobs = jax.random.split(jax.random.key(0))
    theta = SUPPORTS["ok"].sample(key_theta, count)

    def one(key, theta):
        return percentiles_of(interdeparture_times(*draw_jobs(key, theta, jobs, floor)), percentiles)

    summaries = np.array(jax.jit(jax.vmap(one))(jax.random.split(key_jobs, count), theta))
    summaries.setflags(write=False)  # one array serves all tasks
    return summaries


# ----------------------------------------------------------------------------------------------------------- task


def task(
    jobs: int = 50,
    percentiles: Sequence[float] = PERCENTILES,
    whiten: Literal["zscore", "pca"] | None = None,
    order: Literal["sorted", "departure"] = "sorted",
    floor: float = RATE_FLOOR,
) -> Task:
    """The M/G/1 queue of the paper: infer service bounds and arrival rate from inter-departure times.

    Service times are U(min, max) of theta_1 and theta_2, each of which has its own range (docs/paper.md, reading K).
    Swapping the first two parameters therefore gives the same queue. If a support contains both (1, 5) and (5, 1), the
    posterior has two equal modes, only one of which counts as correct in the distance from the truth. Papamakarios and
    Murray (2016) instead bound theta_2 - theta_1, which gives one mode.

    A trajectory is the inter-departure times of all jobs in ascending order. In order of departure they are nearly
    independent noise: record by record, a second simulation at the truth is further from an observed one than a
    constant series at the mean. In ascending order the distance of trajectories is the Wasserstein-2 distance of two
    empirical distributions (in units of the observed standard deviation), which is smallest if the distributions
    agree, and nothing that the percentiles use is lost. Your own observation should be sorted too; the summary does not
    depend on the order.

    The summary is percentiles of these times, equally spaced ones by default. They have heavy tails (like the inverse
    of a rate that may be near 0), which `whiten` does not change: it applies an affine map that is fixed before
    inference, as Papamakarios and Murray do. By default, scaling is left to the network's normaliser.

    Simulations never fail.

    Args:
        jobs: number of jobs J.
        percentiles: increasing numbers in [0, 100], at most as many as there are jobs.
        whiten: None, "zscore" or "pca": how the percentiles are whitened with pilot simulations, which are run here.
        order: "sorted" or "departure": how a trajectory lists its times, shape [J].
        floor: minimum arrival rate of simulations, 1 / time.

    Raises:
        ValueError: for numbers, percentiles or names that are not as described.

    Example:
        >>> task().support("ok").high.tolist()
        [10.0, 10.0, 0.3499999940395355]
    """
    percentiles = tuple(float(p) for p in percentiles)
    _check(jobs, percentiles, whiten, order, floor)
    whitening = None if whiten is None else WHITENINGS[whiten](pilot(jobs, percentiles, floor))

    def simulate(key: jax.Array, theta: Float[Array, "3"]) -> Float[Array, " jobs"]:
        return ORDERS[order](interdeparture_times(*draw_jobs(key, theta, jobs, floor)))

    def summary(trajectory: Float[Array, " jobs"]) -> Float[Array, " obs"]:
        x = percentiles_of(trajectory, percentiles)
        return x if whitening is None else whitening(x)

    return Task(
        simulate,
        name="mg1",
        names=NAMES,
        units=("time", "time", "1/time"),
        supports=SUPPORTS,
        feasible=FEASIBLE,
        summary=summary,
        truth=np.array([1.0, 5.0, 0.2]),
        summary_names=_summary_names(percentiles, whiten),
        channels=("inter-departure time",),
        record_label="rank" if order == "sorted" else "job",
        settings={"rounds": 15, "min_rounds": 15},  # appendix C
        hyperparameters={"edge": {"mass_threshold": 0.001}},
    )


def _summary_names(percentiles: tuple[float, ...], whiten: str | None) -> tuple[str, ...]:
    if whiten == "pca":
        return tuple(f"component {i + 1}" for i in range(len(percentiles)))
    return tuple(f"percentile {p:g}" for p in percentiles)


def _check(jobs: int, percentiles: tuple[float, ...], whiten: str | None, order: str, floor: float) -> None:
    if jobs < 1:
        raise ValueError(f"jobs: expected at least 1, got {jobs}")
    if not percentiles or not all(0 <= p <= 100 for p in percentiles):
        raise ValueError(f"percentiles: expected numbers in [0, 100], got {percentiles}")
    if not all(a < b for a, b in itertools.pairwise(percentiles)):
        raise ValueError(f"percentiles: expected increasing numbers, got {percentiles}")
    if jobs < len(percentiles):
        raise ValueError(f"jobs: expected at least as many as the {len(percentiles)} percentiles, got {jobs}")
    if whiten is not None and whiten not in WHITENINGS:
        raise ValueError(f"whiten: expected None or one of {sorted(WHITENINGS)}, got {whiten!r}")
    if order not in ORDERS:
        raise ValueError(f"order: expected one of {sorted(ORDERS)}, got {order!r}")
    ceiling = min(float(box.high[2]) for box in SUPPORTS.values())
    if not (math.isfinite(floor) and 0 < floor < ceiling):
        raise ValueError(f"floor: expected an arrival rate above 0 and below {ceiling:g}, got {floor}")
