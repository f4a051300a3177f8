"""The regions that designs are rated over: an inflated posterior, and the box that a heuristic moves to next.

A design that is best for a wrong posterior may be uninformative about the truth. So part of the weight is on the whole
box, and the posterior is inflated in case it is too narrow.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import Posterior, truncated

INFLATION = 2.0
"""Default width of the inflated posterior, relative to the posterior."""
SHARE = 0.2
"""Default weight of the next box."""
POOL = 4096
"""Number of draws from which a region's covariance is computed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """A belief that designs are rated over.

    Attributes:
        weight: weight of the region in a design's value; the weights of all regions sum to one.
        draws: parameters in inference space, shape [N, D].
        covariance: covariance of the draws, shape [D, D].
    """

    weight: float
    draws: Float[np.ndarray, "n dim"]
    covariance: Float[np.ndarray, "dim dim"]

    @property
    def factor(self) -> Float[np.ndarray, "dim dim"]:
        """Lower Cholesky factor of the covariance, regularised for directions that do not vary."""
        scale = np.sqrt(np.maximum(np.diagonal(self.covariance), 1e-30))
        correlation = self.covariance / np.outer(scale, scale)
        return scale[:, None] * np.linalg.cholesky(correlation + 1e-7 * np.eye(len(scale)))


def is_number(value: Any) -> bool:
    """Whether a setting is a Python or NumPy number."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def region(weight: float, draws: np.ndarray) -> Region:
    """The region of some draws [N, D]."""
    draws = np.asarray(draws, np.float64)
    return Region(weight, draws, np.cov(draws, rowvar=False).reshape((draws.shape[1],) * 2))


def regions(
    key: jax.Array,
    posterior: Posterior,
    box: Support,
    feasible: Support,
    inflation: float = INFLATION,
    share: float = SHARE,
) -> tuple[Region, ...]:
    """The inflated posterior, and the next box if its weight is not zero.

    Args:
        key: random key of the draws.
        posterior: posterior of the run.
        box: support that the heuristic has moved to, in inference space.
        feasible: limits Phi of the draws from the inflated posterior.
        inflation: width relative to the posterior, at least 1.
        share: weight of the box, in [0, 1).

    Raises:
        ValueError: for numbers outside these ranges.
    """
    if not (is_number(inflation) and 1 <= inflation < np.inf):
        raise ValueError(f"inflation: expected a number of at least 1, got {inflation!r}")
    if not (is_number(share) and 0 <= share < 1):
        raise ValueError(f"share: expected a number from 0 and below 1, got {share!r}")
    key_wide, key_box = jax.random.split(key)
    mixture = posterior.mixture.inflated(float(inflation))
    wide = truncated(mixture, mixture, feasible, posterior.space, posterior.prior)
    found = [region(1 - share, np.asarray(wide.sample(key_wide, POOL, "inference")))]
    if share:
        found.append(region(share, np.asarray(box.sample(key_box, POOL))))
    return tuple(found)
