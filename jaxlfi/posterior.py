"""From the trained network to the posterior, a mixture of Gaussians (Algorithm 1, line 14)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.estimator import Estimator, Network, condition, draw
from jaxlfi.mixture import GaussianMixture
from jaxlfi.npe.atomic import sample_within
from jaxlfi.npe.mixture_fit import fit_mixture
from jaxlfi.support import Support

FLOW_DRAWS = 1000
"""Draws of a flow to which its mixture is fitted."""
LEAK_DRAWS = 512
"""Draws by which the mass of a mixture inside the support is estimated."""


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
    mixture, _ = fit_mixture(key_fit, draws, weights, estimator.members * estimator.components)
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
    """`n` draws of a flow's posterior truncated to the support, in bounded time (`jaxlfi.npe.sample_within`).

    Returns:
        The draws, and the share of n * tries candidates that were inside.
    """
    kept = sample_within(
        key, lambda key, n: draw(key, estimator, network, x, scale, n), support.low, support.high, n, tries
    )
    return kept.theta, kept.acceptance
