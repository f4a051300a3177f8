"""Bounds of a support that look wrong: the posterior lies beyond them.

A posterior mixture is learnt on a box but is not confined to it. Where the box holds the truth, the mixture's mass is
inside, however close to a bound it lies; where a bound excludes the truth, the networks extrapolate and the mass moves
beyond that bound. So the evidence against a bound is the marginal mass *beyond* it, not the mass along it.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.support import Support

MASS_BEYOND = 0.2
"""Marginal posterior mass beyond a bound above which a warning names it.

On a wrong support the networks of an ensemble extrapolate, each to a place of its own and with little width, so that
the mass beyond is near a multiple of 1 / ensemble size: this is enough for one of the usual four. Hits and false alarms
of this number and of others: experiments/README.md.
"""

ROUNDING = 1e-6
"""Distance from Phi's bound, as a fraction of its width, up to which a bound is Phi's."""

SIDES = ("lower", "upper")
ADVICE = "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
PHI_ADVICE = "The bound is that of the feasible domain Phi: widen Phi if it can be."


def edge_mass(belief: Belief, zone_fraction: float = 0.1) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal posterior mass in or beyond the zone along each lower and each upper bound, shape [D] each.

    What EDGE adapts by. It is no evidence that a bound is wrong: a posterior may lie wholly in the zone and not beyond.

    Args:
        belief: one belief.
        zone_fraction: width of the zone as a fraction of the support's.
    """
    box = jax.tree.map(jnp.asarray, belief.support)
    zone = zone_fraction * box.width
    infinite = jnp.full_like(box.low, jnp.inf)
    return (
        belief.mixture.interval_mass(-infinite, box.low + zone),
        belief.mixture.interval_mass(box.high - zone, infinite),
    )


def bound_evidence(belief: Belief) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal mass of the untruncated posterior beyond each lower and each upper bound, shape [D] each.

    Above 1/2, the marginal's median lies beyond the bound. In closed form; `jit`, `vmap` and `grad` apply.

    Args:
        belief: one belief.

    Example:
        >>> from jaxlfi.distributions.mixture import GaussianMixture
        >>> mixture = GaussianMixture(jnp.zeros(1), jnp.array([[1.0, 0.5]]), jnp.array([jnp.eye(2) / 8]))
        >>> belief = Belief(mixture, Support([0.0, 0.0], [1.0, 1.0]), jnp.asarray(True))
        >>> low, high = bound_evidence(belief)
        >>> high.round(2).tolist()
        [0.5, 0.0]
    """
    return edge_mass(belief, 0.0)


_evidence = jax.jit(single(lambda belief: jnp.stack(bound_evidence(belief))))


def bound_warnings(
    names: Sequence[str],
    belief: Belief,
    feasible: Support,
    threshold: float = MASS_BEYOND,
    grows: bool = False,
) -> list[str]:
    """Say in words which bounds of a support the posterior lies beyond, and what to do.

    Args:
        names: of the parameters in inference space ("ln young" for one inferred as its logarithm), D of them.
        belief: one belief, concrete.
        feasible: Phi.
        threshold: marginal mass beyond a bound above which the bound is named.
        grows: whether the support can grow: then only bounds that are Phi's are named, which no heuristic moves.

    Example:
        >>> from jaxlfi.distributions.mixture import GaussianMixture
        >>> mixture = GaussianMixture(jnp.zeros(1), jnp.array([[4.0]]), jnp.array([[[0.5]]]))
        >>> belief = Belief(mixture, Support([0.0], [3.0]), jnp.asarray(True))
        >>> (warning,) = bound_warnings(["mass"], belief, feasible=Support([0.0], [9.0]))
        >>> warning.partition(". ")[0]
        'mass: 0.98 of the posterior mass lies beyond the upper bound 3'
    """
    mass = np.asarray(_evidence(belief))
    bounds = np.stack([belief.support.low, belief.support.high])
    final = _at_limit(bounds, feasible)
    return [
        f"{names[d]}: {mass[side, d]:.2f} of the posterior mass lies beyond the {SIDES[side]} bound "
        f"{bounds[side, d]:.4g}. {PHI_ADVICE if final[side, d] else ADVICE}"
        for d, side in np.argwhere(mass.T > threshold)
        if final[side, d] or not grows
    ]


def bound_summary(
    names: Sequence[str],
    beliefs: Sequence[Belief],
    feasible: Support,
    threshold: float = MASS_BEYOND,
    grows: bool = False,
) -> list[str]:
    """The warnings of several runs from one support: which bounds the posterior lies beyond, and in how many runs.

    Args:
        names: of the parameters in inference space, D of them.
        beliefs: one a run; the warnings of a single one are those of `bound_warnings`.
        feasible: Phi.
        threshold: marginal mass beyond a bound above which the bound is named.
        grows: whether the support can grow; see `bound_warnings`.

    Returns:
        At most two texts: one of the bounds that can be moved, and one of the bounds of Phi.
    """
    if len(beliefs) == 1:
        return bound_warnings(names, beliefs[0], feasible, threshold, grows)
    mass = np.stack([_evidence(belief) for belief in beliefs])  # [run, side, D]
    bounds = np.stack([np.stack([belief.support.low, belief.support.high]) for belief in beliefs])
    final = np.all(_at_limit(bounds, feasible), axis=0)
    texts = []
    for limited, advice in ((False, ADVICE), (True, PHI_ADVICE))[grows:]:
        named = np.argwhere(np.any(mass > threshold, axis=0).T & (final.T == limited))
        places = [
            f"{names[d]} {SIDES[side]} {_value(bounds[:, side, d])} "
            f"({np.sum(mass[:, side, d] > threshold)} of {len(beliefs)} runs, "
            f"median mass {np.median(mass[:, side, d]):.2f})"
            for d, side in named
        ]
        if places:
            texts.append(f"posterior mass lies beyond a bound: {', '.join(places)}. {advice}")
    return texts


def _at_limit(bounds: np.ndarray, feasible: Support) -> np.ndarray:
    """Whether each bound is that of Phi, or beyond it (a named support may be wider), shape [..., side, D]."""
    limits = np.stack([feasible.low, feasible.high])
    outwards = np.array([[-1.0], [1.0]])
    near = np.abs(bounds - limits) <= ROUNDING * np.asarray(feasible.width)
    return near | (outwards * (bounds - limits) > 0)


def _value(bounds: np.ndarray) -> str:
    """One number, or the range of those that differ from run to run (a support that was truncated)."""
    low, high = (f"{bound:.4g}" for bound in (np.min(bounds), np.max(bounds)))
    return low if low == high else f"{low} to {high}"
