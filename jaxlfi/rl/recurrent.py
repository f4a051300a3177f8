"""Policies with a memory: a gated recurrent unit before the layers (GRU; Cho et al. 2014).

The memory of a policy, H numbers from -1 to 1, is the last part of its observation, and the next memory is the last
part of its action. The environment passes it on, and begins each episode with zeros (`Environment.memory`), so acting,
episodes, evaluation and robots need no special treatment of it. In the loss, whole segments of an episode are processed
in order, starting from the memory at the time of acting (Kapturowski et al. 2019), so that gradients pass from step to
step (backpropagation through time, truncated to a segment).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen
from jaxtyping import Array, Float

from jaxlfi.io.quiet_imports import quiet_imports

with quiet_imports():
    from brax.training.networks import FeedForwardNetwork

UNIT = "gru"
"""Key of the unit's parameters among those of a policy."""
Act = Callable[[Array, jax.Array], tuple[Array, Any]]


def remembered(params: Any, seen: Float[Array, "*batch seen"], memory: int) -> Float[Array, "*batch memory"]:
    """The memory of a policy after an observation.

    Args:
        params: parameters of the policy.
        seen: scaled observation, followed by the memory.
        memory: number of remembered values.
    """
    after, _ = linen.GRUCell(memory).apply({"params": params[UNIT]}, seen[..., -memory:], seen[..., :-memory])
    return after


def network(size: int, memory: int, inner: FeedForwardNetwork) -> FeedForwardNetwork:
    """A policy's network with a recurrent unit before it.

    Args:
        size: size of an observation, without the memory.
        memory: number of remembered values.
        inner: network that sees an observation and the memory after it, `size` + `memory` numbers.

    Returns:
        A network whose observations [..., size + memory, or more] contain the memory after the first `size` numbers. If
        there are three dimensions, the first one is time.
    """

    def init(key: jax.Array) -> Any:
        key_unit, key_inner = jax.random.split(key)
        unit = linen.GRUCell(memory).init(key_unit, jnp.zeros((1, memory)), jnp.zeros((1, size)))
        return {**inner.init(key_inner), UNIT: unit["params"]}

    def apply(scaling: Any, params: Any, seen: Float[Array, "*batch seen"]) -> Any:
        seen = seen[..., : size + memory]

        def following(before, now):
            # Only an episode's first step begins with zeros.
            own = now[..., size:]
            before = jnp.where(jnp.any(own != 0, axis=-1, keepdims=True), before, 0.0)
            after = remembered(params, jnp.concatenate([now[..., :size], before], axis=-1), memory)
            return after, after

        if seen.ndim == 3:
            _, after = jax.lax.scan(following, seen[0, :, size:], seen)
        else:
            after = remembered(params, seen, memory)
        return inner.apply(scaling, {"params": params["params"]}, jnp.concatenate([seen[..., :size], after], axis=-1))

    return FeedForwardNetwork(init=init, apply=apply)


def remembering(act: Act, params: Any, size: int, memory: int) -> Act:
    """Acting whose actions end with the memory.

    Args:
        act: acting of the policy, from observations and a key to actions and extras.
        params: parameters of the policy.
        size: size of an observation, without the memory.
        memory: number of remembered values.
    """

    def with_memory(seen: Float[Array, "*batch seen"], key: jax.Array) -> tuple[Array, Any]:
        action, extras = act(seen, key)
        return jnp.concatenate([action, remembered(params, seen[..., : size + memory], memory)], axis=-1), extras

    return with_memory
