"""From the trained network to the posterior, a mixture of Gaussians (Algorithm 1, line 14)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief, rejected
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_fit import fit_mixture
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.atomic_loss import log_prob_truncated, sample_within
from jaxlfi.estimators.estimator import Estimator, Network, condition, draw
from jaxlfi.estimators.normaliser import normalised

FLOW_DRAWS = 1000
"""Draws of a flow to which its mixture is fitted."""
LEAK_DRAWS = 512
"""Draws by which the mass of a mixture inside the support is estimated."""
MASS_DRAWS = 10_000
"""Draws by which it is where a density is divided by it: to 1 % of itself where it is a half."""


def posterior(
    key: jax.Array | None,
    estimator: Estimator,
    network: Network,
    x: Float[Array, " obs"],
    scale: Support,
    support: Support,
) -> tuple[GaussianMixture, Float[Array, ""]]:
    """q_phi(theta | x) as a mixture of Gaussians, and how much of it lies in the support.

    An MDN is the mixture. A flow has one fitted to its draws, so that heuristics and proposals need not know of it:
    to those inside the support, as a flow trained by the atomic loss may leak any amount of mass to where no
    simulation was.

    Args:
        key: consumed; an MDN needs none.
        estimator: the settings the network was made with.
        network: trained weights.
        x: the observed summary, shape [S].
        scale: the box the network's [-1, 1]^D stands for (Phi, reading D).
        support: the box the simulations were drawn from.

    Returns:
        The mixture of members * K components, and the share of q's mass inside the support.
    """
    if not estimator.is_flow:
        q = condition(estimator, network, x, scale)
        return q, jnp.mean(support.contains(q.sample(jax.random.key(0), LEAK_DRAWS)))
    key_draw, key_fit = jax.random.split(key)
    draws = draw(key_draw, estimator, network, x, scale, FLOW_DRAWS)
    inside = support.contains(draws)
    weights = jnp.where(jnp.any(inside), inside, True).astype(draws.dtype)
    mixture, _ = fit_mixture(key_fit, draws, weights, estimator.ensemble_size * estimator.components)
    return mixture, jnp.mean(inside)


def draws_within(
    key: jax.Array,
    estimator: Estimator,
    network: Network,
    x: Float[Array, " obs"],
    scale: Support,
    support: Support,
    n: int,
    tries: int = 20,
) -> tuple[Float[Array, "n dim"], Float[Array, ""]]:
    """`n` draws of a flow's posterior truncated to the support, in bounded time (`jaxlfi.estimators.atomic_loss.sample_within`).

    Returns:
        The draws, and the share of n * tries candidates that were inside.
    """
    kept = sample_within(
        key, lambda key, n: draw(key, estimator, network, x, scale, n), support.low, support.high, n, tries
    )
    return kept.theta, kept.acceptance


def truncated_draws(
    key: jax.Array,
    estimator: Estimator,
    network: Network | None,
    x: Float[Array, " obs"],
    scale: Support,
    belief: Belief,
    n: int,
) -> tuple[Float[Array, "n dim"], Float[Array, ""]]:
    """`n` draws of a posterior truncated to its support: a mixture's by rejection, a flow's from the flow itself.

    Args:
        key: consumed.
        estimator: the settings the network was made with.
        network: trained weights; a mixture needs none.
        x: the observed summary, shape [S].
        scale: the box the network's [-1, 1]^D stands for.
        belief: the mixture, and the support.
        n: number of draws.

    Returns:
        The draws, and the share of the untruncated posterior that lies in the support.
    """
    if estimator.is_flow:
        return draws_within(key, estimator, network, x, scale, belief.support, n)
    return rejected(key, belief, n), mixture_mass(belief)


def truncated_log_prob(
    estimator: Estimator,
    network: Network | None,
    x: Float[Array, " obs"],
    scale: Support,
    belief: Belief,
    theta: Float[Array, "*n dim"],
    inside: Float[Array, ""] | None = None,
) -> Float[Array, "*n"]:
    """Log-density of what `truncated_draws` draws from, -inf outside the support.

    Args:
        estimator: the settings the network was made with.
        network: trained weights; a mixture needs none.
        x: the observed summary, shape [S].
        scale: the box the network's [-1, 1]^D stands for.
        belief: the mixture, and the support.
        theta: in coordinates, shape [..., D].
        inside: the posterior's mass in the support; by default estimated from `MASS_DRAWS` draws, always the same.
    """
    box = belief.support
    if estimator.is_flow:
        log_prob = flow_log_prob(estimator, network, x, scale, theta)
        if inside is None:
            draws = draw(jax.random.key(0), estimator, network, x, scale, MASS_DRAWS)
            inside = jnp.mean(box.contains(draws))
    else:
        log_prob = belief.mixture.log_prob(theta)
        inside = mixture_mass(belief) if inside is None else inside
    return log_prob_truncated(log_prob, theta, box.low, box.high, inside)


def mixture_mass(belief: Belief) -> Float[Array, ""]:
    """Mass of a belief's mixture in its support, estimated from `MASS_DRAWS` draws that are always the same."""
    return jnp.mean(belief.support.contains(belief.mixture.sample(jax.random.key(0), MASS_DRAWS)))


def flow_log_prob(
    estimator: Estimator, network: Network, x: Float[Array, " obs"], scale: Support, theta: Float[Array, "*n dim"]
) -> Float[Array, "*n"]:
    """Log-density of a flow's q_phi(theta | x) in coordinates, not truncated: the mean density of all members.

    Args:
        estimator: the settings the network was made with.
        network: trained weights.
        x: the observed summary, shape [S].
        scale: the box the network's [-1, 1]^D stands for.
        theta: in coordinates, shape [..., D].
    """
    module = estimator.module(scale.dim)
    x = normalised(estimator.normaliser, network.normaliser, x)
    inner = network.to_network(scale.to_unit(theta))
    members = jax.vmap(lambda params: module.apply(params, x).log_prob(inner))(network.params)
    # Both maps from theta to what the network sees are affine, dimension by dimension.
    width = 0.5 * scale.width
    width = width if network.theta_normaliser is None else width * network.theta_normaliser.scale
    return jax.nn.logsumexp(members, axis=0) - jnp.log(estimator.ensemble_size) - jnp.sum(jnp.log(width))
