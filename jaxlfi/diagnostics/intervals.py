"""Check the credible intervals of posteriors: how often they cover the truth, and by which factor their widths are off.

The interval of a parameter is from the 5 % to the 95 % quantile of its posterior. Stretched about the median by a
factor f, it covers a truth whose distance from the median, in units of the half-interval on that side, is at most f.
The widths' factor is the 90 % quantile of these distances: if they were that much wider, the intervals would have
covered 90 % of the truths. Its confidence interval lies between two order statistics of the distances (no resampling,
exact for any number of truths), which makes it equivalent to the exact binomial interval of the coverage: one excludes
a factor of 1 exactly if the other excludes 90 %.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtr, bdtri

from jaxlfi.diagnostics.arguments import Draws, Truths, checked_ranks, truths_and_draws
from jaxlfi.diagnostics.calibration import SIGNIFICANCE

LEVELS = (0.5, 0.9)
"""Levels of the intervals whose coverage is reported; the last one is judged."""
CONFIDENCE = 0.95
"""Confidence with which the intervals of fractions and factors hold for all parameters together."""
TOLERANCE = 1.5
"""Intervals are found calibrated only if their widths are known to be right to within this factor."""
LEAST_HELD = 0.75
"""Densest regions of the last level, which have no width, need at least this coverage, with confidence."""
FEWEST_DRAWS = 19
"""The next draw lies between the smallest and the largest of this many with the probability of the last level."""
APART = 1e-3
"""How far equal numbers are moved apart, in units of the distance to the next one."""
CALIBRATED, NARROW, WIDE, UNDECIDED = "calibrated", "too narrow", "too wide", "undecided"
BIASED_LOW, BIASED_HIGH = "biased low", "biased high"
"""Words of a verdict; one that is too narrow or too wide may also be biased."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number with its confidence interval.

    Attributes:
        value: the estimate.
        low: lower end of the interval.
        high: upper end.
    """

    value: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Intervals:
    """The verdict on the intervals of one parameter, or on the densest regions of all.

    Attributes:
        truths: number N of truths.
        held: fraction of the truths inside, at each of `LEVELS`.
        factor: factor by which the intervals of the last level would have to be wider; None for regions.
        above: fraction of the truths above the median; None for regions.
        verdict: one or two of the words above.
    """

    truths: int
    held: tuple[Estimate, ...]
    factor: Estimate | None
    above: Estimate | None
    verdict: str


def check_intervals(truths: Truths, draws: Draws) -> list[Intervals]:
    """Judge the intervals of each parameter.

    A parameter is *too narrow* (*too wide*) if the confidence interval of its factor lies above (below) 1, and *biased
    low* (*high*) if that of the truths above the median lies above (below) one half; the width of a biased one is
    judged by distances from where the truths are. Else it is *calibrated* if the factor's interval lies between 1 /
    `TOLERANCE` and `TOLERANCE`, and *undecided* if there are too few truths to tell. No parameter of calibrated
    posteriors is found too narrow, too wide or biased with a probability of at least `CONFIDENCE` - `SIGNIFICANCE`.

    If a truth equals draws, as for whole numbers or values clipped to a bound, it is put below or above each of them
    at random (always the same way): intervals of calibrated posteriors then cover as many truths as they should, too,
    and as many truths lie above the median as below.

    Args:
        truths: parameters from which an observation was simulated, in inference space, shape [N, D], N >= 2.
        draws: from the posterior of each observation, shape [N, L, D], L >= `FEWEST_DRAWS`.

    Returns:
        One per parameter.

    Raises:
        ValueError: for shapes that do not fit, too few truths or draws, numbers that are not finite, or draws that do
            not vary.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> centre = rng.normal(size=(100, 1))
        >>> narrow = centre[:, None] + 0.5 * rng.normal(size=(100, 200, 1))
        >>> check_intervals(centre + rng.normal(size=(100, 1)), narrow)[0].verdict
        'too narrow'
    """
    truths, draws = truths_and_draws(truths, draws)
    if len(truths) < 2 or draws.shape[1] < FEWEST_DRAWS:
        raise ValueError(
            f"truths, draws: expected at least 2 truths and {FEWEST_DRAWS} draws of each, got {len(truths)} and "
            f"{draws.shape[1]}"
        )
    distances = [_shared_out(truths, draws, level) for level in LEVELS]
    return [_one([signed[:, d] for signed in distances], truths.shape[1]) for d in range(truths.shape[1])]


def check_regions(rank: Int[np.ndarray, " n"], draws: int) -> Intervals:
    """Judge densest regions of all parameters together, which have no width and no direction.

    Args:
        rank: of `density_ranks`, shape [N], N >= 2.
        draws: L, at least `FEWEST_DRAWS`.

    Raises:
        ValueError: for ranks that are not whole numbers from 0 to L, and too few truths or draws.
    """
    rank = checked_ranks(rank, draws, FEWEST_DRAWS)
    held = _held([(rank + 0.5) / (draws + 1) <= level for level in LEVELS], 1 - CONFIDENCE)
    last = held[-1]
    otherwise = CALIBRATED if last.low >= LEAST_HELD else UNDECIDED
    verdict = WIDE if last.low >= LEVELS[-1] else NARROW if last.high <= LEVELS[-1] else otherwise
    return Intervals(len(rank), held, None, None, verdict)


def distances_from_median(
    truths: Float[np.ndarray, "n dim"], draws: Float[np.ndarray, "n draws dim"], level: float
) -> Float[np.ndarray, "n dim"]:
    """Distance of each truth from its posterior's median, in half-intervals of that side; negative below.

    The interval covers the truth if this is at most 1 in magnitude. It is infinite if all draws are the same.
    """
    tail = (1 - level) / 2
    # Weibull's quantiles: the next draw lies beyond them with exactly that probability, however few draws there are.
    low, middle, high = np.quantile(draws, [tail, 0.5, 1 - tail], axis=1, method="weibull")
    beyond = truths - middle
    half = np.where(beyond < 0, middle - low, high - middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(beyond == 0, 0.0, beyond / half)


def _shared_out(
    truths: Float[np.ndarray, "n dim"], draws: Float[np.ndarray, "n draws dim"], level: float
) -> Float[np.ndarray, "n dim"]:
    """`distances_from_median`, with equal numbers moved apart at random by negligible amounts."""
    values = np.concatenate([truths[:, None], draws], axis=1)
    gaps = np.diff(np.sort(values, axis=1), axis=1)
    exact = distances_from_median(truths, draws, level)
    if (gaps > 0).all():
        return exact
    nearest = np.min(np.where(gaps > 0, gaps, np.inf), axis=1)
    nearest = np.where(np.isfinite(nearest), nearest, 1.0)[:, None]
    values = values + APART * nearest * np.random.default_rng(0).uniform(-0.5, 0.5, values.shape)
    # A truth beside a posterior without width stays infinitely many widths away.
    return np.where(np.isinf(exact), exact, distances_from_median(values[:, 0], values[:, 1:], level))


def binomial_interval(count: int, trials: int, error: float) -> tuple[float, float]:
    """The exact interval of a probability (Clopper and Pearson 1934).

    Args:
        count: successes.
        trials: number of trials.
        error: largest probability that the interval misses, half of it on either side.
    """
    ends = [1.0 if k == trials else float(bdtri(k, trials, error / 2)) for k in (trials - count, count)]
    return 1 - ends[0], ends[1]


def quantile_interval(values: Float[np.ndarray, " n"], level: float, error: float) -> tuple[float, float]:
    """The interval of a quantile between two order statistics, of any distribution without ties.

    Args:
        values: not negative, shape [N].
        level: of the quantile.
        error: largest probability that the interval misses, half of it on either side.

    Returns:
        Lower end, 0 if no value is low enough, and upper end, infinite if none is high enough.
    """
    ordered = np.concatenate([[0.0], np.sort(values), [np.inf]])
    cumulative = bdtr(np.arange(len(values) + 1), len(values), level)
    low = int(np.sum(cumulative <= error / 2))
    high = 1 + int(np.sum(1 - cumulative[:-1] > error / 2))
    return float(ordered[low]), float(ordered[high])


def _one(signed: list[Float[np.ndarray, " n"]], tests: int) -> Intervals:
    error = (1 - CONFIDENCE) / tests
    held = _held([np.abs(distance) <= 1 for distance in signed], error)
    above = _fraction(signed[-1] > 0, SIGNIFICANCE / tests)
    factor = _factor(signed[-1], error)
    return Intervals(len(signed[-1]), held, factor, above, _verdict(signed[-1], factor, above, error))


def _verdict(signed: Float[np.ndarray, " n"], factor: Estimate, above: Estimate, error: float) -> str:
    words = []
    if not above.low < 0.5 < above.high:
        words.append(BIASED_LOW if above.value > 0.5 else BIASED_HIGH)
        finite = np.isfinite(signed).all()
        factor = _factor(signed - np.median(signed), error) if finite else factor
    if factor.low > 1 or factor.high < 1:
        words.insert(0, NARROW if factor.low > 1 else WIDE)
    known = 1 / TOLERANCE <= factor.low and factor.high <= TOLERANCE
    return ", ".join(words) or (CALIBRATED if known else UNDECIDED)


def _factor(signed: Float[np.ndarray, " n"], error: float) -> Estimate:
    distance = np.abs(signed)
    value = float(np.quantile(distance, LEVELS[-1], method="inverted_cdf"))
    return Estimate(value, *quantile_interval(distance, LEVELS[-1], error))


def _held(inside: list[np.ndarray], error: float) -> tuple[Estimate, ...]:
    return tuple(_fraction(one, error) for one in inside)


def _fraction(true: np.ndarray, error: float) -> Estimate:
    count = int(np.sum(true))
    return Estimate(count / len(true), *binomial_interval(count, len(true), error))
