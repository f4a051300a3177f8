"""Identified: bounds of a parameter that the observation says nothing of stay where they are."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics.base import Adaptation, Value, Wrapper

PLACES = np.linspace(0.0, 1.0, 17, dtype=np.float32)[1:-1]
"""Where distribution functions are compared, as fractions of the support's width."""


class Identified(Wrapper):
    """Another heuristic, for the parameters whose posterior differs from the uniform distribution over the support.

    A posterior that is as wide as the support has mass along both bounds, wherever these are: no evidence that either
    is wrong. EDGE alone moves them on, round by round, until the support is Phi. On a linear Gaussian, the learnt
    marginals of parameters that do nothing are at distances of 0.14 to 0.30 from the uniform, others at 0.39 and more.

    Attributes:
        rule: the heuristic to wrap.
        least_change: largest difference, at least, between the distribution functions of the posterior's marginal
            within the support and of the uniform distribution (Kolmogorov and Smirnov's distance).

    Example:
        >>> from jaxlfi.heuristics import Edge
        >>> Identified(Edge()).rule.mass_threshold
        0.005
    """

    least_change: Value = hyperparameter(
        0.3, help="distance of a marginal from the uniform below which its bounds stay", low=0, high=1
    )

    @property
    def compares_components(self) -> bool:
        """Whether the rule compares components."""
        return self.rule.compares_components

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Apply the rule, and take back what it did to parameters that are not identified."""
        box = previous.support
        change = from_uniform(posterior, box)
        belief, seen = self.rule(previous, posterior, feasible)
        kept = change < self.least_change
        support = jax.tree.map(lambda was, now: jnp.where(kept, was, now), box, belief.support)
        return belief.replace(support=support), Adaptation(
            evidence=seen.evidence | {"from_uniform": change},
            low_shift=support.low - box.low,
            high_shift=support.high - box.high,
        )


def from_uniform(posterior: GaussianMixture, support: Support) -> Float[Array, " dim"]:
    """Kolmogorov and Smirnov's distance between each marginal within the support and the uniform, shape [D].

    1 where next to no mass lies inside.
    """
    below = lambda share: posterior.interval_mass(support.low, support.low + share * support.width)
    inside = below(1.0)
    difference = jnp.abs(jax.vmap(below)(PLACES) / jnp.maximum(inside, 1e-12) - PLACES[:, None])
    return jnp.where(inside > 1e-6, jnp.max(difference, axis=0), 1.0)
