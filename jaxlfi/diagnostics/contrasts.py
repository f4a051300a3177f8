"""Differences of two arms of a study: their intervals, p-values and sizes, where runs are nested and places shared.

An arm has results [O, S, P]: on O objects, of S policies (training seeds), at P places. Each of these is a sample. So a
resample draws objects, policies on each of these, and places, all with replacement (the hierarchical bootstrap);
objects and places are the same for both arms, as both met them. If an arm's policies are the same on all objects, as
those that were trained without knowing any, seeds are drawn once for all objects.

With few objects percentile intervals are too narrow: the bootstrap's variance between O objects is (O - 1) / O of the
unbiased one. With one object they say nothing about others.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

RESAMPLES = 4000
LEVEL = 0.95


@dataclasses.dataclass(frozen=True, eq=False)
class Arm:
    """Results of one way to train.

    Attributes:
        values: larger is better, shape [O, S, P].
        shared: whether policy s is the same one on all objects.

    Raises:
        ValueError: for other shapes, and numbers that are not finite.
    """

    values: Float[np.ndarray, "objects seeds places"]
    shared: bool = False

    def __post_init__(self):
        values = np.asarray(self.values, float)
        if values.ndim != 3 or 0 in values.shape or not np.isfinite(values).all():
            raise ValueError(f"values: expected finite numbers [objects, seeds, places], got shape {values.shape}")
        object.__setattr__(self, "values", values)


@dataclasses.dataclass(frozen=True)
class Contrast:
    """The difference between two arms.

    Attributes:
        difference: of the means.
        low: lower end of its interval.
        high: upper end.
        p: two-sided p-value of no difference: below 1 - level exactly if the interval excludes zero.
        standardised: the difference in standard deviations of policies' means within objects (Hedges' g); NaN where
            these do not vary, or no object has two policies.
        superiority: how often a policy of the first arm is ahead of one of the second on the same object, ties counting
            half (Vargha and Delaney's A).
    """

    difference: float
    low: float
    high: float
    p: float
    standardised: float
    superiority: float


def contrast(one: Arm, other: Arm, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0) -> Contrast:
    """The mean of one arm minus the mean of another, on the same objects and at the same places.

    Args:
        one: the arm that should be ahead.
        other: with as many objects and places; seeds may be fewer or more.
        level: of the interval.
        resamples: number of bootstrap resamples.
        seed: of these.

    Raises:
        ValueError: for different numbers of objects or places.

    Example:
        >>> found = contrast(Arm(np.full((2, 3, 4), 1.5)), Arm(np.ones((2, 3, 4))))
        >>> found.difference, found.low, found.superiority
        (0.5, 0.5, 1.0)
    """
    sizes = [(arm.values.shape[0], arm.values.shape[2]) for arm in (one, other)]
    if sizes[0] != sizes[1]:
        raise ValueError(f"other: expected objects and places {list(sizes[0])}, got {list(sizes[1])}")
    drawn = resampled(one, other, resamples, seed)
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    # The sample itself counts as a resample, so that no p is zero.
    tail = min(np.sum(drawn <= 0), np.sum(drawn >= 0))
    p = min(1.0, 2 * (tail + 1) / (resamples + 1))
    difference = float(one.values.mean() - other.values.mean())
    return Contrast(difference, float(low), float(high), p, standardised(one, other), superiority(one, other))


def resampled(one: Arm, other: Arm, resamples: int, seed: int) -> Float[np.ndarray, " resamples"]:
    """Differences of the means of resamples; see the module."""
    rng = np.random.default_rng(seed)
    objects, _, places = one.values.shape
    at = rng.integers(objects, size=(resamples, objects))
    weights = rng.multinomial(places, np.full(places, 1 / places), resamples) / places

    def means(arm: Arm) -> np.ndarray:
        seeds = arm.values.shape[1]
        size = (resamples, 1 if arm.shared else objects)
        shares = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size) / seeds
        own = np.take_along_axis(np.einsum("osp,bp->bos", arm.values, weights), at[:, :, None], axis=1)
        return (own * shares).sum(axis=2).mean(axis=1)

    return means(one) - means(other)


def standardised(one: Arm, other: Arm) -> float:
    """Hedges' g of policies' means over places; their standard deviation is pooled within arms and objects."""
    every = [arm.values.mean(axis=2) for arm in (one, other)]
    freedom = sum(means.shape[0] * (means.shape[1] - 1) for means in every)
    squares = sum(float(np.sum((means - means.mean(axis=1, keepdims=True)) ** 2)) for means in every)
    if freedom < 1 or squares == 0.0:
        return float("nan")
    unbiased = 1 - 3 / (4 * freedom - 1)
    return float(unbiased * (every[0].mean() - every[1].mean()) / np.sqrt(squares / freedom))


def superiority(one: Arm, other: Arm) -> float:
    """The fraction of pairs of policies on an object in which the first arm's mean is ahead; ties count half."""
    ours, theirs = (arm.values.mean(axis=2) for arm in (one, other))
    gaps = ours[:, :, None] - theirs[:, None, :]
    return float(np.mean((gaps > 0) + 0.5 * (gaps == 0)))


def holm(p: Sequence[float] | Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Holm's adjusted p-values (1979): each below a level exactly if the step-down procedure rejects at that level.

    Args:
        p: of the hypotheses of one family, in any order.

    Raises:
        ValueError: for numbers that are not probabilities.

    Example:
        >>> holm([0.04, 0.01, 0.03]).round(3).tolist()
        [0.06, 0.03, 0.06]
    """
    p = np.asarray(p, float)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"p: expected numbers from 0 to 1, got {p.tolist()}")
    order = np.argsort(p, kind="stable")
    raised = np.maximum.accumulate(np.minimum(1.0, p[order] * np.arange(len(p), 0, -1)))
    adjusted = np.empty(len(p))
    adjusted[order] = raised
    return adjusted
