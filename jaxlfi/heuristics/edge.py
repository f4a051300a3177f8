"""EDGE: stretch a bound that posterior mass piles up against (Algorithm 2)."""

import jax
import jax.numpy as jnp

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics.base import Adaptation, Heuristic, Value, adapted, stretch


class Edge(Heuristic):
    """Edge-driven Gaussian expansion (Algorithm 2; defaults of section V, except the threshold).

    A bound moves out by `expansion` times the width if the marginal mass in the zone along it exceeds `mass_threshold`.
    If the observation says nothing about a parameter, its posterior is uniform, with a tenth of its mass in either
    zone. The default threshold is above that, so a bound moves only if there is evidence against it; with the paper's
    0.005, which the preset "paper" keeps, such bounds move until they reach Phi.

    All hyperparameters are leaves, scalar or with one value per dimension, and can be vmapped over.

    Attributes:
        zone_fraction: delta as a fraction of the current width, the text's reading.
        mass_threshold: tau, the marginal mass above which a bound moves.
        expansion: eta, the step as a fraction of the current width.
        zone_width: an absolute width added to the zone: delta as Algorithm 2 writes it is
            `Edge(zone_fraction=0.0, zone_width=0.1)` (docs/paper.md, reading F).
        tail: the fraction of the mass *beyond* the bound that counts as lying in the zone. 1 counts all of it, as
            clipping would, so that EDGE still works when the mode itself has left the box; 0 counts the zone alone
            (docs/paper.md, reading G).

    Example:
        >>> Edge(mass_threshold=0.005).mass_threshold  # the paper's
        0.005
    """

    zone_fraction: Value = hyperparameter(
        default=0.1,
        help="width of the zone along a bound, as a fraction of the support's width",
        symbol="delta",
        low=0,
        high=1,
    )
    mass_threshold: Value = hyperparameter(
        default=0.12, help="posterior mass in the zone above which the bound moves", symbol="tau", low=0, high=1
    )
    expansion: Value = hyperparameter(
        default=0.2, help="how far a bound moves, as a fraction of the support's width", symbol="eta", low=0
    )
    zone_width: Value = hyperparameter(
        default=0.0,
        help="width of the zone along a bound, in the parameter's units, added to the fraction",
        symbol="delta",
        low=0,
    )
    tail: Value = hyperparameter(
        default=1.0, help="fraction of the mass beyond the bound that counts as in the zone", low=0, high=1
    )

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Algorithm 2, over all dimensions at once; the evidence is the two edge masses M_L and M_R, shape [D]."""
        box = previous.support
        zone = self.zone_fraction * box.width + self.zone_width
        # The zones along both bounds, and all that is beyond these.
        low = jnp.stack([box.low, box.high - zone, jnp.full_like(box.low, -jnp.inf), box.high])
        high = jnp.stack([box.low + zone, box.high, box.low, jnp.full_like(box.low, jnp.inf)])
        in_zones, beyond = jax.vmap(posterior.interval_mass)(low, high).reshape(2, 2, -1)
        mass_left, mass_right = in_zones + self.tail * beyond
        support = stretch(
            box, feasible, mass_left > self.mass_threshold, mass_right > self.mass_threshold, self.expansion
        )
        return adapted(previous, posterior, support, {"mass_left": mass_left, "mass_right": mass_right})
