"""Calibration: do posteriors cover truths as often as they should, over many observations?

Every check here turns a truth into its rank among L draws from its posterior: of the parameter itself, of the
density, or of the distance from a random point. Of a calibrated posterior, the truth and the draws are draws of the
same distribution, and each rank from 0 to L is equally likely.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.diagnostics.arguments import Draws, Truths, checked_ranks, numbers, truths_and_draws
from jaxlfi.distributions.arguments import is_concrete

SIGNIFICANCE = 0.01
"""p-value below which a check fails: of five checks of a calibrated posterior, one fails in one run out of twenty."""
POINTWISE = 0.95
"""Probability that one point of a calibrated curve, or one bar of its histogram, lies in its pointwise band."""
POINTS = 50
"""Maximum number of points at which a calibration curve is evaluated."""
NULL_DRAWS = 10_000
"""Number of simulated calibrated curves that the simultaneous band and the p-value are computed from."""
NO_RANK = -1
"""In place of a rank among numbers that are NaN, where they are not known when a rank is asked for (under jit)."""
OK = "ok"
OVER, UNDER = "miscalibrated: over-confident", "miscalibrated: under-confident"
LOW, HIGH = "miscalibrated: biased low", "miscalibrated: biased high"


@dataclasses.dataclass(frozen=True)
class Uniformity:
    """Whether ranks are uniform; K points, bands as [2, K] of lower and upper ends.

    Attributes:
        level: fractions of the ranks looked at, shape [K].
        fraction: of the truths whose rank lies in them, shape [K]; the level itself for a calibrated posterior.
        pointwise: band that a calibrated curve leaves at one given point with probability 1 - `POINTWISE`, binomial.
        simultaneous: band that it leaves anywhere with probability `SIGNIFICANCE` at most.
        worst: the level at which the curve deviates most.
        p_value: probability that a calibrated curve deviates as far, `SIGNIFICANCE` or less if it leaves that band.
        shift: how far the mean rank is off, in standard errors: negative where truths are below their draws.
        dispersion: how much farther from the middle one the ranks are than they should be, in standard errors: positive
            where truths are at either end of their draws.
    """

    level: Float[np.ndarray, " points"]
    fraction: Float[np.ndarray, " points"]
    pointwise: Float[np.ndarray, "2 points"]
    simultaneous: Float[np.ndarray, "2 points"]
    worst: float
    p_value: float
    shift: float
    dispersion: float

    def fraction_at(self, level: float) -> float:
        """Fraction of the truths at a level, between the points."""
        return float(np.interp(level, [0.0, *self.level, 1.0], [0.0, *self.fraction, 1.0]))


@dataclasses.dataclass(frozen=True)
class Histogram:
    """Ranks in B bins of as nearly equal widths as whole ranks allow.

    Attributes:
        edges: first rank of each bin and one past the last, shape [B + 1].
        count: truths in each bin, shape [B].
        expected: of a calibrated posterior, shape [B].
        band: lower and upper ends of the binomial band of each bin by itself (`POINTWISE`), shape [2, B].
    """

    edges: Int[np.ndarray, " edges"]
    count: Int[np.ndarray, " bins"]
    expected: Float[np.ndarray, " bins"]
    band: Float[np.ndarray, "2 bins"]


def ranks(key: jax.Array, truths: Truths, draws: Draws) -> Int[Array, "n dim"]:
    """How many of L draws are below the truth, for each parameter: simulation-based calibration (Talts et al. 2018).

    Draws equal to the truth, as for whole numbers or values clipped to a bound, are put below or above it at random:
    the rank of a calibrated posterior then stays uniform, which it would not with midranks. Known numbers are compared
    in the precision in which they are given.

    Args:
        key: consumed.
        truths: parameters from which an observation was simulated, in inference space, shape [N, D].
        draws: from the posterior of each observation, shape [N, L, D].

    Returns:
        Ranks from 0 to L.

    Raises:
        ValueError: for shapes that do not fit, numbers that are not finite, or draws that do not vary.
    """
    return _ranks(key, *truths_and_draws(truths, draws))


def _ranks(key: jax.Array, truths: Truths, draws: Draws):
    below, equal = (draws < truths[:, None]).sum(axis=1), (draws == truths[:, None]).sum(axis=1)
    rank = below + jax.random.randint(key, below.shape, 0, equal + 1)
    return jnp.where(jnp.isnan(truths) | jnp.isnan(draws).any(axis=1), NO_RANK, rank)


def density_ranks(
    key: jax.Array, truth_log_prob: Float[Array | np.ndarray, " n"], log_prob: Float[Array | np.ndarray, "n draws"]
) -> Int[Array, " n"]:
    """How many of L draws have a higher posterior density than the truth: expected coverage (Hermans et al. 2022).

    The truth lies in the highest-density region of level c if its rank is below c (L + 1), so the fraction of truths
    with such ranks is the coverage of these regions.

    Args:
        key: consumed, for ties.
        truth_log_prob: log-density of each truth, up to a constant of its observation; -inf outside the support.
        log_prob: of the draws, shape [N, L].

    Raises:
        ValueError: for shapes that do not fit, or NaN.
    """
    truth_log_prob = numbers("truth_log_prob", truth_log_prob, "N", nan_only=True)
    log_prob = numbers("log_prob", log_prob, "NL", nan_only=True)
    if len(truth_log_prob) != len(log_prob):
        raise ValueError(
            f"truth_log_prob, log_prob: expected shapes [N] and [N, L], got {list(truth_log_prob.shape)} and "
            f"{list(log_prob.shape)}"
        )
    return _ranks(key, -truth_log_prob[:, None], -log_prob[..., None])[:, 0]


def distance_ranks(
    key: jax.Array,
    truths: Truths,
    draws: Draws,
    low: Float[Array | np.ndarray, " dim"],
    high: Float[Array | np.ndarray, " dim"],
) -> Int[Array, " n"]:
    """How many of L draws are nearer to a random point than the truth is: TARP (Lemos et al. 2023).

    Each truth has a point of its own, uniform over the prior's box, and distances are Euclidean in units of the box.

    Args:
        key: consumed.
        truths: shape [N, D].
        draws: shape [N, L, D].
        low: lower bounds of the prior's box, shape [D].
        high: upper bounds, shape [D].

    Raises:
        ValueError: for shapes that do not fit, numbers that are not finite, draws that do not vary, or an empty box.
    """
    truths, draws = truths_and_draws(truths, draws)
    low, high = numbers("low", low, "D"), numbers("high", high, "D")
    if not low.shape == high.shape == truths.shape[1:]:
        raise ValueError(
            f"low, high: expected shapes [{truths.shape[1]}], got {list(low.shape)} and {list(high.shape)}"
        )
    if is_concrete((low, high)) and not (low < high).all():
        raise ValueError(f"low, high: expected low < high, got {low.tolist()} and {high.tolist()}")
    key_point, key_ties = jax.random.split(key)
    place: Any = jax.random.uniform(key_point, truths.shape)
    place = np.asarray(place, np.float64) if is_concrete((place, truths, draws, low, high)) else place
    point = low + (high - low) * place
    distance = lambda theta, point: ((((theta - point) / (high - low)) ** 2).sum(axis=-1)) ** 0.5
    return _ranks(key_ties, distance(truths, point)[:, None], distance(draws, point[:, None])[..., None])[:, 0]


def uniformity(rank: Int[Array | np.ndarray, " n"], draws: int, tests: int = 1) -> Uniformity:
    """Test whether ranks from 0 to L are uniform, by their cumulative distribution.

    At each of up to `POINTS` levels the number of truths of lower rank is binomial. The statistic is the smallest
    two-sided binomial tail probability over the levels; its distribution for calibrated posteriors is simulated, and
    so is the simultaneous band, which is as hard to leave at every level (Säilynoja, Bürkner and Vehtari 2022). Unlike
    the band of Kolmogorov and Smirnov it narrows towards both ends, where ranks pile up if a posterior is too narrow.

    Args:
        rank: shape [N].
        draws: L.
        tests: number of tests made together, such as one per parameter: p-value and band are corrected for them, by
            Bonferroni.

    Raises:
        ValueError: for ranks that are not whole numbers from 0 to L, or too few.
    """
    rank = checked_ranks(rank, draws)
    count = len(rank)
    if tests < 1:
        raise ValueError(f"tests: expected at least 1, got {tests}")
    edges = _edges(draws)
    level = edges / (draws + 1)
    below = np.sum(rank[:, None] < edges, axis=0)
    tails = _two_sided(count, level)
    null = _null(count, draws)
    place = np.arange(len(edges))
    p_values = np.minimum(1.0, tests * (1 + np.searchsorted(null, tails, side="right")) / (1 + NULL_DRAWS))
    middle = 2 * (rank + 0.5) / (draws + 1) - 1
    return Uniformity(
        level=level,
        fraction=below / count,
        pointwise=_band(tails > 1 - POINTWISE) / count,
        simultaneous=_band(p_values > SIGNIFICANCE) / count,
        worst=float(level[np.argmin(tails[place, below])]),
        p_value=float(np.min(p_values[place, below])),
        # Of a uniform variable on [-1, 1] the second moment is 1/3, with a variance of 4/45.
        shift=float(np.mean(middle) * np.sqrt(3 * count)),
        dispersion=float((np.mean(middle**2) - 1 / 3) * np.sqrt(45 * count / 4)),
    )


def histogram(rank: Int[Array | np.ndarray, " n"], draws: int) -> Histogram:
    """A histogram of ranks from 0 to L with its binomial band, of some ten truths a bin and at most 20 bins.

    Raises:
        ValueError: for ranks that are not whole numbers from 0 to L, or too few.
    """
    rank = checked_ranks(rank, draws)
    bins = int(np.clip(len(rank) // 10, 2, min(20, draws + 1)))
    edges = np.round(np.linspace(0, draws + 1, bins + 1)).astype(int)
    probability = np.diff(edges) / (draws + 1)
    count = np.histogram(rank, edges - 0.5)[0]
    return Histogram(edges, count, len(rank) * probability, _band(_two_sided(len(rank), probability) > 1 - POINTWISE))


def ranks_verdict(result: Uniformity) -> str:
    """The verdict on a parameter's ranks, in words.

    Ranks that crowd at both ends mean that posteriors are too narrow, in the middle too wide; truths below their draws
    mean that posteriors are too high.
    """
    if result.p_value > SIGNIFICANCE:
        return OK
    if abs(result.shift) > abs(result.dispersion):
        return HIGH if result.shift < 0 else LOW
    return OVER if result.dispersion > 0 else UNDER


def coverage_verdict(result: Uniformity) -> str:
    """The verdict on density ranks: truths at low densities mean that posteriors are too narrow, or misplaced."""
    if result.p_value > SIGNIFICANCE:
        return OK
    return OVER if result.shift > 0 else UNDER


def distance_verdict(result: Uniformity) -> str:
    """The verdict on ranks of distances from random points.

    If the points are near, truths beyond the draws mean that posteriors are too narrow (or misplaced); if they are far
    to one side or the other, truths at either end of the draws do.
    """
    if result.p_value > SIGNIFICANCE:
        return OK
    return OVER if max(result.shift, result.dispersion, key=abs) > 0 else UNDER


def _edges(draws: int) -> np.ndarray:
    """The ranks below which truths are counted, at most `POINTS` of 1 to L."""
    return np.unique(np.round(np.linspace(1, draws, min(draws, POINTS))).astype(int))


def _two_sided(count: int, probability: np.ndarray) -> np.ndarray:
    """Probability that a binomial count is as far out as each of 0 to N, or farther, shape [K, N + 1]."""
    # Not SciPy's tails: they round mirrored counts differently, so that equal probabilities would not tie.
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count + 1)))])
    k = np.arange(count + 1)
    log_choose = log_factorial[-1] - log_factorial - log_factorial[::-1]
    mass = np.exp(log_choose + k * np.log(probability)[:, None] + (count - k) * np.log1p(-probability)[:, None])
    below, above = np.cumsum(mass, axis=1), np.cumsum(mass[:, ::-1], axis=1)[:, ::-1]
    return np.minimum(1.0, 2 * np.minimum(below, above))


@functools.lru_cache(maxsize=16)
def _null(count: int, draws: int) -> np.ndarray:
    """Smallest tail probabilities of calibrated curves, in ascending order; always the same."""
    edges = _edges(draws)
    probability = np.diff([0, *edges, draws + 1]) / (draws + 1)
    below = np.cumsum(np.random.default_rng(0).multinomial(count, probability, NULL_DRAWS), axis=1)[:, :-1]
    tails = _two_sided(count, edges / (draws + 1))
    return np.sort(np.min(tails[np.arange(len(edges)), below], axis=1))


def _band(inside: np.ndarray) -> np.ndarray:
    """Smallest and largest count that is inside, for each row [K, N + 1], shape [2, K]."""
    return np.stack([np.argmax(inside, axis=1), inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)]).astype(float)
