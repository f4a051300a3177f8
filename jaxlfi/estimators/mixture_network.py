"""The mixture density network as an estimator: the paper's family."""

import math
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import pool
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import Place
from jaxlfi.estimators.base import Estimator, Network, viewed
from jaxlfi.estimators.mdn import ACTIVATIONS, MDN, REGRESSION, around
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.estimators.pruning import pruned
from jaxlfi.estimators.ridge import linear_gaussian
from jaxlfi.fields import hyperparameter, option

TRUNCATED_DEVIATION = 0.87962566
"""Standard deviation of a standard normal distribution that is truncated at -2 and 2."""


class MixtureNetwork(Estimator):
    """A mixture density network (Bishop 1994; section III-C of the paper, whose numbers are the defaults).

    Attributes:
        hidden: units of each hidden layer.
        activation: "relu", "tanh" or "silu".
        parameters: how parameters are scaled for the network: "feasible", by Phi to [-1, 1]^D as in the paper, or
            "zscore", by their mean and standard deviation over the simulations (docs/paper.md, reading D). In a wide
            Phi a posterior is a dot, and small networks learn it slowly.
        prune: components of less weight than this are dropped from each network's mixture, except those of at least a
            tenth of it that the other networks confirm (`jaxlfi.estimators.pruning`). Rarely used components are
            hardly trained, so they are wide and can lie anywhere. BayesSim's first implementations prune at 0.005; the
            paper does not say. A leaf.

    Example:
        >>> MixtureNetwork(hidden=(64, 64), components=8).check().components
        8
    """

    hidden: tuple[int, ...] = option(default=(1024, 1024, 1024), low=1, help="units per hidden layer")
    activation: str = option(default="tanh", choices=tuple(ACTIVATIONS), help="activation function")
    parameters: str = option(
        default="feasible",
        choices=("feasible", "zscore"),
        help="how parameters are scaled: by Phi, or to unit variance",
    )
    prune: Float[Array, "*batch"] | float = hyperparameter(
        default=0.0,
        low=0.0,
        high=0.5,
        help="mixture components with less weight are dropped, unless other networks confirm them",
    )

    closed_form: ClassVar[bool] = True

    @property
    def standardises(self) -> bool:
        """Whether parameters are scaled by their spread over the simulations instead of by Phi."""
        return self.parameters == "zscore"

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for D parameters."""
        return MDN(self.components, dim, self.hidden, self.activation, linear=self.active_reduction != "none")

    def check(self) -> "MixtureNetwork":
        """Refuse settings that cannot work, by name; returns the settings."""
        super().check()
        if not self.hidden:
            raise ValueError("hidden: expected at least one layer, got none")
        return self

    def initialise(self, key: jax.Array, dim: int, obs: int) -> dict:
        """Fresh weights for every network of the ensemble.

        They are distributed as `MDN` declares, but come from one draw for all layers: compiling takes seconds per draw.
        """
        if self.embedding != "none":
            return super().initialise(key, dim, obs)
        declared = jax.eval_shape(self.module(dim).init, key, jnp.zeros(self.inputs(dim, obs)))
        leaves, structure = jax.tree.flatten_with_path(declared)
        drawn = [leaf.ndim == 2 and name[-1].key != REGRESSION for name, leaf in leaves]  # kernels [out, in]
        sizes = [leaf.size if own else 0 for own, (_, leaf) in zip(drawn, leaves, strict=True)]
        members = self.ensemble_size
        draws = jax.random.truncated_normal(key, -2, 2, (members, sum(sizes)), jnp.float32) / TRUNCATED_DEVIATION
        parts = jnp.split(draws, np.cumsum(sizes)[:-1], axis=1)
        fresh = [
            part.reshape(members, *leaf.shape) / math.sqrt(leaf.shape[-1])
            if own
            else jnp.zeros((members, *leaf.shape), leaf.dtype)
            for own, part, (_, leaf) in zip(drawn, parts, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, fresh)

    def begin(
        self,
        params: dict,
        theta: Float[Array, "n dim"],
        x: Float[Array, "n given"],
        valid: Bool[Array, " n"],
        views: np.ndarray | None,
    ) -> dict:
        """Fresh weights; networks that see regression features start near the Gaussian around a regression on them.

        In many dimensions a network does not find it from a thousand simulations.
        """
        if self.active_reduction == "none":
            return params

        def start(own: dict, view: Any, featured: Any) -> dict:
            coefficients, *others = linear_gaussian(viewed(x, view), theta, valid)
            fresh = own | {REGRESSION: jnp.zeros_like(coefficients)}
            begun = around(fresh, self.components, coefficients, *others)
            return jax.tree.map(lambda new, old: jnp.where(featured, new, old), begun, fresh)

        featured = np.ones(self.ensemble_size, bool) if views is None else views[:, -1] > 0  # features come last
        return {"params": jax.vmap(start)(params["params"], views, featured)}

    def density(self, network: Network, x: Float[Array, " obs"]) -> GaussianMixture:
        """q_phi(theta | x) in inference space, the whole ensemble pooled: E K components."""
        module: Any = self.embedded(network.scale.dim)
        x = network.given(x)
        one = lambda params, view: module.apply(params, viewed(x, view)).mixture()
        mixtures = jax.vmap(one)(network.params, network.views)
        log_weights = self.equal_weights if network.log_weights is None else network.log_weights
        shift, scale = network.from_network()
        return pool(pruned(mixtures, self.prune, log_weights)).affine(scale, shift)

    def weighted(self, network: Network, density: GaussianMixture) -> GaussianMixture:
        """The same density with the networks' weights, as reported by a run."""
        if network.log_weights is None:
            return density
        return density.replace(logits=density.logits + jnp.repeat(network.log_weights, self.components))

    def posterior(
        self, network: Network, x: Float[Array, " obs"], mixture: GaussianMixture, support: Support
    ) -> Posterior:
        """The mixture, which is the density itself, truncated."""
        return truncated(mixture, mixture, support, network.space, network.prior)

    def mixture(self, key: jax.Array | None, density: Any, support: Place) -> GaussianMixture:
        """The density itself."""
        return density
