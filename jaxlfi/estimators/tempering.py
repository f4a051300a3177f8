"""Tempered sequential Monte Carlo: from draws of a prior to draws of a posterior, in a bounded number of stages."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

TARGET_ESS = 0.5
"""Effective sample size after each stage, as a fraction of the particles; it determines the next temperature."""
MOVES = 6
"""Metropolis steps of each particle in each stage."""
STAGES = 60
"""Largest number of stages. Each about halves the volume: 60 reach a posterior of 1e-18 of the prior's volume."""
JUMPS = 0.1
"""Fraction of the moves by the full difference between two particles, which can jump between modes."""
JITTER = 0.02
"""Standard deviation of the noise in a move, relative to the particles': without it a move stays on their lattice."""
LEAST = -1e10
"""Smallest log-likelihood: minus infinity times a temperature of zero would be NaN."""

LogDensity = Callable[[Float[Array, " dim"]], Float[Array, ""]]


class Tempered(struct.PyTreeNode):
    """The final particles.

    Attributes:
        theta: equally weighted draws, shape [N, D].
        log_evidence: logarithm of the mean likelihood under the prior.
        stages: number of stages.
        temperature: 1 if the last stage reached the posterior.
    """

    theta: Float[Array, "n dim"]
    log_evidence: Float[Array, ""]
    stages: Int[Array, ""]
    temperature: Float[Array, ""]


def require_blackjax() -> None:
    """Refuse to go on without BlackJAX.

    Raises:
        ValueError: with a one-line message that says what to install.
    """
    try:
        import blackjax.smc  # noqa: F401
    except ImportError as error:
        raise ValueError(
            "estimator: expected BlackJAX to be installed for a likelihood, found none: pip install 'jaxlfi[snle]'"
        ) from error


def tempered(
    key: jax.Array, start: Float[Array, "n dim"], log_prior: LogDensity, log_likelihood: LogDensity
) -> Tempered:
    """Draws of prior times likelihood, by adaptive tempered sequential Monte Carlo (Del Moral et al. 2006).

    The likelihood is raised to a power that rises from 0 to 1 in stages, chosen so that the effective sample size stays
    at `TARGET_ESS`; in between, particles are resampled and moved. The sampler is BlackJAX's, with moves along the
    difference of two other particles (ter Braak and Vrugt 2008): these follow the scale and direction of the posterior,
    however it is curved, and jump between its modes, without a covariance or a gradient.

    Args:
        key: consumed.
        start: draws from the prior.
        log_prior: log-density of one theta, up to a constant; -inf outside the support, where no particle goes.
        log_likelihood: log-likelihood of one theta.

    Returns:
        The draws. If `STAGES` stages do not suffice, the last one goes to the posterior in one step.

    Raises:
        ValueError: if BlackJAX is not installed.
    """
    require_blackjax()
    from blackjax.mcmc import random_walk
    from blackjax.smc import ess, resampling, solver
    from blackjax.smc import tempered as smc

    n, dim = start.shape
    additive = random_walk.build_additive_step()

    def move(key: jax.Array, others: Float[Array, "n dim"], scale: Float[Array, " dim"]) -> Float[Array, " dim"]:
        key_pair, key_jump, key_noise = jax.random.split(key, 3)
        first, second = jax.random.randint(key_pair, (2,), 0, n)
        length = jnp.where(jax.random.uniform(key_jump) < JUMPS, 1.0, 2.38 / jnp.sqrt(2.0 * dim))
        noise = JITTER * scale * jax.random.normal(key_noise, (dim,))
        return length * (others[first] - others[second]) + noise

    def step(key, state, log_density, others, scale):
        return additive(key, state, log_density, lambda key, position: move(key, others, scale))

    bounded = lambda theta: jnp.maximum(jnp.nan_to_num(log_likelihood(theta), nan=LEAST), LEAST)
    kernel = smc.build_kernel(log_prior, bounded, step, random_walk.init, resampling.systematic)

    def shared(theta: Float[Array, "n dim"]) -> dict[str, Array]:
        return {"others": theta[None], "scale": jnp.std(theta, axis=0)[None]}

    def running(carry) -> Array:
        stage, temperature, *_ = carry
        return (stage <= STAGES) & (temperature < 1)

    def one_stage(carry):
        """Particles move before they are weighted: an extra stage, at temperature 1 throughout, moves the last ones."""
        stage, _, state, log_evidence = carry
        before = state.tempering_param
        rise = ess.ess_solver(jax.vmap(bounded), state.particles, TARGET_ESS, 1 - before, solver.dichotomy)
        after = jnp.where(stage < STAGES, before + jnp.clip(rise, 0.0, 1 - before), 1.0)
        state, info = kernel(jax.random.fold_in(key_stages, stage), state, MOVES, after, shared(state.particles))
        return stage + 1, before, state, log_evidence + info.log_likelihood_increment

    # As plain numbers: JAX's check for reused keys mistakes BlackJAX's scans under vmap for reuse (JAX 0.9).
    key_stages, key_pick = jax.random.key_data(jax.random.split(key))
    state = smc.init(start)._replace(tempering_param=jnp.zeros(()))
    initial = jnp.asarray(0), jnp.zeros(()), state, jnp.zeros(())
    stages, temperature, state, log_evidence = jax.lax.while_loop(running, one_stage, initial)
    theta = state.particles[resampling.systematic(key_pick, state.weights, n)]
    return Tempered(theta, log_evidence, stages - 1, temperature)
