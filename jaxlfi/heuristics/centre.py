"""CENTRE: shift the support so that it is centred on the posterior's weighted mean (Algorithm 4)."""

import jax.numpy as jnp

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics.base import Adaptation, Heuristic, adapted


class Centre(Heuristic):
    """Centring-based adaptive bounds (Algorithm 4): no hyperparameters; the width is kept.

    Example:
        >>> Centre()
        Centre()
    """

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Algorithm 4; the evidence is the weighted mean mu, shape [D].

        A box that would leave Phi is shifted back inside without changing its width. A box wider than Phi becomes Phi
        (docs/paper.md, reading I).
        """
        width = jnp.minimum(previous.support.width, feasible.width)
        centre = posterior.mean
        # Phi's bounds are applied last, so that rounding never moves the box outside Phi.
        low = jnp.maximum(jnp.minimum(centre - 0.5 * width, feasible.high - width), feasible.low)
        support = Support(low=low, high=jnp.minimum(low + width, feasible.high))
        return adapted(previous, posterior, support, {"weighted_mean": centre})
