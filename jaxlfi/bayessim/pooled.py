"""Pooled proposals: the distribution of all of a run's simulations, and the posterior divided by it.

A network trained by the likelihood on the simulations of all rounds learns prior * p_pool * likelihood, where p_pool is
the mixture of the rounds' proposals, relative to the prior. If p_pool were divided out in the loop, the errors of one
round would steer the next, and runs would be lost. So proposals and heuristics use q, and only the reported posterior
is q / p_pool.

But the tail of a skewed posterior is thin in the pool, so q has even less of it, and round by round the tail would be
lost. So a component gains weight in the loop, too, if its quotient has far more mass and there are many simulations
where it lies.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.decomposition import svd
from jaxlfi.distributions.mixture import GaussianMixture, lower_factor
from jaxlfi.distributions.normal_points import normal_points
from jaxlfi.distributions.region import region
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.priors import prior_mass

HIGHEST = 4.0
"""Largest mass of a component's quotient, in geometric means of all: where the pool is thinner, q is hardly known.

Without this limit, a stray component where hardly anything was proposed counts fiftyfold in runs that have not settled.
"""
MANY = 100.0
"""Expected number of simulations where a component lies, from which on the mass of its quotient is not limited.

With few parameters, tails have hundreds. With five parameters, a stray component has some fifty, a sound one ten.
"""
ORDINARY = 2.0
"""Mass of a quotient, in geometric means of all, up to which a component has the same weight in the loop as in q.

A wide component may have this much without any tail: proposals twice as wide as a posterior are thinner at its sides.
"""
CONFIRMED = 0.1
"""Fraction of a component's mass that the reported mixture shares, from which on its gain in the loop is not reduced.

In four dimensions the median is 0.07 for a network fifteen times as wide as the posterior, and 0.4 for a network that
has no weight, but sees a posterior's long tail.
"""
WIDEST = 1.5
"""Largest width of a quotient relative to its component; it is 1.15 if rounds propose twice the width found."""
FARTHEST = 1.0
"""Largest shift of a component, in its standard deviations."""


def log_pool(
    prior: Any,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float,
    theta: Float[Array, "n dim"],
    factored: bool = True,
    beyond: Support | None = None,
) -> Float[Array, " n"]:
    """Logarithm of the summed densities of all rounds' proposals, relative to the prior's.

    It exceeds the log-density of their equally weighted mixture by log(`round` + 1). Clipped proposals have atoms on
    the bounds, which are left out.

    Args:
        prior: prior of the task (`Task.inference.prior`), None for a uniform one.
        proposals: proposals of all rounds, stacked.
        round: index of the last round included, from 0.
        defensive: fraction of each round's proposals drawn from the prior over its support.
        theta: parameters in inference space, shape [N, D].
        factored: whether proposals have the prior as a factor, which then drops out.
        beyond: box beyond which densities continue as if its bounds had not truncated them.

    Returns:
        -inf where no round proposed, shape [N].
    """
    factor = prior if factored else None
    place = theta if beyond is None else beyond.clip(theta)

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
        return jnp.where(proposal.support.contains(place), log_q, -jnp.inf)

    used = jnp.arange(proposals.informed.shape[0]) <= round
    each = jnp.where(used[:, None], jax.vmap(log_density)(proposals), -jnp.inf)
    return jax.nn.logsumexp(each, axis=0)


class Quotients(struct.PyTreeNode):
    """The components of a mixture q, each divided by a Gaussian approximation of the pool where it lies.

    Attributes:
        log_mass: log-mass of each quotient, shape [K].
        means: means of the quotients, shape [K, D].
        scale_tril: Cholesky factors of their covariances, shape [K, D, D].
        log_p: log-density of the pool, relative to the prior's, at a component's points, shape [K, N].
        sound: whether anything was proposed where the component lies, shape [K].
        simulations: expected number of simulations where the component lies, shape [K].
    """

    log_mass: Float[Array, "*batch comp"]
    means: Float[Array, "*batch comp dim"]
    scale_tril: Float[Array, "*batch comp dim dim"]
    log_p: Float[Array, "*batch comp n"]
    sound: Bool[Array, "*batch comp"]
    simulations: Float[Array, "*batch comp"]

    def proposed(self, q: GaussianMixture, weighted: GaussianMixture) -> GaussianMixture:
        """The mixture q with more weight for tails, for proposals and heuristics.

        A component may seem a tail only because its network is far wider than the posterior. Such a network has little
        weight in the reported mixture, so a component gains less where that has hardly any mass.

        Args:
            q: mixture of these components, with equally weighted networks.
            weighted: the same with the networks' weights.
        """
        known = self.sound & (self.simulations >= MANY)
        gain = jnp.maximum(self._relative(weighted) - math.log(ORDINARY), 0.0)
        points = _points(q)[0]
        confirmed = jnp.minimum(jnp.exp(weighted.log_prob(points) - q.log_prob(points)), 1.0)
        gain = gain * jnp.minimum(jnp.mean(confirmed.reshape(len(q.logits), -1), axis=1) / CONFIRMED, 1.0)
        return q.replace(logits=q.logits + jnp.where(known, gain, 0.0))

    def reported(self, q: GaussianMixture) -> tuple[GaussianMixture, Float[Array, ""]]:
        """The mixture q / p_pool, with as many components as q.

        Args:
            q: mixture of these components, with any weights.

        Returns:
            The mixture, and the effective share of q's draws under the weights 1 / p_pool.
        """
        sound = self.sound & (q.weights > 0)
        relative = self._relative(q)
        relative = jnp.where(self.simulations >= MANY, relative, jnp.minimum(relative, jnp.log(HIGHEST)))
        logits = jnp.where(sound, jnp.log(q.weights) + relative, -jnp.inf)
        found = GaussianMixture(logits, self.means, self.scale_tril)
        mixture = jax.tree.map(lambda new, old: jnp.where(jnp.any(sound), new, old), found, q)
        share = jnp.where(sound, q.weights, 0.0)[:, None] / self.log_p.shape[-1]
        weight = share * jnp.exp(jnp.min(self.log_p, where=sound[:, None], initial=jnp.inf) - self.log_p)
        effective = jnp.sum(weight) ** 2 / jnp.maximum(jnp.sum(weight * weight / jnp.maximum(share, 1e-30)), 1e-30)
        return mixture, jnp.where(jnp.any(sound), effective, 0.0)

    def _relative(self, q: GaussianMixture) -> Float[Array, " comp"]:
        """Logarithms of the quotients' masses, in geometric means of all."""
        weights = jnp.where(self.sound, q.weights, 0.0)
        return self.log_mass - jnp.sum(weights * self.log_mass) / jnp.maximum(jnp.sum(weights), 1e-30)


