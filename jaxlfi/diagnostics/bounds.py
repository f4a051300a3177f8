"""Warnings of a posterior that piles up on a bound."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.support import Support


def edge_mass(belief: Belief, zone_fraction: float = 0.1) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal posterior mass in or beyond the zone along each lower and each upper bound, shape [D] each."""
    box = jax.tree.map(jnp.asarray, belief.support)
    zone = zone_fraction * box.width
    infinite = jnp.full_like(box.low, jnp.inf)
    return (
        belief.mixture.interval_mass(-infinite, box.low + zone),
        belief.mixture.interval_mass(box.high - zone, infinite),
    )


_edge_mass = jax.jit(edge_mass)


def bound_warnings(names: Sequence[str], belief: Belief, feasible: Support, threshold: float = 0.2) -> list[str]:
    """Say in words where posterior mass is piled on a bound, and what to do.

    A uniform marginal has 0.1 of its mass in each zone of a tenth of the width; `threshold` is twice that.

    Args:
        names: of the axes of inference space.
        belief: one belief, concrete.
        feasible: Phi.
        threshold: mass above which a bound is named.
    """
    low, high = (np.asarray(side) for side in _edge_mass(belief))
    bounds = np.asarray(belief.support.low), np.asarray(belief.support.high)
    limits = np.asarray(feasible.low), np.asarray(feasible.high)
    warnings = []
    for d, name in enumerate(names):
        for side, mass, bound, limit, outwards in zip(
            ("lower", "upper"), (low, high), bounds, limits, (-1, 1), strict=True
        ):
            if mass[d] <= threshold:
                continue
            at_limit = np.isclose(bound[d], limit[d]) or outwards * (bound[d] - limit[d]) > 0
            advice = (
                "The bound is that of the feasible domain Phi: widen Phi if it can be."
                if at_limit
                else "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
            )
            warnings.append(
                f"{name}: {mass[d]:.2f} of the posterior mass lies at or beyond the {side} bound {bound[d]:.4g}. "
                f"{advice}"
            )
    return warnings
