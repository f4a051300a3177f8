"""MODE: stretch a bound that the modes of the posterior move towards (Algorithm 3)."""

import jax.numpy as jnp

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics.base import Adaptation, Heuristic, Value, adapted, stretch


class Mode(Heuristic):
    """Mode-oriented domain expansion (Algorithm 3; defaults of section V).

    Components are compared by their index with those of the previous posterior, which is meaningful only if training
    continues from the previous round's network. `Matched(Mode())` pairs them first, for networks that are
    reinitialised. There is no adaptation after the first round, which has no previous posterior. All hyperparameters
    are leaves, scalar or one value per dimension.

    Attributes:
        shift_threshold: nu_TH, the smallest shift of a mode that counts, in the units of theta.
        proximity: rho, the largest distance of a mode from a bound, as a fraction of the width.
        mass_threshold: tau, the threshold on the accumulated weights of the modes that pass both tests.
        expansion: eta, the step as a fraction of the current width.

    Example:
        >>> Mode(proximity=0.3).expansion
        0.2
    """

    compares_components = True

    shift_threshold: Value = hyperparameter(
        default=0.01, help="how far a mode must have moved since the last round", symbol="nu_TH", low=0
    )
    proximity: Value = hyperparameter(
        default=0.4,
        help="how near a bound a mode must be, as a fraction of the support's width",
        symbol="rho",
        low=0,
        high=1,
    )
    mass_threshold: Value = hyperparameter(
        default=0.05,
        help="total weight of the modes moving towards a bound, above which the bound moves",
        symbol="tau",
        low=0,
        high=1,
    )
    expansion: Value = hyperparameter(
        default=0.2, help="how far a bound moves, as a fraction of the support's width", symbol="eta", low=0
    )

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Algorithm 3; the evidence is the mode shifts [K, D] and the accumulated weights W_L and W_R, [D]."""
        box = previous.support
        shift = jnp.where(previous.informed, posterior.means - previous.mixture.means, 0.0)
        position = (posterior.means - box.low) / box.width
        leftwards = (shift < -self.shift_threshold) & (jnp.abs(position) < self.proximity)
        rightwards = (shift > self.shift_threshold) & (jnp.abs(1 - position) < self.proximity)
        weights = posterior.weights[:, None]
        weight_left = jnp.sum(jnp.where(leftwards, weights, 0.0), axis=0)
        weight_right = jnp.sum(jnp.where(rightwards, weights, 0.0), axis=0)
        # The first round has no previous posterior, so its weights are zero, even if thresholds are negative.
        weight_left, weight_right = (jnp.where(previous.informed, w, 0.0) for w in (weight_left, weight_right))
        support = stretch(
            box, feasible, weight_left > self.mass_threshold, weight_right > self.mass_threshold, self.expansion
        )
        evidence = {"mode_shift": shift, "weight_left": weight_left, "weight_right": weight_right}
        return adapted(previous, posterior, support, evidence)
