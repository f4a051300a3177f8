"""Estimator: the density estimator's architecture and how it is trained."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.mdn import ACTIVATIONS, MDN
from jaxlfi.mixture import GaussianMixture
from jaxlfi.mixture_algebra import pool
from jaxlfi.normalise import TRANSFORMS, Normaliser, normalised
from jaxlfi.support import Support

SCHEDULES = {"constant": jnp.ones_like, "cosine": lambda progress: 0.5 * (1 + jnp.cos(jnp.pi * progress))}
"""The learning rate's factor at a point of progress through the round's fitting, by name."""


def static(default):
    """A field that sets shapes or structure, and so is part of what is compiled."""
    return struct.field(pytree_node=False, default=default)


@struct.dataclass
class Estimator:
    """What q_phi is and how it is fitted each round. The defaults are the paper's (section III-C).

    Learning rate, weight decay, clipping norm and pruning are leaves, so that a grid over them is one vmap; the rest
    is static.

    Attributes:
        learning_rate: Adam's step size.
        weight_decay: decoupled weight decay (AdamW), per step and relative to the learning rate.
        clip_norm: global norm the gradients are clipped to.
        prune: components of less weight than this are dropped from each network's mixture. Rarely used components are
            hardly trained: they are wide and anywhere. BayesSim's first implementations prune at 0.005; the paper
            does not say.
        hidden: units of each hidden layer.
        activation: "relu", "tanh" or "silu".
        components: Gaussians of each network's mixture, K.
        members: networks in the ensemble; the posterior is their equally weighted mixture, members * K components.
        epochs: full passes over the dataset each round (reading B); 0 where `steps` counts instead.
        steps: gradient steps each round, rounded up to passes of equal length; 0 where `epochs` counts.
        batch_size: simulations in a minibatch, drawn from the filled rows only.
        schedule: "constant", or "cosine" to zero within the round.
        validation: fraction of the simulations held out to choose the best weights by; 0 keeps the last weights.
        patience: stop after so many passes without a better validation loss; 0 runs all passes.
        warm_start: continue from the last round's weights, or start anew each round (reading C).
        normaliser: "zscore", "asinh" or "none" (`jaxlfi.normalise.TRANSFORMS`). It belongs to the network: computed
            where the network starts and kept while it is trained on.

    Raises:
        ValueError: from `check` for settings that contradict each other.
    """

    learning_rate: Float[Array, "*batch"] | float = 1e-5
    weight_decay: Float[Array, "*batch"] | float = 0.0
    clip_norm: Float[Array, "*batch"] | float = jnp.inf
    prune: Float[Array, "*batch"] | float = 0.0
    hidden: tuple[int, ...] = static((1024, 1024, 1024))
    activation: str = static("tanh")
    components: int = static(4)
    members: int = static(1)
    epochs: int = static(1000)
    steps: int = static(0)
    batch_size: int = static(100)
    schedule: str = static("constant")
    validation: float = static(0.0)
    patience: int = static(0)
    warm_start: bool = static(True)
    normaliser: str = static("zscore")

    def check(self) -> "Estimator":
        """Refuse settings that cannot work, by name; returns the estimator."""
        choices = {"activation": ACTIVATIONS, "normaliser": TRANSFORMS, "schedule": SCHEDULES}
        for field, known in choices.items():
            if getattr(self, field) not in known:
                raise ValueError(f"{field}: expected one of {sorted(known)}, got {getattr(self, field)!r}")
        for field in ("components", "members", "batch_size"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}: expected at least 1, got {getattr(self, field)}")
        if (self.epochs > 0) == (self.steps > 0):
            raise ValueError(f"expected epochs or steps, one of them above 0, got {self.epochs} and {self.steps}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: expected at least one layer of at least one unit, got {self.hidden}")
        if not 0 <= self.validation < 1:
            raise ValueError(f"validation: expected a fraction in [0, 1), got {self.validation}")
        if self.patience and not self.validation:
            raise ValueError("patience: expected validation above 0 to stop by, got validation=0")
        return self

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one member for D parameters."""
        return MDN(self.components, dim, self.hidden, self.activation)


@struct.dataclass
class Network:
    """Trained weights of all members with the normaliser they belong to.

    Attributes:
        params: Flax parameters with a leading axis of length `members`.
        normaliser: what summaries are centred and scaled by.
    """

    params: dict
    normaliser: Normaliser


def initialise(key: jax.Array, estimator: Estimator, dim: int, obs: int) -> dict:
    """Fresh weights for every member."""
    module = estimator.module(dim)
    return jax.vmap(lambda k: module.init(k, jnp.zeros(obs)))(jax.random.split(key, estimator.members))


def condition(
    estimator: Estimator, network: Network, x: Float[Array, " obs"], scale: Support
) -> GaussianMixture:
    """q_phi(theta | x) in coordinates, all members pooled: members * K components.

    Args:
        estimator: the settings the network was made with.
        network: trained weights.
        x: the observed summary, shape [S].
        scale: the box the network's [-1, 1]^D stands for (Phi, reading D).
    """
    module = estimator.module(scale.dim)
    x = normalised(estimator.normaliser, network.normaliser, x)
    members = jax.vmap(lambda params: module.apply(params, x).mixture().prune(estimator.prune))(network.params)
    return pool(members).affine(0.5 * scale.width, scale.centre)
