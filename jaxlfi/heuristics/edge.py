"""EDGE: stretch a bound that posterior mass piles up against (Algorithm 2)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics.base import Adaptation, Heuristic, Value, adapted, stretch


class Edge(Heuristic):
    """Edge-driven Gaussian expansion (Algorithm 2; defaults of section V, except the threshold).

    A bound moves out by `expansion` times the width if the marginal mass in the zone along it exceeds a threshold. If
    the observation is uninformative about a parameter, its posterior is uniform, with a tenth of its mass in either
    zone, and the default threshold is above that. An estimate of a uniform posterior also leans to one side or the
    other, so the threshold is higher for a posterior that is nearly as wide as its support: it is `mass_threshold`
    times 1 for a narrow posterior, times `uninformed_factor` for a uniform one, and in between it rises linearly with
    the variance. So a bound moves only if there is evidence against it. With the paper's 0.005 and 1, which the preset
    "paper" keeps, bounds of such parameters move until they reach Phi.

    All hyperparameters are leaves, scalar or with one value per dimension, and can be vmapped over.

    Attributes:
        zone_fraction: delta, the width of the zone as a fraction of the current width, as the paper's text has it.
        mass_threshold: tau, the marginal mass above which a bound moves.
        expansion: eta, the step as a fraction of the current width.
        zone_width: absolute width added to the zone. Delta as written in Algorithm 2 is
            `Edge(zone_fraction=0.0, zone_width=0.1)` (docs/paper.md, reading F).
        tail: fraction of the mass *beyond* the bound that counts as lying in the zone. 1 counts all of it, as clipping
            would, so that EDGE still works when the mode itself has left the box; 0 counts the zone alone
            (docs/paper.md, reading G).
        uninformed_factor: factor on the threshold for a posterior as wide as a uniform one; 1 is the paper's.

    Example:
        >>> Edge(mass_threshold=0.005, uninformed_factor=1).mass_threshold  # the paper's
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
    uninformed_factor: Value = hyperparameter(
        default=2.5, help="how many times the threshold is for a posterior as wide as a uniform one", low=1
    )

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Algorithm 2, over all dimensions at once; the evidence is the two edge masses M_L and M_R, shape [D]."""
        box = previous.support
        zone = self.zone_fraction * box.width + self.zone_width
        # The zones along both bounds, and everything beyond the bounds.
        low = jnp.stack([box.low, box.high - zone, jnp.full_like(box.low, -jnp.inf), box.high])
        high = jnp.stack([box.low + zone, box.high, box.low, jnp.full_like(box.low, jnp.inf)])
        in_zones, beyond = jax.vmap(posterior.interval_mass)(low, high).reshape(2, 2, -1)
        mass_left, mass_right = in_zones + self.tail * beyond
        threshold = self.threshold(posterior, box)
        support = stretch(box, feasible, mass_left > threshold, mass_right > threshold, self.expansion)
        return adapted(previous, posterior, support, {"mass_left": mass_left, "mass_right": mass_right})

    def threshold(self, posterior: GaussianMixture, box: Support) -> Float[Array, " dim"]:
        """The mass above which each bound moves, which is higher for less informative posteriors, shape [D]."""
        uniform_variance = box.width**2 / 12
        unexplained = jnp.minimum(jnp.diagonal(posterior.covariance) / uniform_variance, 1.0)
        return self.mass_threshold * (1 + (self.uninformed_factor - 1) * unexplained)
