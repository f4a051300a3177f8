"""Component matching: give the posterior's components the indices of the nearest previous ones."""

from itertools import permutations

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics.base import Adaptation, Heuristic

MAX_EXACT = 6
"""Maximum number of components that are matched exactly, over 6! = 720 permutations; more are matched greedily."""


class Matched(Heuristic):
    """A heuristic applied to a posterior whose components were first paired with the previous ones.

    Networks that are reinitialised every round (docs/paper.md, reading C) label their components arbitrarily; without
    matching, MODE would see shifts that are mere relabelling.

    Attributes:
        rule: heuristic to wrap.

    Example:
        >>> from jaxlfi.heuristics import Mode
        >>> Matched(Mode()).rule.proximity
        0.4
    """

    rule: Heuristic

    @property
    def grows(self) -> bool:  # type: ignore[override]  # its rules say, and only an instance has them
        """Whether the rule can let the support grow."""
        return self.rule.grows

    @property
    def proposes_from_prior(self) -> bool:  # type: ignore[override]  # its rules say, and only an instance has them
        """Whether the rule always proposes from the prior."""
        return self.rule.proposes_from_prior

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Reorder the posterior's components (not before the first round), then apply the rule."""
        order = match(previous.mixture, posterior, previous.support)
        order = jnp.where(previous.informed, order, jnp.arange(order.shape[0]))
        return self.rule(previous, posterior.permute(order), feasible)


def paired(rule: Heuristic, warm_start: bool) -> Heuristic:
    """The rule, wrapped in `Matched` if it compares components and networks are reinitialised every round.

    Example:
        >>> from jaxlfi.heuristics import Edge, Mode
        >>> type(paired(Mode(), warm_start=False)).__name__, type(paired(Edge(), warm_start=False)).__name__
        ('Matched', 'Edge')
    """
    return Matched(rule) if rule.compares_components and not warm_start else rule


def match(previous: GaussianMixture, posterior: GaussianMixture, support: Support) -> Int[Array, " comp"]:
    """The order of `posterior`'s components that brings its means nearest to `previous`'s.

    Minimises the sum over components of the squared distance between paired means, in units of the support's width.
    Exact for up to six components; with more, the nearest remaining pair is matched repeatedly.
    """
    offset = (previous.means[:, None, :] - posterior.means[None, :, :]) / support.width
    cost = jnp.sum(offset**2, axis=-1)
    components = cost.shape[0]
    if components <= MAX_EXACT:
        orders = jnp.asarray(list(permutations(range(components))))
        total = jnp.sum(cost[jnp.arange(components), orders], axis=-1)
        return orders[jnp.argmin(total)]
    order = jnp.zeros(components, int)
    for _ in range(components):
        row, column = jnp.divmod(jnp.argmin(cost), components)
        order = order.at[row].set(column)
        cost = cost.at[row, :].set(jnp.inf).at[:, column].set(jnp.inf)
    return order
