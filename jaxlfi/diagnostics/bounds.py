"""Bounds of a support that look wrong: the observation is explained better beyond them.

There are two kinds of evidence against a bound. The posterior mixture is learnt on a box but is not confined to it: if
a bound excludes the truth, the networks extrapolate, and marginal mass moves *beyond* that bound (mass along it says
nothing). But they also move other parameters, which compensate for the wrong one. So the run's own simulations are used
as well: a local linear model of them (`jaxlfi.diagnostics.local_model`) tells how much the observation's misfit falls
as bounds are removed one by one, the most helpful first. A bound that no longer helps then is not to blame.

If the local model explains the observation, it decides. If it does not (the simulator is far from linear between the
box and the truth), the bound is named that it would remove first and that has most mass beyond it; if these are two
bounds, all bounds with evidence of either kind are named. Hits and false alarms of this rule and of the mass alone are
in experiments/studies/wrong-bounds.md.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.diagnostics.local_model import LocalModel, local_model
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.io.executables import quickly
from jaxlfi.io.lowered import Program

MASS_BEYOND = 0.12
"""Marginal posterior mass beyond a bound that is evidence against it by itself: right boxes rarely have so much.

On a wrong support the networks of an ensemble extrapolate, each to its own place and with little width, so that the
mass beyond is often near a multiple of 1 / ensemble size: this is enough for half of one of the usual four.
"""
SOME = 0.03
"""Mass beyond a bound that is evidence against it together with the run's simulations."""
LESS = 0.5
"""Fraction of the greatest mass beyond a bound below which the mass beyond others does not count."""
GAIN = 6.0
"""Fall of the misfit that is evidence against a bound by itself: a right one has it in less than 1 % of runs."""
WEAK_GAIN = 1.0
"""Fall of the misfit that is evidence against a bound together with `SOME` mass beyond it."""
NEXT = 0.3
"""Least gain of a further bound, as a fraction of the greatest."""
EXPLAINED = 0.5
"""Fraction of the misfit that removing bounds must explain if the rest is not as small as noise."""
REACH = 2.0
"""How far beyond a bound the local model is trusted, in half widths of the box."""

ROUNDING = 1e-6
"""Distance from Phi's bound, as a fraction of its width, up to which a bound counts as Phi's."""

SIDES = ("lower", "upper")
ADVICE = "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
PHI_ADVICE = "The bound is that of the feasible domain Phi: widen Phi if it can be."


@dataclasses.dataclass(frozen=True)
class BoundEvidence:
    """The evidence of one run about the bounds of its last support.

    Attributes:
        bounds: in inference space, shape [2, D]: the lower ones, the upper ones.
        mass: marginal posterior mass beyond each, shape [2, D].
        gain: fall of the observation's squared misfit, in standard deviations of the noise, when each is removed
            after those that help more; zero for those that no longer help, shape [2, D].
        wrong: whether each looks wrong, shape [2, D].
    """

    bounds: Float[np.ndarray, "side dim"]
    mass: Float[np.ndarray, "side dim"]
    gain: Float[np.ndarray, "side dim"]
    wrong: np.ndarray


def edge_mass(belief: Belief, zone_fraction: float = 0.1) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal posterior mass in or beyond the zone along each lower and each upper bound, shape [D] each.

    The zone is as wide as a fraction of the support. EDGE adapts by this mass. It is no evidence that a bound is wrong,
    as a posterior may lie entirely in the zone and not beyond.
    """
    box = jax.tree.map(jnp.asarray, belief.support)
    zone = zone_fraction * box.width
    infinite = jnp.full_like(box.low, jnp.inf)
    return (
        belief.mixture.interval_mass(-infinite, box.low + zone),
        belief.mixture.interval_mass(box.high - zone, infinite),
    )


def mass_beyond(belief: Belief) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal mass of the untruncated posterior beyond each lower and each upper bound, shape [D] each.

    Above 1/2, the marginal's median lies beyond the bound. In closed form; `jit`, `vmap` and `grad` apply.

    Example:
        >>> from jaxlfi.distributions.mixture import GaussianMixture
        >>> mixture = GaussianMixture(jnp.zeros(1), jnp.array([[1.0, 0.5]]), jnp.array([jnp.eye(2) / 8]))
        >>> belief = Belief(mixture, Support([0.0, 0.0], [1.0, 1.0]), jnp.asarray(True))
        >>> low, high = mass_beyond(belief)
        >>> high.round(2).tolist()
        [0.5, 0.0]
    """
    return edge_mass(belief, 0.0)


def _both(belief: Belief) -> Array:
    return jnp.stack(mass_beyond(belief))


_MASS = Program(single(_both), _both, ())


def bound_evidence(
    belief: Belief,
    theta: Float[Array | np.ndarray, "n dim"],
    x: Float[Array | np.ndarray, "n obs"],
    observed: Float[Array | np.ndarray, " obs"],
) -> BoundEvidence:
    """The evidence of a run's posterior and simulations about the bounds of its last support.

    Args:
        belief: the posterior on that support, concrete.
        theta: parameters of all simulations of the run, in inference space, shape [N, D].
        x: their summaries, shape [N, S].
        observed: the observed summaries, shape [S].
    """
    box = jax.device_get(belief.support)
    model = local_model(theta, x, observed, box)
    return judged(np.stack([box.low, box.high]), np.asarray(quickly(_MASS, belief), float), model)


