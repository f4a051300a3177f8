"""Posterior predictive check: whether the observation looks like what the posterior simulates."""

import dataclasses

import numpy as np
from jaxtyping import Array, Float

MIN_SIMULATIONS = 20
"""Minimum number of finite simulations that a posterior predictive check needs."""
MIN_RESIDUALS = 8
"""Minimum number of simulations for comparing residuals with their scatter."""
FAR = 3.0
"""Residual, in units of the simulations' scatter, above which a model is reported to lack something."""
FURTHER = 1.5
"""Factor by which it must also exceed the farthest simulation's: smooth series have few degrees of freedom."""
REACH = 2.0
"""Robust standard deviations at which values are clipped before means and correlations are taken."""


@dataclasses.dataclass(frozen=True)
class PredictiveCheck:
    """How unusual an observation is among N simulations.

    Attributes:
        tails: two-sided tail probability of each summary by itself, shape [S].
        p_value: fraction of the observation and the simulations that are at least as far from all as the observation.
        distance: of the observation from all, about 1 for a typical one.
        distances: of the simulations, shape [N].
        failed: simulations left out because they were not finite.
    """

    tails: Float[np.ndarray, " obs"]
    p_value: float
    distance: float
    distances: Float[np.ndarray, " n"]
    failed: int


@dataclasses.dataclass(frozen=True)
class Residual:
    """How far an observation is from simulations from the posterior, in one channel.

    Attributes:
        ratio: root mean square of the observation minus the simulations' mean, in units of their scatter; about 1 if
            the observation is one of them. NaN if they do not scatter.
        usual: the largest ratio among the simulations, each against the others, in any channel.
    """

    ratio: float
    usual: float

    @property
    def far(self) -> bool:
        """Whether the model lacks something: the ratio is at least `FAR`, and `FURTHER` than any simulation's."""
        return self.ratio >= FAR and self.ratio > FURTHER * self.usual


def residuals(
    simulated: Float[Array | np.ndarray, "n time channels"], observed: Float[Array | np.ndarray, "time channels"]
) -> list[Residual]:
    """Compare an observed series with simulations of posterior draws, channel by channel.

    The scatter is the standard deviation of the simulations over all records of a channel: due to the noise, and to the
    uncertainty of the parameters. A correct model has ratios of about 1, with many records or few.

    Args:
        simulated: N finite simulations, at least `MIN_RESIDUALS`.
        observed: in the same shape; NaN where a number is missing, which is then left out of the simulations, too.

    Raises:
        ValueError: for other shapes, and too few simulations.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> simulated = rng.normal(size=(20, 50, 2))
        >>> [one.far for one in residuals(simulated, rng.normal(size=(50, 2)) + [0.0, 9.0])]
        [False, True]
    """
    simulated, observed = np.asarray(simulated, np.float64), np.asarray(observed, np.float64)
    if simulated.ndim != 3 or simulated.shape[1:] != observed.shape or len(simulated) < MIN_RESIDUALS:
        raise ValueError(
            f"simulated, observed: expected shapes [N, T, C] with N of at least {MIN_RESIDUALS} and [T, C], got "
            f"{list(simulated.shape)} and {list(observed.shape)}"
        )
    there = np.isfinite(observed)
    observed = np.where(there, observed, 0.0)
    each = [_ratio(simulated[j], np.delete(simulated, j, axis=0), there) for j in range(len(simulated))]
    usual = float(np.max(np.nan_to_num(each)))
    return [Residual(float(ratio), usual) for ratio in _ratio(observed, simulated, there)]


def _ratio(one: np.ndarray, others: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Root mean square distance from the others' mean, relative to what it is expected to be, by channel.

    Sums are over the records that are there; their number cancels.
    """
    expected = (1 + 1 / len(others)) * np.sum(others.var(axis=0, ddof=1), axis=0, where=there)
    away = np.sum((one - others.mean(axis=0)) ** 2, axis=0, where=there)
    known = expected > 1e-12 * np.sum(np.mean(others**2, axis=0), axis=0, where=there)
    return np.sqrt(np.where(known, away / np.where(known, expected, 1.0), np.nan))


def predictive_check(
    simulated: Float[Array | np.ndarray, "n obs"], observed: Float[Array | np.ndarray, " obs"]
) -> PredictiveCheck:
    """Compare an observed summary with those of simulations at posterior draws (Gelman, Meng and Stern 1996).

    Each summary by itself is ranked among the simulated ones. All together are ranked by their Mahalanobis distance
    from the centre of the simulations *and* the observation: if the observation were one of them, its rank would be
    uniform, so the p-value is exact for any number of summaries and however they are scaled. So that a few wild
    simulations do not set the scale, summaries are first centred by their median, scaled by their median absolute
    deviation and compressed in the tails (inverse hyperbolic sine), and values that are still far out are clipped
    before moments are taken; so that there may be more summaries than simulations, correlations are shrunk towards
    zero.

    A posterior that has seen the observation is expected to explain it: a small p-value is a strong sign that the
    simulator, or the support, cannot; a p-value that is not small is a weak sign that it can.

    Args:
        simulated: summaries, shape [N, S]; rows that are not finite are left out and counted.
        observed: shape [S].

    Raises:
        ValueError: for shapes that do not fit, an observation that is not finite, or too few
            finite rows (`MIN_SIMULATIONS`), or none that differs from the others.
    """
    simulated, observed = np.asarray(simulated, np.float64), np.asarray(observed, np.float64)
    if simulated.ndim != 2 or observed.shape != simulated.shape[1:] or not np.isfinite(observed).all():
        raise ValueError(
            f"simulated, observed: expected shapes [N, S] and [S] and a finite observation, "
            f"got {list(simulated.shape)} and {list(observed.shape)}"
        )
    valid = np.isfinite(simulated).all(axis=1)
    used = simulated[valid]
    if len(used) < MIN_SIMULATIONS:
        raise ValueError(
            f"simulated: expected at least {MIN_SIMULATIONS} finite rows, got {len(used)} of {len(simulated)}"
        )
    if not np.ptp(used, axis=0).any():
        raise ValueError(f"simulated: expected summaries that vary, got the same in all of {len(used)} rows")
    below, above = np.sum(used <= observed, axis=0), np.sum(used >= observed, axis=0)
    tails = np.minimum(1.0, 2 * (1 + np.minimum(below, above)) / (1 + len(used)))
    distances = _distances(np.concatenate([observed[None], used]))
    p_value = np.mean(distances >= distances[0])
    return PredictiveCheck(tails, float(p_value), float(distances[0]), distances[1:], int(np.sum(~valid)))


def _distances(rows: np.ndarray) -> np.ndarray:
    """Robust Mahalanobis distance of each row from all rows, per summary; the same for rows in any order."""
    count, size = rows.shape
    centred = rows - np.median(rows, axis=0)
    scale = 1.4826 * np.median(np.abs(centred), axis=0)
    deviation = np.std(rows, axis=0)
    scale = np.where(scale > 0, scale, np.where(deviation > 0, deviation, 1.0))
    z = np.arcsinh(centred / scale)
    near = np.clip(z, -REACH, REACH)
    mean, deviation = np.mean(near, axis=0), np.std(near, axis=0)
    deviation = np.where(deviation > 0, deviation, 1.0)
    z, near = (z - mean) / deviation, (near - mean) / deviation
    shrinkage = size / (size + count)
    correlation = (1 - shrinkage) * (near.T @ near) / count + shrinkage * np.eye(size)
    return np.sqrt(np.mean(z * np.linalg.solve(correlation, z.T).T, axis=1))
