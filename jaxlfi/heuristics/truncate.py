"""Truncate: shrink the support to the bulk of the posterior, and propose from the prior over it."""

import jax.numpy as jnp

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics.base import Adaptation, Heuristic, Value, adapted

MIN_WIDTH = 1e-3
"""Minimum width of a truncated support, as a fraction of Phi's."""


class Truncate(Heuristic):
    """Truncated proposals on a box (Deistler et al. 2022; boxes as in Miller et al. 2021).

    The support shrinks to the part of it between the quantiles `quantile` and 1 - `quantile` of each marginal of the
    posterior, and never grows. The next round draws from the *prior* over the new support, not from the posterior: the
    belief is returned with `informed` false. Every support contains all later ones, so the pooled proposals are uniform
    over the last one (or follow the task's prior there) and need no correction.

    A posterior that has left the support, or is narrower than a thousandth of Phi, would leave nothing to draw from.
    The support then keeps that width, around the posterior or along the bound nearest to it.

    Attributes:
        quantile: posterior mass given up beyond each bound, in [0, 0.5); scalar or one value per dimension. 0 truncates
            nothing. It is a leaf and can be vmapped over.

    Raises:
        ValueError: for a quantile outside [0, 0.5).

    Example:
        >>> Truncate(quantile=0.01).quantile
        0.01
    """

    grows = False
    proposes_from_prior = True

    quantile: Value = hyperparameter(default=1e-3, help="posterior mass left beyond each bound", low=0, below=0.5)

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Intersect the support with the posterior's interval; the evidence is the interval's two ends, shape [D]."""
        box = previous.support
        interval_low = posterior.marginal_quantile(self.quantile)
        interval_high = -posterior.mirror().marginal_quantile(self.quantile)
        low, high = jnp.clip(interval_low, box.low, box.high), jnp.clip(interval_high, box.low, box.high)
        least = jnp.minimum(MIN_WIDTH * feasible.width, box.width)
        lack = 0.5 * jnp.maximum(least - (high - low), 0.0)
        # The box's own bounds are applied last, so that rounding never grows it.
        support = Support(
            low=jnp.maximum(jnp.minimum(low - lack, box.high - least), box.low),
            high=jnp.minimum(jnp.maximum(high + lack, box.low + least), box.high),
        )
        evidence = {"interval_low": interval_low, "interval_high": interval_high}
        belief, adaptation = adapted(previous, posterior, support, evidence)
        return belief.replace(informed=jnp.zeros_like(previous.informed)), adaptation
