"""Estimators: the settings of a family of density estimators, and the network trained with them."""

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_fit import fit_mixture
from jaxlfi.distributions.region import region
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import Place
from jaxlfi.estimators.dataset import Dataset, empty
from jaxlfi.estimators.density import Density, EnsembleDensity
from jaxlfi.estimators.embeddings import EMBEDDINGS, Embedded
from jaxlfi.estimators.losses import LOSSES, Rows
from jaxlfi.estimators.normaliser import TRANSFORMS, Normaliser, fit_normaliser, standardiser
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.estimators.regression import Regression, features_size, fit_regression, unfitted
from jaxlfi.fields import Checked, check_fields, declared, hyperparameter, option

FIT_DRAWS = 1000
"""Number of draws of a density that its mixture of Gaussians is fitted to."""

FEW = 9
"""Length of a summary up to which a network that sees regression features sees its numbers as well.

Among a few numbers it finds what a regression loses. A regression of nine on four parameters loses half: without them,
one run in eight on a wrong support stays lost. With more, it learns by heart what they say beyond the features: with
twelve, standard deviations came out 0.82 times the exact ones, and 0.95 times from features alone.
"""

SCHEDULES = {"constant": jnp.ones_like, "cosine": lambda progress: 0.5 * (1 + jnp.cos(jnp.pi * progress))}
"""The learning rate's factor at a point of progress through the round's fitting, by name."""


