"""Where designs are rated: over a posterior made wider, and over the box that a heuristic moves to next.

A design that is best for a wrong posterior may tell nothing of the truth. So a part of the weight is on the whole box,
and the posterior itself is not trusted to be as narrow as it says.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import Posterior, truncated

INFLATION = 2.0
"""How many times as wide as the posterior designs are rated over, by default."""
SHARE = 0.2
"""Weight of the next box, by default."""
POOL = 4096
"""Draws that a region's covariance is taken of."""


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """A belief that designs are rated over.

    Attributes:
        weight: of what a design is worth here; those of all regions sum to one.
        draws: parameters in inference space, shape [N, D].
        covariance: theirs, shape [D, D].
    """

    weight: float
    draws: Float[np.ndarray, "n dim"]
    covariance: Float[np.ndarray, "dim dim"]

    @property
    def factor(self) -> Float[np.ndarray, "dim dim"]:
        """Lower Cholesky factor of the covariance; directions that do not vary at all are given next to nothing."""
        scale = np.sqrt(np.maximum(np.diagonal(self.covariance), 1e-30))
        correlation = self.covariance / np.outer(scale, scale)
        return scale[:, None] * np.linalg.cholesky(correlation + 1e-7 * np.eye(len(scale)))


def is_number(value: Any) -> bool:
    """Whether a setting is a number, of Python's or NumPy's."""
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
    """The posterior inflated, and the next box where it has a share.

    Args:
        key: of the draws.
        posterior: of the run.
        box: the support that the heuristic has moved to, in inference space.
        feasible: Phi, which no draw leaves.
        inflation: how many times as wide as the posterior, from 1.
        share: weight of the box, from 0 and below 1.

    Raises:
        ValueError: for numbers outside of these.
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
