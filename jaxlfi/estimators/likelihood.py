"""Likelihoods: networks for the density of the summary given the parameters, and the posterior that follows from one.

Sequential neural likelihood (Papamakarios, Sterratt and Murray 2019). The density of the summary given the parameters
does not depend on the proposals, so that the simulations of all rounds can be pooled as they are.
"""

from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_fit import fit_mixture
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.region import region
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Estimator, Network
from jaxlfi.estimators.losses import Rows
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.estimators.tempering import LEAST, require_blackjax, tempered
from jaxlfi.fields import hyperparameter, option

EVERYWHERE = 8
"""Candidates of each draw that are uniform over the support: they cover what the mixture misses."""
CANDIDATES = 32
"""Candidates that each draw is picked from: these uniform ones, and draws of the mixture."""
EVIDENCE = 128
"""Number of sets of candidates; the evidence is estimated by their mean weight."""
BLOCK = 256
"""Number of draws made at a time, which bounds the memory for their candidates."""


class Likelihood(Estimator):
    """Base of all likelihood networks.

    Their Flax module maps parameters to a density of the normalised summary; the ensemble's likelihood is the mean of
    its networks'. The posterior on a support is the likelihood of the observation times the prior, drawn from by
    tempered sequential Monte Carlo (`jaxlfi.estimators.tempering`).

    The network's likelihood is that of *valid* simulations, p(x | theta, valid). It is multiplied by the probability of
    a valid simulation given theta, which is learnt separately from all attempts (`jaxlfi.estimators.validity`).

    Attributes:
        noise_floor: standard deviation of the normal noise that is added to normalised summaries before each round's
            training. If summaries hardly vary for given parameters, the learnt likelihood is as sharp as a network can
            make it, and wrong by more than its width. With the noise, it is the likelihood of an observation known to
            within this fraction of the summaries' standard deviation. A leaf.
        particles: number of particles of sequential Monte Carlo.
    """

    noise_floor: Float[Array, "*batch"] | float = hyperparameter(
        default=0.03, low=0.0, high=1.0, help="noise added to the summaries before training a likelihood"
    )
    particles: int = option(default=1000, low=10, help="SMC particles (likelihood methods)")

    is_likelihood: ClassVar[bool] = True

    def check(self) -> "Likelihood":
        """Refuse settings that cannot work, by name; returns the settings."""
        super().check()
        if self.loss != "likelihood":
            raise ValueError(f"loss: expected 'likelihood' for {type(self).__name__}, got {self.loss!r}")
        if self.embedding != "none":
            raise ValueError(
                f"embedding: expected 'none' for {type(self).__name__}, which learns the density of the summary, "
                f"got {self.embedding!r}"
            )
        require_blackjax()
        return self

    def check_for(self, dim: int, obs: int = 1) -> None:
        """Refuse settings that make no network for S summaries given D parameters."""
        super().check_for(obs, dim)

    def initialise(self, key: jax.Array, dim: int, obs: int) -> dict:
        """Fresh weights for every network of the ensemble."""
        return super().initialise(key, obs, dim)

    def rows(
        self,
        key: jax.Array,
        theta: Float[Array, "n dim"],
        x: Float[Array, "n obs"],
        weights: Float[Array, " n"],
        log_prior: Float[Array, " n"],
        from_prior: Float[Array, " n"],
    ) -> Rows:
        """Noisy summaries given parameters. All rows count equally: weights only reflect how parameters were drawn."""
        x = x + self.noise_floor * jax.random.normal(key, x.shape)
        return Rows(x, theta, (weights > 0).astype(weights.dtype), log_prior, from_prior)

    def log_likelihood(
        self, network: Network, x: Float[Array, " obs"], theta: Float[Array, "*n dim"]
    ) -> Float[Array, "*n"]:
        """Log-density of success with the normalised summary of x, given theta [..., D] in inference space."""
        module: Any = self.module(x.shape[-1])
        given = network.to_network(theta)
        value = jnp.broadcast_to(network.normaliser(x), (*theta.shape[:-1], x.shape[-1]))
        each = jax.vmap(lambda params: module.apply(params, given).log_prob(value))(network.params)
        of_valid = jax.nn.logsumexp(each, axis=0) - jnp.log(self.ensemble_size)
        return of_valid if network.validity is None else of_valid + network.validity.log_prob(theta)

    def condition(
        self, network: Network, x: Float[Array, " obs"], support: Support, key: jax.Array | None
    ) -> "LikelihoodPosterior":
        """The posterior on a support, by sequential Monte Carlo from the prior there; see `Network.condition`."""
        key_start, key_draw, key_fit = jax.random.split(jax.random.key(0) if key is None else key, 3)
        inside = region(support, network.prior)
        start = inside.sample(key_start, self.particles)
        draws = tempered(
            key_draw,
            start,
            lambda theta: jnp.where(inside.contains(theta), _log_prior(network, theta), -jnp.inf),
            lambda theta: self.log_likelihood(network, x, theta),
        ).theta
        mixture, _ = fit_mixture(key_fit, draws, jnp.ones(self.particles), self.ensemble_size * self.components)
        return self.posterior(network, x, mixture, support)

    def posterior(
        self, network: Network, x: Float[Array, " obs"], mixture: GaussianMixture, support: Support
    ) -> "LikelihoodPosterior":
        """The posterior on a support, given a mixture that approximates it."""
        density = LikelihoodDensity(network, x, mixture, support, jnp.zeros(()))
        _, log_weight = density.candidates(jax.random.key(0), EVIDENCE)
        density = density.replace(log_evidence=jax.nn.logsumexp(log_weight) - jnp.log(log_weight.size))
        return LikelihoodPosterior(density, mixture, support, jnp.zeros(()), network.space, network.prior)