class Estimator(Checked, abc.ABC):
    """Base class of all density estimators: the ensemble and its training.

    A family is one subclass with the settings that it alone has and one method, `module`; the class is then a frozen
    dataclass and a pytree, without a decorator. Its Flax module maps a normalised summary to a conditional density: a
    pytree with `log_prob(theta)`, which broadcasts over axes in front, and `sample(key, n)`. Heuristics and proposals
    see that density as a mixture of Gaussians fitted to its draws. The defaults are the paper's (section III-C). A
    package registers its estimators by `[project.entry-points."jaxlfi.estimators"]` in pyproject.toml.

    Attributes:
        learning_rate: Adam's step size. A leaf, as are the next two: a grid over them is one vmap.
        weight_decay: decoupled weight decay (AdamW), per step and relative to the learning rate.
        clip_norm: global norm the gradients are clipped to.
        components: Gaussians K of each network's mixture, its own or the one fitted to it.
        ensemble_size: networks E; the posterior is their mixture, of E K Gaussians, equally weighted unless they are of
            different kinds.
        epochs: full passes over the dataset each round (docs/paper.md, reading B), after twenty rounds over a part of
            it, in turn; 0 where `steps` counts instead.
        steps: gradient steps each round, rounded up to epochs of equal length; 0 where `epochs` counts.
        batch_size: simulations in a minibatch, drawn from the filled rows only.
        schedule: "constant", or "cosine" to zero within the round.
        validation: fraction of the simulations held out to choose the best weights by; 0 keeps the last weights.
        patience: stop after so many epochs without a better validation loss; 0 runs all epochs.
        warm_start: continue from the last round's weights, or reinitialise them each round (docs/paper.md, reading C).
        loss: "likelihood", or "atomic" or "combined", which need no correction for the proposals
            (`jaxlfi.estimators.losses.LOSSES`).
        normaliser: "zscore", "asinh" or "none" (`jaxlfi.estimators.normaliser`): how raw summaries are normalised. It
            belongs to the network: computed where the network starts and kept while it is trained on.
        embedding: "none", or a network before the family's own that makes a few features of a long summary and is
            trained with it (`jaxlfi.estimators.embeddings`): "mlp" of any summary, "series" of a raw trajectory,
            "trials" of records in no order. With the last two, numbers at the same place of all records are
            normalised alike.
        features: numbers F that the embedding makes of a summary.
        reduction: "none", or "regression": in place of summaries longer than `FEW`, and beside shorter ones, the
            network sees what linear regressions on them, and on the statistics of a series, predict the parameters to
            be (`jaxlfi.estimators.regression`). "half": half of the ensemble sees this, half the summaries alone, and
            the posterior that a run reports weights them by their log score on simulations held out
            (`jaxlfi.estimators.stacking`). An embedding takes its place, and a network that is trained on
            (`warm_start`) or gives a density of the summary sees none.
        record_size: numbers of a record in the summary that is embedded or reduced: the channels of a series, the
            length of one trial. 0 is what the task's summary has (`jaxlfi.tasks.summaries.layout`).

    Raises:
        ValueError: from `check` for settings that contradict each other.
    """

    learning_rate: Float[Array, "*batch"] | float = hyperparameter(
        default=1e-5, above=0.0, help="learning rate of Adam"
    )
    weight_decay: Float[Array, "*batch"] | float = hyperparameter(default=0.0, low=0.0, help="decoupled weight decay")
    clip_norm: Float[Array, "*batch"] | float = hyperparameter(
        default=math.inf,
        above=0.0,
        high=math.inf,
        help="gradients are clipped to this norm; inf: no clipping",
    )
    components: int = option(default=4, low=1, high=1_000_000, help="number K of Gaussians in each network's mixture")
    ensemble_size: int = option(default=1, low=1, high=1_000_000, help="number of networks in the ensemble")
    epochs: int = option(default=1000, low=0, help="passes over the data per round")
    steps: int = option(default=0, low=0, help="gradient steps per round, instead of epochs")
    batch_size: int = option(default=100, low=1, help="simulations per minibatch")
    schedule: str = option(default="constant", choices=tuple(SCHEDULES), help="learning-rate schedule within a round")
    validation: float = option(
        default=0.0, low=0.0, high=0.9, help="fraction of the data held out for validation, to select the best weights"
    )
    patience: int = option(
        default=0, low=0, help="epochs without a better validation loss before training stops; 0: no early stopping"
    )
    warm_start: bool = option(default=True, help="start each round from the last round's weights instead of new ones")
    loss: str = option(
        default="likelihood",
        choices=tuple(LOSSES),
        help="training loss; atomic and combined need no correction for the proposals",
    )
    normaliser: str = option(default="zscore", choices=tuple(TRANSFORMS), help="how summaries are normalised")
    embedding: str = option(
        default="none",
        choices=("none", *EMBEDDINGS),
        help="network that extracts features from long summaries, trained jointly with the density",
    )
    features: int = option(default=16, low=1, help="number of features that the embedding extracts")
    reduction: str = option(
        default="none",
        choices=("none", "regression", "half"),
        help="which networks see predictions of regressions: none, all (regression) or half",
    )
    record_size: int = option(
        default=0,
        low=0,
        help="numbers per record of the summary (channels of a series, length of a trial); 0: as the task says",
    )

    closed_form: ClassVar[bool] = False
    """Whether the density is a mixture of Gaussians, which needs no fit and can be corrected in closed form."""
    of_summaries: ClassVar[bool] = False
    """Whether the density is that of the summary given the parameters: a likelihood, whatever was proposed."""

    @property
    def accounts_for_prior(self) -> bool:
        """Whether posteriors account for a task's own prior, whatever was proposed."""
        return self.of_summaries or self.loss != "likelihood"

    @abc.abstractmethod
    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for D parameters."""

    def check(self) -> "Estimator":
        """Refuse settings that cannot work, by name; returns the settings."""
        check_fields(self)
        if (self.epochs > 0) == (self.steps > 0):
            raise ValueError(f"epochs, steps: expected one of them above 0, got {self.epochs} and {self.steps}")
        if self.patience and not self.validation:
            raise ValueError("patience: expected validation above 0 for early stopping, got validation=0")
        if self.loss != "likelihood" and self.batch_size < 2:
            raise ValueError(
                f"batch_size: expected at least 2, as the loss {self.loss!r} compares the simulations of a minibatch, "
                f"got {self.batch_size}"
            )
        if self.record_size and self.embedding == self.sees == "none":
            raise ValueError(f"record_size: expected 0 without an embedding or a reduction, got {self.record_size}")
        return self

    def check_for(self, dim: int, obs: int = 1) -> None:
        """Refuse settings that make no network for D parameters and S summaries.

        Raises:
            ValueError: in one line.
        """
        try:
            jax.eval_shape(self.module(dim).init, jax.random.key(0), jnp.zeros(obs))
        except ValueError as error:
            raise ValueError(str(error).splitlines()[0]) from error

    def embedded(self, dim: int) -> nn.Module:
        """The whole network of one ensemble member for D parameters: the family's own, behind its embedding."""
        head = self.module(dim)
        if self.embedding == "none":
            return head
        return Embedded(EMBEDDINGS[self.embedding].module(self.features), head, self.record_size)

    def reading(self, layout: tuple[int, ...]) -> "Estimator":
        """The same settings for summaries of this layout (`jaxlfi.tasks.summaries.layout`).

        Raises:
            ValueError: where the summary is not made of whole records.
        """
        if self.embedding == self.sees == "none":
            return self
        size = math.prod(layout)
        default = layout[-1] if self.embedding == "none" else EMBEDDINGS[self.embedding].record_size(layout)
        record_size = self.record_size or default
        if size % record_size:
            raise ValueError(f"record_size: expected a divisor of the summary's {size} numbers, got {record_size}")
        return self.replace(record_size=record_size)

    @property
    def standardises(self) -> bool:
        """Whether the network sees parameters by their mean and standard deviation over the simulations it learns from.

        A density that starts as a standard normal has to.
        """
        return True

    @property
    def sees(self) -> str:
        """The reduction, where there is none instead of it."""
        return "none" if self.embedding != "none" or self.warm_start or self.of_summaries else self.reduction

    @property
    def alike(self) -> int:
        """Numbers of a record where numbers at the same place of all records are normalised alike; else 0."""
        return 0 if self.embedding == "none" else self.record_size

    def inputs(self, dim: int, obs: int) -> int:
        """The number of inputs of the network for a summary of length S and D parameters."""
        features = 0 if self.sees == "none" else features_size(dim, obs, self.record_size or 1)
        return features if self.replaces(obs) else obs + features

    def replaces(self, obs: int) -> bool:
        """Whether no network of the ensemble sees the numbers of a summary of length S, but features alone."""
        return self.sees == "regression" and obs > FEW

    def views(self, dim: int, obs: int) -> np.ndarray | None:
        """What each network of the ensemble sees of its inputs, as factors, shape [E, G]; None where all see all.

        The first half of the ensemble sees the summaries, the other the features of the regressions, and the summaries
        where they are short; the factors leave the sum of the inputs' variances as large as the networks' initial
        weights are made for.
        """
        if self.sees != "half":
            return None
        inputs = self.inputs(dim, obs)
        of_summaries = np.arange(inputs) < obs
        sees = np.where(self.sees_features[:, None], ~of_summaries | (obs <= FEW), of_summaries).astype(float)
        return (sees * np.sqrt(inputs / sees.sum(axis=1, keepdims=True))).astype(np.float32)

    @property
    def sees_features(self) -> np.ndarray:
        """Which networks of the ensemble see features of regressions, shape [E]."""
        first = 0 if self.sees == "regression" else (self.ensemble_size + 1) // 2
        return np.arange(self.ensemble_size) >= (self.ensemble_size if self.sees == "none" else first)

    @property
    def stacked(self) -> bool:
        """Whether networks of different kinds make up the ensemble, so that the reported posterior weights them."""
        return self.sees != "none"

    @property
    def equal_weights(self) -> Float[Array, " member"]:
        """Log-weights of the ensemble's networks where nothing tells them apart."""
        return jnp.full(self.ensemble_size, -math.log(self.ensemble_size))

    def keys(self, key: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        """Keys to fit by and to condition by; a mixture of Gaussians is read off the network without one."""
        return (key, None) if self.closed_form else tuple(jax.random.split(key))

    def initialise(self, key: jax.Array, dim: int, obs: int) -> dict:
        """Fresh weights for every network of the ensemble."""
        module: Any = self.embedded(dim)
        inputs = self.inputs(dim, obs)
        return jax.vmap(lambda k: module.init(k, jnp.zeros(inputs)))(jax.random.split(key, self.ensemble_size))

    def begin(
        self,
        params: dict,
        theta: Float[Array, "n dim"],
        x: Float[Array, "n given"],
        valid: Bool[Array, " n"],
        views: np.ndarray | None,
    ) -> dict:
        """Fresh weights, changed by what the first simulations are, as the networks see them; here nothing is."""
        return params

    def rows(
        self,
        key: jax.Array,
        theta: Float[Array, "n dim"],
        x: Float[Array, "n obs"],
        weights: Float[Array, " n"],
        log_prior: Float[Array, " n"],
        from_prior: Float[Array, " n"],
    ) -> Rows:
        """The rows that a round trains on (`Rows`), from parameters and summaries as the network sees them."""
        return Rows(value=theta, given=x, weights=weights, log_prior=log_prior, from_prior=from_prior)

    def condition(
        self, network: "Network", x: Float[Array, " obs"], support: Support, key: jax.Array | None
    ) -> Posterior:
        """See `Network.condition`."""
        density, inside = self.density(network, x), region(support, network.prior)
        return truncated(density, self.mixture(key, density, inside), support, network.space, network.prior)

    def posterior(
        self, network: "Network", x: Float[Array, " obs"], mixture: GaussianMixture, support: Support
    ) -> Posterior:
        """The same posterior on another support, where the mixture that goes with it is known already."""
        return truncated(self.density(network, x), mixture, support, network.space, network.prior)

    def density(self, network: "Network", x: Float[Array, " obs"]) -> Density:
        """q_phi(theta | x) in inference space, not truncated: the whole ensemble."""
        module = self.embedded(network.scale.dim)
        x = network.given(x)
        each = jax.vmap(lambda params, view: module.apply(params, viewed(x, view)))(network.params, network.views)
        shift, scale = network.from_network()
        log_weights = self.equal_weights if network.log_weights is None else network.log_weights
        return EnsembleDensity(each, shift, scale, log_weights)

    def mixture(self, key: jax.Array | None, density: Density, support: Place) -> GaussianMixture:
        """The density as E K Gaussians: fitted to its draws inside the support.

        Inside, as a density that was trained by the atomic loss may leak any amount of mass to where no simulation was.
        """
        key_draw, key_fit = jax.random.split(jax.random.key(0) if key is None else key)
        draws = density.sample(key_draw, FIT_DRAWS)
        inside = support.contains(draws)
        weights = jnp.where(jnp.any(inside), inside, True).astype(draws.dtype)
        return fit_mixture(key_fit, draws, weights, self.ensemble_size * self.components)[0]


def viewed(given: Float[Array, "*n given"], view: Float[Array | np.ndarray, " given"] | None) -> Array:
    """The part of the inputs that one network sees, by its row of `Estimator.views`."""
    return given if view is None else given * view


class Network(struct.PyTreeNode):
    """A trained density estimator: its settings, the weights of the ensemble, and its normalisers.

    Attributes:
        estimator: the settings it was made with.
        params: Flax parameters with a leading axis of length E.
        normaliser: what summaries are transformed, centred and scaled by.
        theta_normaliser: what parameters, scaled to [-1, 1]^D, are centred and scaled by; None where the network sees
            them as they are (`Estimator.standardises`).
        scale: the box in inference space that [-1, 1]^D stands for, Phi.
        space: the map between inference space and natural units.
        regression: makes the features that the network sees instead of, or in addition to, the normalised summaries;
            None where it sees the summaries alone.
        log_weights: of the ensemble's networks in the posterior that is reported, shape [E]; None for equal ones.
        prior: the task's own prior over inference space, None for a uniform one. A likelihood is multiplied by it; a
            density that is the posterior has it in it, and is cut off where the prior is zero.
        validity: the probability of success by the parameters (`jaxlfi.estimators.validity`), where what is learnt from
            simulations that succeeded lacks it; else None.
    """

    estimator: Estimator
    params: dict
    normaliser: Normaliser
    theta_normaliser: Normaliser | None
    scale: Support
    space: Space = struct.field(pytree_node=False)
    prior: Any = struct.field(pytree_node=False, default=None)
    validity: Any = None
    regression: Regression | None = None
    log_weights: Any = None

    def given(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n given"]:
        """The network's inputs for raw summaries."""
        if self.regression is None:
            return self.normaliser(x)
        return self._beside(x, self.regression(x))

    def condition(self, x: Float[Array, " obs"], support: Support, key: jax.Array | None = None) -> Posterior:
        """The posterior of a raw summary (Algorithm 1, line 11), truncated to a support.

        Args:
            x: the summary, shape [S].
            support: in inference space; for the posterior under the prior, the box the simulations were drawn from.
            key: for the mixture fitted to draws; a mixture density network needs none. Always the same by default.
        """
        return self.estimator.condition(self, x, support, key)

    def to_network(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """Parameters in inference space as the network sees them."""
        unit = self.scale.to_unit(theta)
        if self.theta_normaliser is None:
            return unit
        return self.theta_normaliser(unit)

    def from_network(self) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Shift and scale from what the network sees to inference space."""
        half = 0.5 * self.scale.width
        if self.theta_normaliser is None:
            return self.scale.centre, half
        return self.scale.centre + half * self.theta_normaliser.mean, half * self.theta_normaliser.scale

    def begun(self, dataset: Dataset) -> tuple["Network", Float[Array, "cap given"]]:
        """The same fresh weights with all that a network takes from the simulations it starts on, and what it sees.

        What it sees of these simulations is what it learns from: features of a row are those of regressions without it.
        """
        of_x, of_theta = _normalisers(self.estimator, dataset, self.scale)
        network = self.replace(normaliser=of_x, theta_normaliser=of_theta)
        theta, x = network.to_network(dataset.theta), of_x(dataset.x)
        if self.regression is not None:
            # Simulations of the later half of the rounds, which are nearer to the observation.
            fitted, features = fit_regression(self.regression, theta, dataset.x, dataset.valid, dataset.late)
            network, x = network.replace(regression=fitted), network._beside(dataset.x, features)
        return network.replace(params=self.estimator.begin(self.params, theta, x, dataset.valid, self.views)), x

    def _beside(self, x: Array, features: Array) -> Array:
        if self.estimator.replaces(x.shape[-1]):
            return features
        return jnp.concatenate([self.normaliser(x), features], axis=-1)

    @property
    def views(self) -> np.ndarray | None:
        """What each network of the ensemble sees of what is given (`Estimator.views`)."""
        return self.estimator.views(self.scale.dim, self.normaliser.mean.shape[-1])

    def restarted(self, key: jax.Array, dataset: Dataset) -> tuple["Network", Float[Array, "cap given"]]:
        """Fresh weights and the normalisers of these simulations, and what the network sees of them."""
        params = self.estimator.initialise(key, self.scale.dim, dataset.x.shape[-1])
        return self.replace(params=params).begun(dataset)


def converted(estimator: Estimator, kind: type[Estimator], values: Mapping[str, Any]) -> Estimator:
    """An estimator of another family, with the settings that both have, and some of them replaced.

    Raises:
        ValueError: for settings the family does not have or does not accept.

    Example:
        >>> from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
        >>> converted(SplineFlow(transforms=3, bins=8), MaskedFlow, {"epochs": 10}).transforms
        3
    """
    known = declared(kind)
    if foreign := sorted(set(values) - set(known)):
        raise ValueError(
            f"{foreign[0]}: expected a setting of {kind.__name__} ({', '.join(known)}), got one it does not have"
        )
    if isinstance(estimator, kind) and type(estimator) is kind:
        return dataclasses.replace(estimator, **values)
    shared = {name: getattr(estimator, name) for name in declared(estimator) if name in known}
    return kind(**(shared | dict(values)))


def untrained(
    key: jax.Array, estimator: Estimator, obs: int, scale: Support, space: Space, prior: Any = None
) -> Network:
    """A network before any training, for summaries of length `obs`; the prior is `Task.inference.prior`."""
    estimator = jax.tree.map(jnp.asarray, estimator).reading((obs, 1))  # its leaves are carried through loops
    nothing = empty(1, scale.dim, obs)
    params = estimator.initialise(key, scale.dim, obs)
    regression = None if estimator.sees == "none" else unfitted(scale.dim, obs, estimator.record_size)
    log_weights = estimator.equal_weights if estimator.stacked else None
    normalisers = _normalisers(estimator, nothing, scale)
    return Network(estimator, params, *normalisers, scale, space, prior, regression=regression, log_weights=log_weights)


def _normalisers(estimator: Estimator, dataset: Dataset, scale: Support) -> tuple[Normaliser, Normaliser | None]:
    of_x = fit_normaliser(estimator.normaliser, dataset.x, dataset.valid, estimator.alike)
    if not estimator.standardises:
        return of_x, None
    return of_x, standardiser(scale.to_unit(dataset.theta), dataset.valid)
