"""Pooled proposals: the distribution of all of a run's simulations, and the posterior divided by it.

A network trained by the likelihood on the simulations of all rounds learns prior * p_pool * likelihood, where p_pool is
the mixture of the rounds' proposals, relative to the prior. Divided out in the loop, the errors of one round steer the
next, and runs are lost. So proposals and heuristics go on with q as it is, and only what the run reports is q / p_pool.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.region import region
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.priors import prior_mass
from jaxlfi.tasks.task import Task

COMPONENT_POINTS = 64
"""Points of each component, at least, that its mass in a support and its weighted moments are taken over."""
HIGHEST = 4.0
"""Highest weight of a point, in geometric means of the weights under q: where the pool is thinner, q is hardly known.

Without it a stray component where hardly anything was proposed counts fiftyfold, in runs that have not settled. Weights
of posteriors that are known are within it.
"""


def log_pool(
    task: Task,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float,
    theta: Float[Array, "n dim"],
    factored: bool = True,
) -> Float[Array, " n"]:
    """Log-density of the pooled proposals, the equally weighted mixture of all rounds', relative to the prior's.

    Clipped proposals have atoms on the bounds, which are left out.

    Args:
        task: for its prior.
        proposals: of all rounds, stacked.
        round: the last that counts, from 0.
        defensive: fraction of each round's proposals drawn from the prior over its support.
        theta: in inference space, shape [N, D].
        factored: whether proposals have the prior as a factor, which then drops out.

    Returns:
        -inf where no round proposed, shape [N].
    """
    prior = task.inference.prior
    factor = prior if factored else None

    def log_density(proposal: Belief) -> Array:
        points, share = _points(proposal.mixture)
        inside = region(proposal.support, prior).contains(points)
        log_factor = jnp.zeros(len(points)) if factor is None else factor.log_prob(points)
        highest = jnp.where(jnp.any(inside), jnp.max(jnp.where(inside, log_factor, -jnp.inf)), 0.0)
        mean = jnp.maximum(jnp.sum(share * jnp.where(inside, jnp.exp(log_factor - highest), 0.0)), 1 / len(points))
        informed = proposal.mixture.log_prob(theta) - jnp.log(mean) - highest
        if factor is not prior:
            informed = informed - prior.log_prob(theta)
        width = jnp.sum(jnp.log(proposal.support.width))
        flat = -width if prior is None else -jnp.log(prior_mass(prior, proposal.support))
        mixed = jnp.logaddexp(jnp.log1p(-defensive) + informed, jnp.log(defensive) + flat)
        log_q = jnp.where(proposal.informed, mixed, flat)
        return jnp.where(proposal.support.contains(theta), log_q, -jnp.inf)

    used = jnp.arange(proposals.informed.shape[0]) <= round
    each = jnp.where(used[:, None], jax.vmap(log_density)(proposals), -jnp.inf)
    return jax.nn.logsumexp(each, axis=0)


def without_pool(
    task: Task,
    q: GaussianMixture,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float,
    support: Support,
) -> tuple[GaussianMixture, Float[Array, ""]]:
    """The mixture q / p_pool: each component of q times 1 / p_pool, by its mass, mean and covariance.

    Weights are truncated at `HIGHEST`. Outside the support, where nothing was proposed, the weight is that of the
    nearest point in it.

    Args:
        task: for its prior.
        q: as the network has it, not truncated.
        proposals: of all rounds, stacked.
        round: the last that counts, from 0.
        defensive: fraction of each round's proposals drawn from the prior over its support.
        support: that the last round proposed in.

    Returns:
        The mixture, of as many components, and the effective share of q's draws under the weights.
    """
    theta, share = (leaf.reshape(len(q.logits), -1, *leaf.shape[1:]) for leaf in _points(q))
    log_weight = -log_pool(task, proposals, round, defensive, support.clip(theta.reshape(-1, theta.shape[-1])))
    log_weight = log_weight.reshape(share.shape)
    known = jnp.isfinite(log_weight) & (share > 0)
    typical = jnp.sum(share * log_weight, where=known) / jnp.maximum(jnp.sum(share, where=known), 1e-30)
    weight = jnp.where(known, jnp.minimum(jnp.exp(log_weight - typical), HIGHEST), 0.0)
    total = jnp.sum(weight, axis=1)
    relative = weight / jnp.where(total > 0, total, 1.0)[:, None]
    means = jnp.einsum("kn,kni->ki", relative, theta)
    offset = theta - means[:, None]
    covariance = jnp.einsum("kn,kni,knj->kij", relative, offset, offset)
    scale_tril = jnp.linalg.cholesky(covariance)
    sound = (total > 0) & jnp.all(jnp.isfinite(scale_tril), axis=(1, 2))
    mixture = GaussianMixture(
        logits=jnp.where(sound, jnp.log(q.weights) + jnp.log(jnp.where(total > 0, total, 1.0)), -jnp.inf),
        means=jnp.where(sound[:, None], means, q.means),
        scale_tril=jnp.where(sound[:, None, None], scale_tril, q.scale_tril),
    )
    mixture = jax.tree.map(lambda new, old: jnp.where(jnp.any(sound), new, old), mixture, q)
    effective = jnp.sum(share * weight) ** 2 / jnp.sum(share * weight**2)
    return mixture, jnp.where(jnp.any(sound), effective, 0.0)


def _points(mixture: GaussianMixture) -> tuple[Float[Array, "n dim"], Float[Array, " n"]]:
    """Points of all components, one component after another, and how much each counts: in all 1."""
    normal = _normal_points(mixture.means.shape[-1])
    points = mixture.means[:, None] + jnp.einsum("kij,nj->kni", mixture.scale_tril, normal)
    return points.reshape(-1, points.shape[-1]), jnp.repeat(mixture.weights / len(normal), len(normal))


@functools.cache
def _normal_points(dim: int) -> Float[np.ndarray, "n dim"]:
    """Points of the standard normal distribution, with its mean and covariance: constant weights change nothing."""
    points = np.random.default_rng(0).normal(size=(max(COMPONENT_POINTS // 2, 4 * dim), dim))
    points = np.concatenate([points, -points])
    return np.linalg.solve(np.linalg.cholesky(points.T @ points / len(points)), points.T).T.astype(np.float32)
