"""Evaluation: how a policy fares on the points of a domain."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.rl.domains import Domain
from jaxlfi.rl.environment import Environment


@struct.dataclass
class Outcomes:
    """One episode at each point of a domain.

    Attributes:
        value: returns, shape [N].
        steps: lengths, shape [N].
        failed: whether the episode ended because the simulation became unstable, shape [N].
        facts: what the environment says of each episode, each [N].
    """

    value: Float[Array, "*batch n"]
    steps: Int[Array, "*batch n"]
    failed: Bool[Array, "*batch n"]
    facts: dict[str, Array]


def evaluate(key: jax.Array, environment: Environment, act, domain: Domain) -> Outcomes:
    """One episode at each point, by one policy.

    Args:
        key: consumed.
        environment: to act in.
        act: from an observation [O] in its units to an action [A] in its units, in JAX.
        domain: its points.
    """

    def episode(key, theta):
        state = environment.reset(key, theta)
        none = Outcomes(jnp.asarray(0.0), jnp.asarray(0), jnp.asarray(False), dict(state.facts))

        def step(carry, _):
            state, over, before = carry
            after = environment.step(state, act(state.observation))
            now = Outcomes(before.value + after.reward, before.steps + 1, after.truncated, dict(after.facts))
            outcome = jax.tree.map(lambda old, new: jnp.where(over, old, new), before, now)
            over |= after.terminated | after.truncated
            return (after, over, outcome), None

        first = state, jnp.asarray(False), none
        (_, _, outcome), _ = jax.lax.scan(step, first, length=environment.steps)
        return outcome

    return jax.vmap(episode)(jax.random.split(key, len(domain.theta)), domain.theta)