def judged(
    bounds: Float[np.ndarray, "side dim"], mass: Float[np.ndarray, "side dim"], model: LocalModel | None
) -> BoundEvidence:
    """Which bounds look wrong, judged by the posterior mass beyond them and by the local model.

    Args:
        bounds: in inference space, shape [2, D].
        mass: beyond each, shape [2, D].
        model: None if there are too few simulations for one: then the mass decides.
    """
    if model is None:
        return BoundEvidence(bounds, mass, np.zeros_like(mass), mass > MASS_BEYOND)
    some = mass > SOME
    gain, before, after = gains(model)
    helps, degrees = gain >= GAIN, len(model.residual)
    if helps.any() and (after <= _usual(degrees, 2.33) or before - after >= EXPLAINED * before):
        wrong = helps
    elif before <= _usual(degrees, 3.09):  # the box explains it
        wrong = (mass > MASS_BEYOND) | (some & (gain >= WEAK_GAIN))
    elif helps.any() and some.any() and np.argmax(gain) == np.argmax(mass):  # both point to one bound
        wrong = gain == np.max(gain)
    else:
        wrong = helps | (some & (mass > LESS * np.max(mass)))
    return BoundEvidence(bounds, mass, gain, wrong)


def gains(model: LocalModel) -> tuple[Float[np.ndarray, "side dim"], float, float]:
    """The reduction of the misfit as bounds are removed one after another, the most helpful one first.

    Returns:
        The gain of each, shape [2, D], and the misfit with all bounds and without the removed ones.
    """
    dim = len(model.centre)
    limits, gain = np.stack([-np.ones(dim), np.ones(dim)]), np.zeros((2, dim))
    before = after = model.misfit(*limits)
    outwards = np.array([-REACH, REACH])
    for _ in range(dim):
        best, which = 0.0, None
        for side, d in np.argwhere(gain == 0):
            limits[side, d] += outwards[side]
            own = after - model.misfit(*limits)
            limits[side, d] -= outwards[side]
            if own > best:
                best, which = own, (side, d)
        if which is None or best < NEXT * np.max(gain):
            break
        gain[which] = best
        limits[which] += outwards[which[0]]
        after -= best
    return gain, before, after


def _usual(degrees: int, z: float) -> float:
    """The chi-squared quantile at z of the standard normal distribution, by Wilson and Hilferty."""
    spread = 2 / (9 * degrees)
    return degrees * (1 - spread + z * np.sqrt(spread)) ** 3


def bound_warnings(
    space: Space, units: Sequence[str] | None, evidence: Sequence[BoundEvidence], feasible: Support, grows: bool = False
) -> list[str]:
    """Describe which bounds of a support look wrong, and what to do.

    Args:
        space: of the parameters: values are given in natural units.
        units: of the parameters, "" or "1" for none; None if unknown.
        evidence: of one or more runs that began on the same support.
        feasible: Phi, in inference space.
        grows: whether the support can grow: then only bounds of Phi, which no heuristic moves, are named.

    Example:
        >>> bounds, mass = np.array([[0.0], [3.0]]), np.array([[0.0], [0.98]])
        >>> evidence = BoundEvidence(bounds, mass, np.zeros((2, 1)), mass > 0.2)
        >>> (warning,) = bound_warnings(Space(("mass",), (False,)), ("kg",), [evidence], Support([0.0], [9.0]))
        >>> warning.partition(". ")[0]
        'mass reaches its upper bound 3 kg (0.98 of the posterior mass lies beyond it)'
    """
    wrong = np.stack([one.wrong for one in evidence])  # [run, side, D]
    mass = np.stack([one.mass for one in evidence])
    bounds = np.stack([one.bounds for one in evidence])
    final = np.all(_at_limit(bounds, feasible), axis=0)
    runs, texts = len(evidence), []
    for d, side in np.argwhere(np.any(wrong, axis=0).T):
        if grows and not final[side, d]:
            continue
        unit = f" {units[d]}" if units is not None and units[d] not in ("", "1") else ""
        value = _range(np.asarray(space.to_natural(bounds[:, side]), float)[:, d])
        share = np.median(mass[:, side, d])
        beyond = f"{'in the median ' if runs > 1 else ''}{share:.2f} of the posterior mass lies beyond it"
        if share <= SOME:
            beyond = "the run's simulations say so, not its posterior" if runs == 1 else ""
        if runs > 1:
            beyond = f"in {np.sum(wrong[:, side, d])} of {runs} runs{'; ' if beyond else ''}{beyond}"
        advice = PHI_ADVICE if final[side, d] else ADVICE
        texts.append(f"{space.names[d]} reaches its {SIDES[side]} bound {value}{unit} ({beyond}). {advice}")
    return texts


def _at_limit(bounds: np.ndarray, feasible: Support) -> np.ndarray:
    """Whether each bound is Phi's, or beyond it (a named support may be wider), shape [..., side, D]."""
    limits = np.stack([feasible.low, feasible.high])
    outwards = np.array([[-1.0], [1.0]])
    near = np.abs(bounds - limits) <= ROUNDING * np.asarray(feasible.width)
    return near | (outwards * (bounds - limits) > 0)


def _range(values: np.ndarray) -> str:
    """One number, or the range of numbers that differ between runs (a support that was truncated)."""
    low, high = (f"{value:.4g}" for value in (np.min(values), np.max(values)))
    return low if low == high else f"{low} to {high}"
