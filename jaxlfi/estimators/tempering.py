"""Tempered sequential Monte Carlo: from draws of a prior to draws of a posterior, in a bounded number of stages."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

TARGET_ESS = 0.5
"""Fraction of the particles that are effective after each stage; it sets how far a stage goes."""
MOVES = 6
"""Metropolis steps of each particle in each stage."""
STAGES = 60
"""Stages at most. A stage divides the volume by about two: 60 reach a posterior of 1e-18 of the prior's volume."""
JUMPS = 0.1
"""Fraction of the moves that go the whole way from one particle to another, and so from mode to mode."""
JITTER = 0.02
"""Standard deviation of the noise in a move, relative to the particles': without it a move stays on their lattice."""
LEAST = -1e10
"""Least log-likelihood: minus infinity, times a temperature of zero, is not a number."""

LogDensity = Callable[[Float[Array, " dim"]], Float[Array, ""]]


class Tempered(struct.PyTreeNode):
    """The final particles.

    Attributes:
        theta: equally weighted draws, shape [N, D].
        log_evidence: logarithm of the prior's mean of the likelihood.
        stages: how many there were.
        temperature: 1 where the last stage reached the posterior.
    """

    theta: Float[Array, "n dim"]
    log_evidence: Float[Array, ""]
    stages: Int[Array, ""]
    temperature: Float[Array, ""]


def require_blackjax() -> None:
    """Refuse to go on without BlackJAX.

    Raises:
        ValueError: in one line that says what to install.
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

    The likelihood is raised to a power that rises from 0 to 1 in stages, each so far that `TARGET_ESS` of the particles
    stay effective; in between, they are resampled and moved. BlackJAX's sampler, with moves along the difference of two
    other particles (ter Braak and Vrugt 2008): they have the scale and the direction of the posterior, however it is
    curved, and jump between its modes, without a covariance or a gradient.

    Args:
        key: consumed.
        start: draws of the prior.
        log_prior: of one theta, up to a constant; -inf outside of the support, where no particle goes.
        log_likelihood: of one theta.

    Returns:
        The draws. As many stages as `STAGES` that do not reach the posterior end in one that does, by force.

    Raises:
        ValueError: where BlackJAX is not installed.
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
        """Particles move before they are weighted: one stage more, from the temperature 1 to itself, moves the last."""
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
