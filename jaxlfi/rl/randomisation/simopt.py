"""SimOpt: a Gaussian over parameters moves, in bounded steps, to where simulations resemble a recording.

Chebotar et al., "Closing the Sim-to-Real Loop: Adapting Simulation Randomization with Real World Experience" (2019). A
policy that was trained on p_phi acts on the real object and in simulations of xi_1..xi_N ~ p_phi. The next phi
minimises the expected discrepancy D(tau_xi, tau_real) subject to KL(p_new || p_phi) <= epsilon, by relative entropy
policy search (Peters et al., 2010): xi_i has the weight exp(-D_i / eta), where eta > 0 minimises the dual
eta epsilon + eta log(1/N sum exp(-D_i / eta)), and the new Gaussian has the weighted mean and covariance.

The dual bounds the divergence of the weighted samples, not that of the Gaussian that is fitted to them. If the latter
exceeds epsilon (by chance, with few samples), the step is shortened until it does not; that is ours.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.fields import Checked, hyperparameter
from jaxlfi.rl.randomisation.gaussian import Gaussian, divergence

Number = Float[Array, "*batch"] | float
BISECTIONS = 60
"""Number of bisections of an interval: more than single precision resolves."""
FARTHEST = 1e6
"""Largest factor between a temperature and the range of the costs, in either direction."""


class SimOpt(Checked):
    """Hyperparameters of a step, and of the discrepancy of two trajectories."""

    epsilon: Number = hyperparameter(
        default=1.0, help="largest divergence of the new distribution from the last, in nats", symbol="epsilon", above=0
    )
    absolute: Number = hyperparameter(
        default=0.5, help="weight of the l1 norm in the discrepancy", symbol="w_l1", low=0
    )
    squared: Number = hyperparameter(
        default=1.0, help="weight of the squared l2 norm in the discrepancy", symbol="w_l2", low=0
    )
    jitter: Number = hyperparameter(
        default=1e-8, help="added to the variances, as a fraction of the last ones, so that they stay positive", low=0
    )


def discrepancy(
    settings: SimOpt,
    simulated: Float[Array, "*n time obs"],
    real: Float[Array, "time obs"],
    weights: Float[Array, " obs"] | float = 1.0,
) -> Float[Array, "*n"]:
    """Discrepancy of simulations and a real trajectory: D = w_l1 sum |W (o - o_real)| + w_l2 sum (W (o - o_real))^2.

    The paper also smooths the errors over time, which makes them robust to delays; to do so, smooth both trajectories.

    Args:
        settings: weights of the norms.
        simulated: simulated observations, shape [..., T, O].
        real: real observations, shape [T, O].
        weights: W, the weight of each observed number, such as one over its standard deviation.
    """
    errors = weights * (simulated - real)
    l1, l2 = jnp.abs(errors).sum(axis=(-2, -1)), (errors**2).sum(axis=(-2, -1))
    return settings.absolute * l1 + settings.squared * l2


def temperature(costs: Float[Array, " n"], epsilon: Number) -> Float[Array, ""]:
    """The eta that minimises the dual, at which the weights' divergence from equal ones is epsilon.

    The divergence falls with eta, so it is found by bisection of ln eta. If even the smallest eta does not reach
    epsilon (one of N samples has all the weight, whose divergence is ln N), the smallest is returned.

    Args:
        costs: discrepancies D_i, shape [N].
        epsilon: bound on the divergence, in nats.
    """
    spread = jnp.maximum(jnp.max(costs) - jnp.min(costs), jnp.finfo(jnp.float32).tiny)
    span = jnp.log(FARTHEST)

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        log_weights = jax.nn.log_softmax(-(costs - jnp.min(costs)) / (spread * jnp.exp(middle)))
        too_far = jnp.sum(jnp.exp(log_weights) * log_weights) + jnp.log(len(costs)) > epsilon
        return jnp.where(too_far, middle, low), jnp.where(too_far, high, middle)

    _, high = jax.lax.fori_loop(0, BISECTIONS, halve, (-span, span))
    return spread * jnp.exp(high)


def step(settings: SimOpt, before: Gaussian, theta: Float[Array, "n dim"], costs: Float[Array, " n"]) -> Gaussian:
    """The next distribution.

    Args:
        settings: hyperparameters.
        before: the last distribution, p_phi.
        theta: its draws xi_1..xi_N, in inference space, shape [N, D].
        costs: their discrepancies, shape [N]; failed simulations (NaN or infinite) have no weight.
    """
    known = jnp.isfinite(costs)
    # Failures count with the largest cost in the temperature; the moments leave them out.
    costs = jnp.where(known, costs, jnp.max(jnp.where(known, costs, -jnp.inf)))
    weights = jnp.where(known, jax.nn.softmax(-costs / temperature(costs, settings.epsilon)), 0.0)
    weights /= weights.sum()
    mean = weights @ theta
    covariance = jnp.einsum("n,ni,nj->ij", weights, theta - mean, theta - mean)
    covariance += settings.jitter * jnp.diag(jnp.diagonal(before.covariance))
    return bounded(before, Gaussian(mean, covariance), settings.epsilon)


def bounded(before: Gaussian, after: Gaussian, epsilon: Number) -> Gaussian:
    """The farthest Gaussian on the line from one to another whose divergence from the first is at most epsilon.

    Along the straight line between the moments the divergence only grows, as it is convex in mean and covariance and
    zero at the beginning.

    Args:
        before: Gaussian at the beginning of the line.
        after: Gaussian at its end.
        epsilon: bound on the divergence, in nats.
    """

    def at(part: Array) -> Gaussian:
        return jax.tree.map(lambda old, new: old + part * (new - old), before, after)

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        within = divergence(at(middle), before) <= epsilon
        return jnp.where(within, middle, low), jnp.where(within, high, middle)

    part, _ = jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.asarray(0.0), jnp.asarray(1.0)))
    whole = divergence(after, before) <= epsilon
    return jax.tree.map(lambda end, some: jnp.where(whole, end, some), after, at(part))
