"""Estimator: the density estimator's architecture and how it is trained."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import pool
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.flows import FLOWS
from jaxlfi.estimators.losses import LOSSES
from jaxlfi.estimators.mdn import ACTIVATIONS, MDN
from jaxlfi.estimators.normaliser import TRANSFORMS, Normaliser, fit_normaliser, normalised

FAMILIES = ("mdn", *FLOWS)
"""Density estimators by name."""

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
        family: "mdn", the paper's mixture density network, or a conditional normalizing flow of appendix A, "maf" or
            "nsf" (`jaxlfi.estimators.flows`), whose posterior is seen by the heuristics as a mixture of K Gaussians fitted to
            its draws.
        transforms: of a flow.
        loss: "likelihood", or "atomic" or "combined", which need no correction for the proposals
            (`jaxlfi.estimators.losses.LOSSES`).
        normaliser: "zscore", "asinh" or "none" (`jaxlfi.estimators.normaliser.TRANSFORMS`). It belongs to the network: computed
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
    ensemble_size: int = static(1)
    epochs: int = static(1000)
    steps: int = static(0)
    batch_size: int = static(100)
    schedule: str = static("constant")
    validation: float = static(0.0)
    patience: int = static(0)
    warm_start: bool = static(True)
    family: str = static("mdn")
    transforms: int = static(5)
    loss: str = static("likelihood")
    normaliser: str = static("zscore")

    def check(self) -> "Estimator":
        """Refuse settings that cannot work, by name; returns the estimator."""
        choices = {
            "activation": ACTIVATIONS,
            "normaliser": TRANSFORMS,
            "schedule": SCHEDULES,
            "family": FAMILIES,
            "loss": LOSSES,
        }
        for field, known in choices.items():
            if getattr(self, field) not in known:
                raise ValueError(f"{field}: expected one of {sorted(known)}, got {getattr(self, field)!r}")
        for field in ("components", "ensemble_size", "batch_size"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field}: expected at least 1, got {getattr(self, field)}")
        if (self.epochs > 0) == (self.steps > 0):
            raise ValueError(f"expected epochs or steps, one of them above 0, got {self.epochs} and {self.steps}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: expected at least one layer of at least one unit, got {self.hidden}")
        if self.is_flow and len(set(self.hidden)) > 1:
            raise ValueError(f"hidden: expected layers of equal width for a flow, got {self.hidden}")
        if not 0 <= self.validation < 1:
            raise ValueError(f"validation: expected a fraction in [0, 1), got {self.validation}")
        if self.patience and not self.validation:
            raise ValueError("patience: expected validation above 0 to stop by, got validation=0")
        return self

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one member for D parameters."""
        if self.is_flow:
            return FLOWS[self.family](dim, self.transforms, self.hidden[0], len(self.hidden) - 1, self.activation)
        return MDN(self.components, dim, self.hidden, self.activation)

    @property
    def is_flow(self) -> bool:
        """Whether the posterior is a flow, from which a mixture is fitted."""
        return self.family != "mdn"


@struct.dataclass
class Network:
    """Trained weights of all members with the normalisers they belong to.

    Attributes:
        params: Flax parameters with a leading axis of length `members`.
        normaliser: what summaries are centred and scaled by.
        theta_normaliser: what parameters, scaled to [-1, 1]^D, are centred and scaled by for a flow, which starts as
            a standard normal; none for an MDN (reading D).
    """

    params: dict
    normaliser: Normaliser
    theta_normaliser: Normaliser | None = None

    def to_network(self, unit: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """Parameters scaled to [-1, 1]^D, as the network sees them."""
        if self.theta_normaliser is None:
            return unit
        return (unit - self.theta_normaliser.mean) / self.theta_normaliser.scale

    def to_unit(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """The way back."""
        if self.theta_normaliser is None:
            return theta
        return theta * self.theta_normaliser.scale + self.theta_normaliser.mean


def initialise(key: jax.Array, estimator: Estimator, dim: int, obs: int) -> dict:
    """Fresh weights for every member."""
    module = estimator.module(dim)
    return jax.vmap(lambda k: module.init(k, jnp.zeros(obs)))(jax.random.split(key, estimator.ensemble_size))


def normalisers(estimator: Estimator, dataset: Dataset, scale: Support) -> tuple[Normaliser, Normaliser | None]:
    """The normalisers of a network that starts on these simulations: of summaries, and for a flow of parameters."""
    of_x = fit_normaliser(estimator.normaliser, dataset.x, dataset.valid)
    if not estimator.is_flow:
        return of_x, None
    return of_x, fit_normaliser("zscore", scale.to_unit(dataset.theta), dataset.valid)


def condition(estimator: Estimator, network: Network, x: Float[Array, " obs"], scale: Support) -> GaussianMixture:
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


def draw(
    key: jax.Array, estimator: Estimator, network: Network, x: Float[Array, " obs"], scale: Support, n: int
) -> Float[Array, "n dim"]:
    """`n` draws of a flow's q_phi(theta | x) in coordinates, from all members in turn; some may leave any support."""
    module = estimator.module(scale.dim)
    x = normalised(estimator.normaliser, network.normaliser, x)
    keys = jax.random.split(key, estimator.ensemble_size)
    draws = jax.vmap(lambda key, params: module.apply(params, x).sample(key, n))(keys, network.params)
    turn = jnp.arange(n) % estimator.ensemble_size
    return scale.centre + 0.5 * scale.width * network.to_unit(draws[turn, jnp.arange(n)])
