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
from jaxlfi.estimators.averages import seen, seen_size
from jaxlfi.estimators.dataset import Dataset, empty
from jaxlfi.estimators.density import Density, EnsembleDensity
from jaxlfi.estimators.embeddings import EMBEDDINGS, Embedded
from jaxlfi.estimators.kernel import MOST_ROWS
from jaxlfi.estimators.losses import LOSSES, Rows
from jaxlfi.estimators.normaliser import TRANSFORMS, Normaliser, fit_normaliser, standardiser
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.estimators.regression import KernelRegression, Regression, features_size, unfitted, unfitted_kernels
from jaxlfi.fields import Checked, check_fields, declared, hyperparameter, option

FIT_DRAWS = 1000
"""Number of draws of a density to which its mixture of Gaussians is fitted."""

SCHEDULES = {"constant": jnp.ones_like, "cosine": lambda progress: 0.5 * (1 + jnp.cos(jnp.pi * progress))}
"""Factor of the learning rate, as a function of the progress through the round's training, by name."""


class Estimator(Checked, abc.ABC):
    """Base class of all density estimators: the ensemble and its training.

    A family is a subclass with its own settings and one method, `module`; it becomes a frozen dataclass and a pytree
    without a decorator. Its Flax module maps a normalised summary to a conditional density: a pytree with
    `log_prob(theta)`, which broadcasts over leading axes, and `sample(key, n)`. Heuristics and proposals use a mixture
    of Gaussians that is fitted to draws of that density. The defaults are the paper's (section III-C). A package
    registers its estimators by `[project.entry-points."jaxlfi.estimators"]` in pyproject.toml.

    Attributes:
        learning_rate: learning rate of Adam. This and the next two settings are leaves of the pytree: one `vmap` covers
            a grid of them.
        weight_decay: decoupled weight decay (AdamW) per step, as a fraction of the learning rate.
        clip_norm: gradients are clipped to this global norm.
        components: number K of Gaussians in each network's mixture, or in the one fitted to its density.
        ensemble_size: number E of networks. The posterior is their mixture of E K Gaussians; the networks have equal
            weights, unless only some of them see or start from regressions.
        epochs: passes over the dataset in each round (docs/paper.md, reading B); 0 if `steps` is set. After twenty
            rounds an epoch covers only a part of the data, and the parts take turns.
        steps: gradient steps in each round, rounded up to epochs of equal length; 0 if `epochs` is set.
        batch_size: simulations per minibatch, drawn from the filled rows only.
        schedule: learning-rate schedule within a round: "constant", or "cosine" decay to zero.
        validation: fraction of the simulations held out to select the best weights; with 0 the last weights are kept.
        patience: number of epochs without a better validation loss after which training stops; 0 for no early stopping.
        warm_start: whether a round continues from the last round's weights or starts from new ones (docs/paper.md,
            reading C). New networks learn from the simulations near the last proposals
            (`jaxlfi.estimators.dataset.Dataset.near`), others from all of them.
        loss: "likelihood", or "atomic" or "combined", which need no correction for the proposals
            (`jaxlfi.estimators.losses.LOSSES`).
        normaliser: how raw summaries are normalised: "zscore", "asinh" or "none" (`jaxlfi.estimators.normaliser`). It
            is computed when a network starts from new weights, and kept while its training continues.
        embedding: "none", or a network that extracts features from a long summary and is trained jointly with the
            density (`jaxlfi.estimators.embeddings`): "mlp" for any summary, "series" for a raw trajectory, "trials" for
            exchangeable records. The last two normalise all records by the same numbers.
        features: number F of features that the embedding extracts.
        reduction: "none", "regression", "half" or "most". With "regression", the networks see predictions of the
            parameters by regressions on the summary and on the statistics of a series (`jaxlfi.estimators.regression`):
            instead of a summary that is longer than `short_summary`, and in addition to a shorter one. With "half",
            half of the ensemble sees these, and the other half the summary alone. "most" does the same for short
            summaries, but only a single network sees the numbers of a long one. In all three cases the reported
            posterior weights the networks by their log score on held-out simulations (`jaxlfi.estimators.stacking`).
            Networks with an embedding or a warm start, and likelihoods, use no reduction.
        regressor: what predicts the parameters for a reduction: "linear", regressions near the observation that follow
            its curvature, for rounds of proposals; or "kernel", kernel ridge regressions over all simulations, for a
            single round from the prior.
        short_summary: length of a summary up to which networks with a reduction see it as well: from a few numbers they
            learn what regressions lose.
        record_size: numbers in a record of a summary that is embedded or reduced: the channels of a series, or the
            length of a trial. 0 takes it from the task's summary (`jaxlfi.tasks.summaries.layout`).

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
        choices=("none", "regression", "half", "most"),
        help="which networks see predictions of regressions: none, all (regression), half, or most",
    )
    regressor: str = option(
        default="linear",
        choices=("linear", "kernel"),
        help="what predicts parameters for a reduction: linear regressions, or kernel ridge regressions",
    )
    short_summary: int = option(
        default=16, low=0, help="length of a summary up to which networks with a reduction see it as well"
    )
    record_size: int = option(
        default=0,
        low=0,
        help="numbers per record of the summary (channels of a series, length of a trial); 0: as the task says",
    )

    closed_form: ClassVar[bool] = False
    """Whether the density is a mixture of Gaussians: none is fitted to it, and corrections have a closed form."""
    is_likelihood: ClassVar[bool] = False
    """Whether the density is a likelihood, that of the summary given the parameters, which no proposal changes."""

    @property
    def includes_prior(self) -> bool:
        """Whether posteriors include the task's own prior, independently of the proposals."""
        return self.is_likelihood or self.loss != "likelihood"

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
        if self.record_size and self.embedding == self.active_reduction == "none":
            raise ValueError(f"record_size: expected 0 without an embedding or a reduction, got {self.record_size}")
        return self

    def check_for(self, dim: int, obs: int = 1) -> None:
        """Refuse settings that make no network for D parameters and S summaries.

        Raises:
            ValueError: with a one-line message.
        """
        try:
            jax.eval_shape(self.module(dim).init, jax.random.key(0), jnp.zeros(obs))
        except ValueError as error:
            raise ValueError(str(error).splitlines()[0]) from error

    def embedded(self, dim: int) -> nn.Module:
        """The whole network of one ensemble member for D parameters: the embedding, then the family's own network."""
        head = self.module(dim)
        if self.embedding == "none":
            return head
        return Embedded(EMBEDDINGS[self.embedding].module(self.features), head, self.record_size)

    def for_layout(self, layout: tuple[int, ...]) -> "Estimator":
        """The same settings for summaries of this layout (`jaxlfi.tasks.summaries.layout`).

        Raises:
            ValueError: if the summary does not consist of whole records.
        """
        if self.embedding == self.active_reduction == "none":
            return self
        size = math.prod(layout)
        default = layout[-1] if self.embedding == "none" else EMBEDDINGS[self.embedding].record_size(layout)
        record_size = self.record_size or default
        if size % record_size:
            raise ValueError(f"record_size: expected a divisor of the summary's {size} numbers, got {record_size}")
        return self.replace(record_size=record_size)

    @property
    def standardises(self) -> bool:
        """Whether parameters are standardised by their mean and standard deviation over the training simulations.

        A density that starts as a standard normal needs this.
        """
        return True

    @property
    def active_reduction(self) -> str:
        """The reduction in use: "none" for an embedding, a warm start or a likelihood."""
        return "none" if self.embedding != "none" or self.warm_start or self.is_likelihood else self.reduction

    @property
    def shared_record(self) -> int:
        """Length of a record if all records are normalised by the same numbers, else 0."""
        return 0 if self.embedding == "none" else self.record_size

    def inputs(self, dim: int, obs: int) -> int:
        """The number of inputs of the network for a summary of length S and D parameters."""
        if self.active_reduction == "none":
            return obs
        features = features_size(dim, obs, self.record_size or 1, kernels=self.regressor == "kernel")
        return features if self.features_only(obs) else self.seen(obs) + features

    def seen(self, obs: int) -> int:
        """How many numbers the networks see of a summary of length S: with features, they see means of a long one."""
        return obs if self.active_reduction == "none" else seen_size(obs, self.record_size or 1)

    def features_only(self, obs: int) -> bool:
        """Whether the networks see only regression features of a summary of length S."""
        return self.active_reduction == "regression" and obs > self.short_summary

    def views(self, dim: int, obs: int) -> np.ndarray | None:
        """Factors that multiply each network's inputs, shape [E, G]; None if every network sees all inputs.

        The first networks see the summaries; the others see the regression features, and short summaries, too
        (`uses_features`). Inputs that a network does not see have a factor of 0. The other factors restore the total
        input variance that the initial weights assume.
        """
        if self.active_reduction in ("none", "regression"):
            return None
        inputs = self.inputs(dim, obs)
        summary_inputs = np.arange(inputs) < self.seen(obs)
        sees = np.where(
            self.uses_features(obs)[:, None], ~summary_inputs | (obs <= self.short_summary), summary_inputs
        ).astype(float)
        return (sees * np.sqrt(inputs / sees.sum(axis=1, keepdims=True))).astype(np.float32)

    def uses_features(self, obs: int) -> np.ndarray:
        """Which networks of the ensemble see regression features for a summary of length S, shape [E].

        Networks that see the summary alone explore; but from many numbers they learn little, and keep proposals wide.
        """
        size = self.ensemble_size
        half, one = (size + 1) // 2, min(1, size - 1)
        without = {"none": size, "regression": 0, "half": half, "most": half if obs <= self.short_summary else one}
        return np.arange(size) >= without[self.active_reduction]

    @property
    def stacked(self) -> bool:
        """Whether the reported posterior weights the networks by their scores on held-out simulations."""
        return self.active_reduction != "none"

    @property
    def equal_weights(self) -> Float[Array, " member"]:
        """Log-weights of networks that count equally."""
        return jnp.full(self.ensemble_size, -math.log(self.ensemble_size))

    def keys(self, key: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        """A key for fitting and one for conditioning; a mixture of Gaussians is conditioned without one."""
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
        """Fresh weights, adapted to the first simulations as the networks see them; by default unchanged."""
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
        """The training rows of a round (`Rows`), from parameters and summaries as the network sees them."""
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
        """The same posterior on another support, for which the mixture is already known."""
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
        """The density as E K Gaussians, fitted to its draws inside the support.

        Draws outside are left out: a density trained by the atomic loss may leak any amount of mass to where nothing
        was simulated.
        """
        key_draw, key_fit = jax.random.split(jax.random.key(0) if key is None else key)
        draws = density.sample(key_draw, FIT_DRAWS)
        inside = support.contains(draws)
        weights = jnp.where(jnp.any(inside), inside, True).astype(draws.dtype)
        return fit_mixture(key_fit, draws, weights, self.ensemble_size * self.components)[0]


def viewed(given: Float[Array, "*n given"], view: Float[Array | np.ndarray, " given"] | None) -> Array:
    """The inputs of one network, multiplied by its row of `Estimator.views`."""
    return given if view is None else given * view


class Network(struct.PyTreeNode):
    """A trained density estimator: its settings, the weights of the ensemble, and its normalisers.

    Attributes:
        estimator: its settings.
        params: Flax parameters with a leading axis of length E.
        normaliser: transforms, centres and scales summaries.
        theta_normaliser: centres and scales parameters in [-1, 1]^D; None if they are not standardised
            (`Estimator.standardises`).
        scale: Phi, the box in inference space that is scaled to [-1, 1]^D.
        space: the map between inference space and natural units.
        regression: computes features that replace or extend the normalised summaries; None without a reduction.
        log_weights: log-weights of the networks in the reported posterior, shape [E]; None for equal weights.
        prior: the task's own prior over inference space, None for a uniform one. A likelihood is multiplied by it; a
            posterior density already includes it, and is truncated where the prior is zero.
        validity: the probability that a simulation succeeds, given its parameters (`jaxlfi.estimators.validity`), for
            densities that are trained on successful simulations only; else None.
    """

    estimator: Estimator
    params: dict
    normaliser: Normaliser
    theta_normaliser: Normaliser | None
    scale: Support
    space: Space = struct.field(pytree_node=False)
    prior: Any = struct.field(pytree_node=False, default=None)
    validity: Any = None
    regression: Regression | KernelRegression | None = None
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
            key: for the mixture fitted to draws; a mixture density network needs none. The default is a fixed key.
        """
        return self.estimator.condition(self, x, support, key)

    def to_network(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """Parameters in inference space, scaled as for the network."""
        unit = self.scale.to_unit(theta)
        if self.theta_normaliser is None:
            return unit
        return self.theta_normaliser(unit)

    def from_network(self) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
        """Shift and scale from the network's parameters to inference space."""
        half = 0.5 * self.scale.width
        if self.theta_normaliser is None:
            return self.scale.centre, half
        return self.scale.centre + half * self.theta_normaliser.mean, half * self.theta_normaliser.scale

    def begun(self, dataset: Dataset) -> tuple["Network", Float[Array, "cap given"]]:
        """The fresh weights with normalisers and regressions of the first simulations, and the network's inputs.

        The features of each simulation come from regressions fitted without it.
        """
        of_x, of_theta = _normalisers(self.estimator, dataset, self.scale)
        network = self.replace(normaliser=of_x, theta_normaliser=of_theta)
        theta, x = network.to_network(dataset.theta), of_x(dataset.x)
        if self.regression is not None:
            # Fitted to the later half of the rounds, whose simulations are nearer to the observation.
            fitted, features = self.regression.fitted(theta, dataset.x, dataset.valid, dataset.late)
            network, x = network.replace(regression=fitted), network._beside(dataset.x, features)
        return network.replace(params=self.estimator.begin(self.params, theta, x, dataset.valid, self.views)), x

    def _beside(self, x: Array, features: Array) -> Array:
        if self.estimator.features_only(x.shape[-1]):
            return features
        return jnp.concatenate([seen(self.normaliser(x), self.estimator.record_size or 1), features], axis=-1)

    @property
    def views(self) -> np.ndarray | None:
        """Factors that multiply each network's inputs (`Estimator.views`)."""
        return self.estimator.views(self.scale.dim, self.normaliser.mean.shape[-1])

    def restarted(self, key: jax.Array, dataset: Dataset) -> tuple["Network", Float[Array, "cap given"]]:
        """Fresh weights with normalisers of these simulations, and the network's inputs."""
        params = self.estimator.initialise(key, self.scale.dim, dataset.x.shape[-1])
        return self.replace(params=params).begun(dataset)


def converted(estimator: Estimator, kind: type[Estimator], values: Mapping[str, Any]) -> Estimator:
    """An estimator of another family with the settings that both have, some of them replaced.

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
    key: jax.Array,
    estimator: Estimator,
    obs: int,
    scale: Support,
    space: Space,
    prior: Any = None,
    rows: int = MOST_ROWS,
) -> Network:
    """A network before any training.

    Args:
        key: consumed.
        estimator: its settings.
        obs: length S of summaries.
        scale: Phi.
        space: the map between inference space and natural units.
        prior: `Task.inference.prior`.
        rows: expected number of simulations; a kernel regression has room for as many as it can use.
    """
    estimator = jax.tree.map(jnp.asarray, estimator).for_layout((obs, 1))  # its leaves are carried through loops
    nothing = empty(1, scale.dim, obs)
    params = estimator.initialise(key, scale.dim, obs)
    regression: Regression | KernelRegression | None = None
    if estimator.active_reduction != "none":
        layout = (scale.dim, obs, estimator.record_size)
        regression = unfitted(*layout) if estimator.regressor == "linear" else unfitted_kernels(*layout, rows)
    log_weights = estimator.equal_weights if estimator.stacked else None
    normalisers = _normalisers(estimator, nothing, scale)
    return Network(estimator, params, *normalisers, scale, space, prior, regression=regression, log_weights=log_weights)


def _normalisers(estimator: Estimator, dataset: Dataset, scale: Support) -> tuple[Normaliser, Normaliser | None]:
    of_x = fit_normaliser(estimator.normaliser, dataset.x, dataset.valid, estimator.shared_record)
    if not estimator.standardises:
        return of_x, None
    return of_x, standardiser(scale.to_unit(dataset.theta), dataset.valid)
