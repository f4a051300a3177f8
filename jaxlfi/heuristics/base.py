"""The interface of heuristics: (previous belief, posterior, Phi) -> (belief, record of the adaptation)."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import Checked

Value = Float[Array, ""] | Float[Array, " dim"] | float | int
"""Value of a hyperparameter: a scalar, or one value per dimension."""


class Adaptation(struct.PyTreeNode):
    """Record of what a heuristic evaluated and did in one round.

    Attributes:
        evidence: named arrays with a trailing axis of length D (edge masses, accumulated weights, means, ...).
        low_shift: change of each lower bound, shape [D] (negative if stretched to the left).
        high_shift: change of each upper bound, shape [D].
    """

    evidence: dict[str, Array]
    low_shift: Float[Array, "*batch dim"]
    high_shift: Float[Array, "*batch dim"]


class Heuristic(Checked, abc.ABC):
    """A pure, branch-free rule. A class that derives from it is a frozen dataclass and a pytree, without a decorator.

    Hyperparameters are leaves, scalars or one value per dimension, shape [D]. They are declared with
    `jaxlfi.fields.hyperparameter`, and settings that change the structure of the computation with
    `jaxlfi.fields.option`; flags, checks and the documentation are generated from these. A package registers its
    heuristics under `[project.entry-points."jaxlfi.heuristics"]` in pyproject.toml.

    Attributes:
        grows: whether the support can grow. If it cannot, posterior mass at a bound has to be reported to the user.
        compares_components: whether components are compared by their index with those of the previous posterior. They
            are matched first (`Matched`) if networks are reinitialised each round.
        proposes_from_prior: whether parameters to simulate are always drawn from the prior truncated to the support,
            and never from the posterior. `informed` is then false in every belief that it returns.

    Example:
        >>> from jaxlfi.fields import hyperparameter
        >>> from jaxlfi.heuristics import adapted
        >>> class Widen(Heuristic):
        ...     expansion: float = hyperparameter(default=0.1, help="how far both bounds move", symbol="eta", low=0)
        ...
        ...     def __call__(self, previous, posterior, feasible):
        ...         everywhere = jnp.ones_like(previous.support.low, bool)
        ...         support = stretch(previous.support, feasible, everywhere, everywhere, self.expansion)
        ...         return adapted(previous, posterior, support, evidence={})
        >>> Widen(expansion=-1)
        Traceback (most recent call last):
        ValueError: expansion: expected a number in [0, inf), got -1
    """

    grows: ClassVar[bool] = True
    compares_components: ClassVar[bool] = False
    proposes_from_prior: ClassVar[bool] = False

    @abc.abstractmethod
    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Adapt the support.

        Args:
            previous: belief that the posterior was inferred from; its support is the Theta_i to adapt.
            posterior: mixture p-hat of this round.
            feasible: limits Phi of the adapted support.

        Returns:
            The next belief (this posterior on the adapted support) and the adaptation.
        """


def stretch(
    support: Support,
    feasible: Support,
    left: Bool[Array, " dim"],
    right: Bool[Array, " dim"],
    expansion: Value,
) -> Support:
    """Stretch the chosen bounds by `expansion` times the width, as far as Phi allows (Algorithms 2 and 3).

    A bound that was not chosen stays where it is, even if it touches Phi (docs/paper.md, reading H).
    """
    step = expansion * support.width
    return Support(
        low=jnp.where(left, jnp.maximum(support.low - step, feasible.low), support.low),
        high=jnp.where(right, jnp.minimum(support.high + step, feasible.high), support.high),
    )


def adapted(
    previous: Belief, posterior: GaussianMixture, support: Support, evidence: dict[str, Array]
) -> tuple[Belief, Adaptation]:
    """Put the posterior on its new support and record how far the bounds moved."""
    return Belief(posterior, support, jnp.ones_like(previous.informed)), Adaptation(
        evidence=evidence,
        low_shift=support.low - previous.support.low,
        high_shift=support.high - previous.support.high,
    )
