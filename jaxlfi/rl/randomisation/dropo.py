"""DROPO: the Gaussian over parameters under which logged transitions are most likely.

Tiboni, Arndt and Kyrki, "DROPO: Sim-to-Real Transfer with Offline Domain Randomization" (2022). For each transition of
the log the simulator is set to the state s_t, and K draws xi_k ~ N(mu, diag(sigma^2)) are simulated under the logged
actions for lambda steps. The logged state s_(t + lambda) then has the likelihood of a Gaussian with the mean and the
covariance of the K simulated ones, whose variances are raised by epsilon. CMA-ES finds the mu and sigma that maximise
the sum of log-likelihoods; spread that the log does not require makes it less likely.

Departure from the paper: the K standard normal numbers behind the draws are the same at every evaluation, so that the
search maximises a deterministic function.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.design import evolution
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.fields import Checked, hyperparameter, option
from jaxlfi.rl.randomisation.gaussian import Gaussian

Simulate = Callable[[Array, Any, Array], Array]
"""The simulator: from theta [D] in natural units, a state [S] and actions [lambda, A] to the state after them [S]."""


class Dropo(Checked):
    """Hyperparameters; standard deviations are in widths of the search box."""

    epsilon: Float[Array, "*batch"] | float = hyperparameter(
        default=1e-5, help="added to the variances of simulated states, in squares of their units", symbol="epsilon",
        above=0,
    )  # fmt: skip
    lookahead: int = option(
        default=1, help="steps from a logged state to the one that is compared", symbol="lambda", low=1
    )
    draws: int = option(default=100, help="number of simulations of each transition", symbol="K", low=2)
    narrowest: float = option(default=1e-3, help="smallest standard deviation tried", above=0)
    widest: float = option(default=0.5, help="largest standard deviation tried", above=0)
    generations: int = option(default=60, help="largest number of generations of CMA-ES", low=1)


class Transitions(struct.PyTreeNode):
    """Logged transitions.

    Attributes:
        states: states s_t, shape [T, S].
        actions: actions a_t..a_(t + lambda - 1), shape [T, lambda, A].
        after: states s_(t + lambda), shape [T, S].
    """

    states: Float[Array, "time state"]
    actions: Float[Array, "time lookahead act"]
    after: Float[Array, "time state"]


def transitions(
    states: Float[np.ndarray | Array, "after state"], actions: Float[np.ndarray | Array, "time act"], lookahead: int = 1
) -> Transitions:
    """All transitions of a trajectory.

    Args:
        states: states at its start and after each action, shape [T + 1, S].
        actions: actions, shape [T, A].
        lookahead: number lambda of steps.

    Raises:
        ValueError: if there is not one state more than actions, or the lookahead is not between 1 and T.
    """
    if len(states) != len(actions) + 1 or not 1 <= lookahead <= len(actions):
        raise ValueError(
            f"transitions: expected a state more than actions, and at least {max(lookahead, 1)} actions; "
            f"got {len(states)} states and {len(actions)} actions"
        )
    count = len(actions) - lookahead + 1
    windows = jnp.stack([jnp.asarray(actions)[k : k + count] for k in range(lookahead)], axis=1)
    return Transitions(jnp.asarray(states)[:count], windows, jnp.asarray(states)[lookahead:])


def log_likelihood(
    simulate: Simulate,
    logged: Transitions,
    theta: Float[Array, "draws dim"],
    epsilon: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """The log-likelihood of logged transitions under the distribution of these draws.

    Args:
        simulate: the simulator.
        logged: T logged transitions.
        theta: K draws of the parameters, in natural units, shape [K, D].
        epsilon: number added to the variances.

    Returns:
        The sum over transitions of log N(s_(t + lambda); mean, covariance + epsilon 1).
    """

    def one(state, actions, after):
        simulated = jax.vmap(lambda own: simulate(own, state, actions))(theta)
        mean = simulated.mean(axis=0)
        covariance = jnp.cov(simulated, rowvar=False).reshape(len(mean), len(mean)) + epsilon * jnp.eye(len(mean))
        return jax.scipy.stats.multivariate_normal.logpdf(after, mean, covariance)

    return jnp.sum(jax.vmap(one)(logged.states, logged.actions, logged.after))


def fit(
    seed: int, simulate: Simulate, logged: Transitions, space: Space, feasible: Support, settings: Dropo | None = None
) -> Gaussian:
    """The Gaussian over parameters under which a log is most likely.

    Args:
        seed: seed of the draws and of the search.
        simulate: the simulator.
        logged: logged transitions with the settings' lookahead.
        space: map from inference space to natural units.
        feasible: box in which mu is searched and to which draws are clipped, in natural units.
        settings: hyperparameters; by default those of the class.

    Raises:
        ValueError: if the log has another lookahead, or if no parameters in the box explain it.
    """
    settings = settings or Dropo()
    if logged.actions.shape[1] != settings.lookahead:
        raise ValueError(f"logged: expected a lookahead of {settings.lookahead}, got {logged.actions.shape[1]}")
    dim, box = space.dim, space.box_to_inference(feasible)
    normal = jax.random.normal(jax.random.key(seed), (settings.draws, dim))
    # With zero mean and unit variance, the K numbers do not bias mu and sigma.
    normal = (normal - normal.mean(axis=0)) / normal.std(axis=0, ddof=1)

    def moments(unit):
        narrow, wide = jnp.log(settings.narrowest), jnp.log(settings.widest)
        return box.low + unit[:dim] * box.width, box.width * jnp.exp(narrow + unit[dim:] * (wide - narrow))

    def objective(unit):
        mean, deviation = moments(unit)
        return log_likelihood(
            simulate, logged, feasible.clip(space.to_natural(mean + deviation * normal)), settings.epsilon
        )

    likelihoods = jax.jit(jax.vmap(objective))
    found = evolution.maximise(
        np.random.default_rng(seed),
        lambda points: np.asarray(likelihoods(jnp.asarray(points, jnp.float32))),
        np.full(2 * dim, 0.5),
        generations=settings.generations,
    )
    if not np.isfinite(found.value):
        raise ValueError("logged: expected transitions that some parameters of the box explain, got none")
    mean, deviation = moments(jnp.asarray(found.point, jnp.float32))
    return Gaussian(mean, jnp.diag(deviation**2))
