"""The ridge of a posterior: the direction that it determines worst, and what experiments do to it."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxlfi.design.fisher import covariance_after
from jaxlfi.design.regions import Region
from jaxlfi.diagnostics.identifiability import trade_offs

PART = 0.25
"""Parameters that change by less than this part of what changes most are left out of a direction's words."""
BROKEN = 2.0
"""How many times narrower a direction has to become for its ridge to count as broken."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ridge:
    """The worst-determined direction of a posterior, in widths of the support that inference began with.

    Attributes:
        name: what varies, in words, such as "mass * gear * damping".
        known: what is known of these parameters together, in words; "" where they do not trade off.
        row: the combination of parameters, in inference space, that varies most, shape [D].
        deviation: its standard deviation, in widths of the support.
    """

    name: str
    known: str
    row: Float[np.ndarray, " dim"]
    deviation: float

    def narrower(self, posterior: Region, matrices: Float[np.ndarray, "*n dim dim"]) -> Float[np.ndarray, "*n"]:
        """How many times narrower it becomes where experiments have some Fisher information."""
        after = covariance_after(posterior.factor, matrices)
        return self.deviation / np.sqrt(np.einsum("i,...ij,j", self.row, after, self.row))


def ridge(
    names: Sequence[str],
    log: Sequence[bool],
    posterior: Region,
    natural: Float[np.ndarray, "n dim"],
    widths: Float[np.ndarray, " dim"],
) -> Ridge:
    """The ridge of draws of a posterior.

    Args:
        names: of the parameters.
        log: which are inferred as logarithms.
        posterior: its draws in inference space.
        natural: the same in natural units.
        widths: of the support that inference began with, in inference space.

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
