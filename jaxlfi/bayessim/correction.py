"""Corrections for proposals that are not the prior, by name (docs/paper.md, reading A)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim.pooled import Quotients, log_pool, without_pool
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import product, quotient, reduce
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.untruncated import untruncated
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.tasks.priors import InferencePrior


class CorrectionInfo(struct.PyTreeNode):
    """Record of a correction in a round.

    Attributes:
        effective_size: effective number of simulations under the loss weights, (sum w)^2 / sum w^2, shape [].
        not_positive_definite: component pairs whose quotient had no positive definite covariance, shape [].
        mass_inside: mass of q_phi in the support, before any correction; the rest has leaked, shape [].
        effective_share: effective fraction of q_phi's draws under the weights that turn them into draws of the reported
            mixture; 1 if that is q_phi itself, shape [].
    """

    effective_size: Float[Array, "*batch"]
    not_positive_definite: Int[Array, "*batch"]
    mass_inside: Float[Array, "*batch"]
    effective_share: Float[Array, "*batch"]


@dataclasses.dataclass(frozen=True)
class Correction:
    """A correction from q_phi to p-hat: loss weights before the fit, and a change of the mixture after it.

    Attributes:
        row_weights: (prior, dataset, proposals, round, defensive fraction) -> weights of rows in the loss, shape [C].
        change: (prior, q, the round's proposal p_i) -> (posterior, pairs not positive definite).
        divide: (prior, q, all rounds' proposals, round, defensive fraction, support, number of simulations) -> q's
            components divided by the proposals; None if a run reports the same mixture that its proposals and
            heuristics use.
        beyond: (reported mixture, support) -> the mixture whose truncation to the support is the posterior; None if
            that is the reported one.
        includes_prior: whether the correction accounts for the task's own prior; otherwise the proposals do.
    """

    row_weights: Callable[[Any, Dataset, Belief, Array | int, Array | float], Array]
    change: Callable[[Any, GaussianMixture, Belief], tuple[GaussianMixture, Array]]
    divide: Callable[..., Quotients] | None = None
    beyond: Callable[[GaussianMixture, Support], GaussianMixture] | None = None
    includes_prior: bool = False


def equal_weights(
    prior: Any,
    dataset: Dataset,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float = 0.0,
) -> Array:
    """Weight all simulations equally, except those given with the density they were drawn from."""
    return jnp.where(dataset.valid, dataset.weight, 0.0)


def unchanged(prior: Any, q: GaussianMixture, previous: Belief) -> tuple[GaussianMixture, Array]:
    """p-hat = q: the pooled proposals are treated as uniform."""
    return q, jnp.asarray(0)


def times_reference(prior: Any, q: GaussianMixture, previous: Belief) -> tuple[GaussianMixture, Array]:
    """p-hat proportional to (p_i / p~) q, exactly as in line 11, reduced to as many components as q has.

    p~ is the prior: either uniform, and then a constant, or the task's own Gaussian, which is divided out.
    """
    posterior, _ = product(q, previous.mixture)
    bad = jnp.asarray(0)
    if prior is not None:
        posterior, info = quotient(posterior, gaussian_prior(prior), policy="skip")
        bad = info.not_positive_definite
    posterior = reduce(posterior, q.logits.shape[-1])
    posterior = jax.tree.map(lambda new, old: jnp.where(previous.informed, new, old), posterior, q)
    return posterior, jnp.where(previous.informed, bad, 0)


def divided_by_proposal(prior: Any, q: GaussianMixture, proposal: Belief) -> tuple[GaussianMixture, Array]:
    """p-hat proportional to q / p~, with the round's proposal p~ as one Gaussian of its mean and covariance.

    With proposals s times as wide as the posterior, q is too narrow by sqrt(1 - 1/s^2), which this undoes. It is exact
    for a Gaussian posterior once proposals have settled, and requires proposals wider than the posterior.
    """
    mixture = proposal.mixture
    gaussian = GaussianMixture(jnp.zeros(1), mixture.mean[None], jnp.linalg.cholesky(mixture.covariance)[None])
    posterior, info = quotient(q, gaussian)
    posterior = jax.tree.map(lambda new, old: jnp.where(proposal.informed, new, old), posterior, q)
    return posterior, jnp.where(proposal.informed, info.not_positive_definite, 0)


def importance_weights(
    prior: Any,
    dataset: Dataset,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float = 0.0,
) -> Array:
    """w(theta) = p(theta) / p~(theta), with p~ the equally weighted mixture of all rounds' proposals.

    The balance heuristic of multiple importance sampling (Veach 1997): a simulation that was likely in any round has a
    bounded weight, and the first round drew from the prior itself. Weights are truncated at sqrt(n) times their mean
    (Ionides 2008). Clipped proposals have atoms on the bounds, which the density leaves out. The defensive fraction of
    a round's proposals, drawn from the prior over its support, is part of its density.
    """
    log_pooled = log_pool(prior, proposals, round, defensive, dataset.theta, factored=False)
    log_weight = jnp.where(dataset.valid & jnp.isfinite(log_pooled), -log_pooled, -jnp.inf)
    # A simulation that was given with its density stands for this many draws of the prior.
    weight = dataset.weight * jnp.exp(log_weight - jnp.max(log_weight, initial=-1e30))
    size = jnp.maximum(dataset.size, 1)
    return jnp.minimum(weight, jnp.sqrt(size) * jnp.sum(weight) / size)


def effective_size(weights: Float[Array, " cap"]) -> Float[Array, ""]:
    """Kish's effective sample size."""
    return jnp.sum(weights) ** 2 / jnp.maximum(jnp.sum(weights**2), 1e-30)


def gaussian_prior(prior) -> GaussianMixture:
    """A Gaussian prior as a mixture of one component.

    Raises:
        ValueError: for priors that are not Gaussian.
    """
    import distrax  # takes a second; no other correction needs it

    own = prior.distribution if isinstance(prior, InferencePrior) and prior.space is None else prior
    if isinstance(own, distrax.MultivariateNormalTri | distrax.MultivariateNormalDiag):
        covariance = own.covariance()
        return GaussianMixture(jnp.zeros(1), own.mean()[None], jnp.linalg.cholesky(covariance)[None])
    raise ValueError(
        f"correction='paper' divides by the prior and needs it uniform (none given) or a distrax multivariate normal, "
        f"got {type(getattr(prior, 'distribution', prior)).__name__}; use correction='none' or 'importance'"
    )


CORRECTIONS: dict[str, Correction] = {
    "none": Correction(equal_weights, unchanged),
    # The paper taken literally: it draws from the posterior itself (line 8) and divides by the prior (line 11).
    "paper": Correction(equal_weights, times_reference, includes_prior=True),
    "quotient": Correction(equal_weights, divided_by_proposal),
    "pooled": Correction(equal_weights, unchanged, divide=without_pool, beyond=untruncated),
    "importance": Correction(importance_weights, unchanged, includes_prior=True),
}
"""Corrections by name."""
OF_MIXTURES = ("paper", "quotient", "pooled")
"""Corrections that require mixtures of Gaussians."""
