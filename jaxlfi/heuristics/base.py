"""What a heuristic is: (previous belief, posterior, Phi) -> (belief, what it saw and did)."""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support


@struct.dataclass
class Adaptation:
    """What a heuristic saw and what it did in one round; only to be looked at.

    Attributes:
        evidence: named arrays with a trailing axis of length D (edge masses, accumulated weights, means, ...).
        low_shift: change of each lower bound, shape [D] (negative: stretched to the left).
        high_shift: change of each upper bound, shape [D].
    """

    evidence: dict[str, Array]
    low_shift: Float[Array, "*batch dim"]
    high_shift: Float[Array, "*batch dim"]


@runtime_checkable
class Heuristic(Protocol):
    """A pure, branch-free rule. Hyperparameters are leaves: scalars or one value per dimension, shape [D]."""

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Adapt the support.

        Args:
            previous: the belief the posterior was inferred from; its support is the Theta_i to adapt.
            posterior: the mixture p-hat of this round.
            feasible: Phi, which the adapted support stays in.

        Returns:
            The next belief (this posterior on the adapted support) and the adaptation.
        """
        ...


def stretch(
    support: Support,
    feasible: Support,
    left: Bool[Array, " dim"],
    right: Bool[Array, " dim"],
    expansion: Float[Array, ""] | Float[Array, " dim"] | float,
) -> Support:
    """Stretch the chosen bounds by `expansion` times the width, as far as Phi allows (Algorithms 2 and 3).

    A bound that was not chosen stays where it is, also where it touches Phi (reading H).
    """
    step = expansion * support.width
    return Support(
        low=jnp.where(left, jnp.maximum(support.low - step, feasible.low), support.low),
        high=jnp.where(right, jnp.minimum(support.high + step, feasible.high), support.high),
    )


def adapted(
    previous: Belief, posterior: GaussianMixture, support: Support, evidence: dict[str, Array]
) -> tuple[Belief, Adaptation]:
    """Put the posterior on its new support and note how far the bounds moved."""
    return Belief(posterior, support, jnp.ones_like(previous.informed)), Adaptation(
        evidence=evidence,
        low_shift=support.low - previous.support.low,
        high_shift=support.high - previous.support.high,
    )