def without_pool(
    prior: Any,
    q: GaussianMixture,
    proposals: Belief,
    round: Int[Array, ""] | int,
    defensive: Float[Array, ""] | float,
    support: Support,
    size: Int[Array, ""] | int,
) -> Quotients:
    """The components of q, divided by the pool.

    Outside the support, where nothing was proposed, the pool is continued as if there were no bounds.

    Args:
        prior: prior of the task (`Task.inference.prior`), None for a uniform one.
        q: the network's mixture, not truncated.
        proposals: proposals of all rounds, stacked.
        round: index of the last round included, from 0.
        defensive: fraction of each round's proposals drawn from the prior over its support.
        support: support that the last round proposed in.
        size: number of simulations of all rounds.
    """
    points = _points(q)[0]
    pool = lambda theta: log_pool(prior, proposals, round, defensive, theta, beyond=support)
    log_p, slopes = jax.vjp(pool, points)
    (slope,) = slopes(jnp.ones_like(log_p))
    absolute = log_p if prior is None else log_p + prior.log_prob(points)
    log_p, absolute = (each.reshape(len(q.logits), -1) for each in (log_p, absolute))
    slope = slope.reshape(*log_p.shape, -1)
    known = jnp.isfinite(log_p) & jnp.all(jnp.isfinite(slope), axis=-1)
    # Where the pool's density is unknown, such as where a prior is zero, it is taken to be flat.
    mean = lambda values: jnp.sum(values, axis=1, where=known) / jnp.maximum(jnp.sum(known, axis=1), 1)
    log_p, slope = jnp.where(known, log_p, mean(log_p)[:, None]), jnp.where(known[..., None], slope, 0.0)
    log_mass, means, scale_tril = jax.vmap(_quotient)(q.means, q.scale_tril, log_p, slope)
    # N exp(-KL(component || pool)): number of simulations in the pool where the component lies.
    scales = jnp.diagonal(q.scale_tril, axis1=-2, axis2=-1) * math.sqrt(2 * math.pi * math.e)
    simulations = size / (round + 1) * jnp.exp(mean(absolute) + jnp.sum(jnp.log(scales), axis=-1))
    sound = (q.weights > 0) & jnp.any(known, axis=1)
    return Quotients(log_mass, means, scale_tril, log_p, sound, simulations)


def _quotient(
    mean: Float[Array, " dim"], factor: Float[Array, "dim dim"], log_p: Float[Array, " n"], slope: Float[Array, "n dim"]
) -> tuple[Float[Array, ""], Float[Array, " dim"], Float[Array, "dim dim"]]:
    """N(mean, L L') / p, as mass times Gaussian: its log-mass, mean and factor.

    With theta = mean + L z, log p is a + g'z + z'Hz / 2: g and H are the means of its gradient and Hessian under the
    Gaussian, and the latter is the mean of z times the gradient (Stein's lemma). The quotient has precision I + H in z.
    Weighted points, as in importance sampling, would not do: wide proposals cut off the tails, where there are hardly
    any points, the more so the more parameters there are.

    Args:
        mean: mean of the component.
        factor: L.
        log_p: log p at the component's points.
        slope: its gradient there.
    """
    normal = normal_points(len(mean))
    along = slope @ factor
    g, hessian = jnp.mean(along, axis=0), normal.T @ along / len(normal)
    hessian = 0.5 * (hessian + hessian.T)
    # Eigenvalues of either sign: singular values of the matrix shifted to be positive.
    shift = 1.0 + jnp.linalg.norm(hessian)
    axes, values, _ = svd(hessian + shift * jnp.eye(len(mean)))
    precision = jnp.clip(1.0 + values - shift, 1 / WIDEST**2, WIDEST**2)
    moved = -(axes.T @ g) / precision
    moved = moved * jnp.minimum(1.0, FARTHEST / jnp.maximum(jnp.linalg.norm(moved), 1e-30))
    log_mass = -0.5 * (axes.T @ g) @ moved - 0.5 * jnp.sum(jnp.log(precision)) - jnp.mean(log_p)
    log_mass = log_mass + 0.5 * jnp.trace(hessian)
    return log_mass, mean + factor @ (axes @ moved), lower_factor(factor @ (axes / jnp.sqrt(precision)))


def _points(mixture: GaussianMixture) -> tuple[Float[Array, "n dim"], Float[Array, " n"]]:
    """Points of all components, one component after another, and their weights, which sum to 1."""
    normal = normal_points(mixture.means.shape[-1])
    points = mixture.means[:, None] + jnp.einsum("kij,nj->kni", mixture.scale_tril, normal)
    return points.reshape(-1, points.shape[-1]), jnp.repeat(mixture.weights / len(normal), len(normal))
