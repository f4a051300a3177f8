"""The ridge of a posterior: its worst-determined direction, and how much experiments narrow it."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxlfi.design.fisher import covariance_after
from jaxlfi.design.regions import Region
from jaxlfi.diagnostics.identifiability import trade_offs

PART = 0.25
"""Parameters whose change is less than this fraction of the largest are left out of a direction's description."""
BROKEN = 2.0
"""Factor by which a direction must become narrower for its ridge to count as broken."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ridge:
    """The worst-determined direction of a posterior, in widths of the initial support of the inference.

    Attributes:
        name: description of the direction, such as "mass * gear * damping".
        known: well-determined combinations of these parameters, in words; "" if they do not trade off.
        row: parameter combination that varies most, in inference space, shape [D].
        deviation: standard deviation of this combination, in widths of the support.
    """

    name: str
    known: str
    row: Float[np.ndarray, " dim"]
    deviation: float

    def narrower(self, posterior: Region, matrices: Float[np.ndarray, "*n dim dim"]) -> Float[np.ndarray, "*n"]:
        """Factor by which experiments with this Fisher information make it narrower."""
        after = covariance_after(posterior.factor, matrices)
        return self.deviation / np.sqrt(np.einsum("i,...ij,j", self.row, after, self.row))


def ridge(
    names: Sequence[str],
    log: Sequence[bool],
    posterior: Region,
    natural: Float[np.ndarray, "n dim"],
    widths: Float[np.ndarray, " dim"],
) -> Ridge:
    """The ridge of a posterior, from its draws.

    Args:
        names: names of the parameters.
        log: which parameters are inferred as logarithms.
        posterior: draws of the posterior in inference space, with their covariance.
        natural: the same draws in natural units.
        widths: widths of the initial support of the inference, in inference space.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> level, ratio = rng.normal(0.0, 0.5, 1000), rng.normal(0.0, 0.02, 1000)
        >>> draws = np.stack([level + ratio, level], axis=1)
        >>> from jaxlfi.design.regions import region
        >>> found = ridge(["mass", "gear"], [True, True], region(1.0, draws), np.exp(draws), np.ones(2))
        >>> found.name, found.known
        ('mass * gear', 'mass / gear')
    """
    scaled = posterior.covariance / np.outer(widths, widths)
    variance, axes = np.linalg.eigh(scaled)
    direction = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1])
    row = direction / widths
    places = np.flatnonzero(np.abs(direction) >= PART * np.abs(direction).max())
    for one in trade_offs(names, natural):
        if set(places) & set(one.places) and len(places) > 1:
            return Ridge(" and ".join(one.unknown), " and ".join(one.known), row, float(np.sqrt(variance[-1])))
    words = " with ".join(f"ln {names[d]}" if log[d] and len(places) > 1 else names[d] for d in places.tolist())
    return Ridge(words, "", row, float(np.sqrt(variance[-1])))