def _log_prior(network: Network, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
    """Log-density of the prior in inference space, up to a constant."""
    return jnp.zeros(theta.shape[:-1]) if network.prior is None else network.prior.log_prob(theta)


class LikelihoodDensity(struct.PyTreeNode):
    """Likelihood times prior on a box, divided by the evidence: a posterior that is already truncated.

    Attributes:
        network: the likelihood.
        x: the observed summary, shape [S].
        mixture: approximation of the posterior, from which candidates are drawn.
        support: the box, in inference space.
        log_evidence: logarithm of the integral of likelihood times prior over the box. The likelihood is over
            normalised summaries, and a uniform prior is 1 everywhere.
    """

    network: Network
    x: Float[Array, "*batch obs"]
    mixture: GaussianMixture
    support: Support
    log_evidence: Float[Array, "*batch"]

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta; -inf outside of the box."""
        log_likelihood = cast(Likelihood, self.network.estimator).log_likelihood(self.network, self.x, theta)
        joint = jnp.maximum(jnp.nan_to_num(log_likelihood, nan=LEAST), LEAST) + _log_prior(self.network, theta)
        inside = region(self.support, self.network.prior).contains(theta)
        return jnp.where(inside, joint - self.log_evidence, -jnp.inf)

    def candidates(self, key: jax.Array, n: int) -> tuple[Float[Array, "n m dim"], Float[Array, "n m"]]:
        """`n` sets of `CANDIDATES` draws from mixture and box, and the logarithms of their importance weights.

        The weights are relative to the mixture of both sources (the balance heuristic; Veach 1997).
        """
        key_box, key_mixture = jax.random.split(key)
        box = self.support.sample(key_box, n * EVERYWHERE).reshape(n, EVERYWHERE, -1)
        mixture = self.mixture.sample(key_mixture, n * (CANDIDATES - EVERYWHERE)).reshape(
            n, CANDIDATES - EVERYWHERE, -1
        )
        theta = jnp.concatenate([box, mixture], axis=1)
        fraction = EVERYWHERE / CANDIDATES
        uniform = jnp.log(fraction) - jnp.sum(jnp.log(self.support.width))
        log_drawn = jnp.logaddexp(uniform, jnp.log1p(-fraction) + self.mixture.log_prob(theta))
        return theta, self.log_prob(theta) - log_drawn

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` independent draws, each resampled by weight from its own candidates (Rubin 1988)."""
        if n > BLOCK:
            keys = jax.random.split(key, -(-n // BLOCK))
            return jax.lax.map(lambda key: self.sample(key, BLOCK), keys).reshape(-1, self.support.dim)[:n]
        key_candidates, key_pick = jax.random.split(key)
        theta, log_weight = self.candidates(key_candidates, n)
        picked = jax.random.categorical(key_pick, log_weight)
        theta = jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0]
        if self.network.prior is None:
            return theta
        # The prior may be zero at all candidates of a draw.
        instead = region(self.support, self.network.prior).sample(jax.random.fold_in(jax.random.clone(key_pick), 1), n)
        return jnp.where(jnp.any(log_weight > -jnp.inf, axis=1, keepdims=True), theta, instead)


class LikelihoodPosterior(Posterior, repr=False):
    """The posterior from a likelihood: it has no mass outside its support, and is recomputed for another one."""

    density: LikelihoodDensity

    def inner_draws(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws in inference space."""
        return self.density.sample(key, n)

    def on(self, support: Support) -> "LikelihoodPosterior":
        """The posterior under the prior on another support, in inference space."""
        return _condition(self.density.network, self.density.x, support)


_condition = jax.jit(single(lambda network, x, support: network.condition(x, support)))
