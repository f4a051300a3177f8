"""Discrepancies of a posterior from the truth, and the warning of mass piled on a bound."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import RESTRICTIONS, Belief
from jaxlfi.tasks.simulation import summarised, trajectory_and_outcome
from jaxlfi.tasks.task import Task

POSTERIOR_SAMPLES = 20
"""Posterior samples a discrepancy is averaged over (section V)."""


@struct.dataclass
class Discrepancy:
    """How far draws of a belief, and their simulations, are from the truth and the observation.

    Attributes:
        theta: the draws, shape [N, D].
        theta_error: |theta - theta_gt| for each draw and parameter, shape [N, D]; NaN where the truth is unknown.
        trajectory_error: distance of each draw's trajectory from the observed one, shape [N]; NaN where it failed.
        trajectory: the simulated trajectories, shape [N, T, C].
        x: their summaries, shape [N, S]; NaN where the simulation failed or its summary is not finite.
    """

    theta: Float[Array, "*batch samples dim"]
    theta_error: Float[Array, "*batch samples dim"]
    trajectory_error: Float[Array, "*batch samples"]
    trajectory: Float[Array, "*shape"]
    x: Float[Array, "*batch samples obs"]


def discrepancy(
    key: jax.Array, task: Task, belief: Belief, observed: Array, restriction: str = "clip", n: int = POSTERIOR_SAMPLES
) -> Discrepancy:
    """Draw from a belief, simulate, and compare (section V).

    Where the posterior is a flow, the belief is the mixture fitted to it (`jaxlfi.estimators.posterior.posterior`), and so are the
    draws.

    Args:
        key: consumed.
        task: a task whose simulator is in JAX.
        belief: the mixture and the support its draws are kept in.
        observed: the real trajectory, shape [T, C] or [T].
        restriction: how draws are kept in the support.
        n: number of draws.
    """
    key_draw, key_simulate = jax.random.split(key)
    theta = RESTRICTIONS[restriction](key_draw, belief, n)
    simulate = jax.vmap(lambda key, theta: trajectory_and_outcome(task, key, theta))
    trajectory, failure = simulate(jax.random.split(key_simulate, n), theta)
    x, unusable = jax.vmap(functools.partial(summarised, task))(trajectory, failure)
    truth = jnp.full(task.dim, jnp.nan) if task.truth is None else task.truth
    error = jnp.where(failure == 0, jax.vmap(lambda t: trajectory_distance(t, observed))(trajectory), jnp.nan)
    x = jnp.where((unusable == 0)[:, None], x, jnp.nan)
    return Discrepancy(theta, jnp.abs(theta - truth), error, trajectory, x)


def trajectory_distance(trajectory: Array, observed: Array) -> Float[Array, ""]:
    """Euclidean distance of two trajectories in units of the observed one's spread, per record.

    Each channel is divided by its observed standard deviation, and the square root of the mean square is taken over
    records and channels: a distance of 1 is as far as the observed trajectory is from its own mean. The plain
    Euclidean distance that the paper names would make exp(-distance) zero for any two trajectories of a population.
    """
    observed = observed.reshape(observed.shape[0], -1)
    spread = jnp.std(observed, axis=0)
    scale = jnp.where(spread > 0, spread, 1.0)
    return jnp.sqrt(jnp.mean(((trajectory.reshape(observed.shape) - observed) / scale) ** 2))


def edge_mass(belief: Belief, zone_fraction: float = 0.1) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """Marginal posterior mass in or beyond the zone along each lower and each upper bound, shape [D] each."""
    box = jax.tree.map(jnp.asarray, belief.support)
    zone = zone_fraction * box.width
    infinite = jnp.full_like(box.low, jnp.inf)
    return (
        belief.mixture.interval_mass(-infinite, box.low + zone),
        belief.mixture.interval_mass(box.high - zone, infinite),
    )


_edge_mass = jax.jit(edge_mass)


def bound_warnings(task: Task, belief: Belief, threshold: float = 0.2) -> list[str]:
    """Say in words where posterior mass is piled on a bound, and what to do.

    A uniform marginal has 0.1 of its mass in each zone of a tenth of the width; `threshold` is twice that.

    Args:
        task: for the parameters' names and Phi.
        belief: one belief, concrete.
        threshold: mass above which a bound is named.
    """
    low, high = (np.asarray(side) for side in _edge_mass(belief))
    bounds = np.asarray(belief.support.low), np.asarray(belief.support.high)
    limits = np.asarray(task.feasible.low), np.asarray(task.feasible.high)
    warnings = []
    for d, name in enumerate(task.coordinates):
        for side, mass, bound, limit, outwards in zip(
            ("lower", "upper"), (low, high), bounds, limits, (-1, 1), strict=True
        ):
            if mass[d] <= threshold:
                continue
            at_limit = np.isclose(bound[d], limit[d]) or outwards * (bound[d] - limit[d]) > 0
            advice = (
                "The bound is that of the feasible domain Phi: widen Phi if it can be."
                if at_limit
                else "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
            )
            warnings.append(
                f"{name}: {mass[d]:.2f} of the posterior mass lies at or beyond the {side} bound {bound[d]:.4g}. "
                f"{advice}"
            )
    return warnings
