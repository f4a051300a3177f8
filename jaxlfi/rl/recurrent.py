"""Policies with a memory: a gated recurrent unit before the layers (GRU; Cho et al. 2014).

What a policy remembers, H numbers from -1 to 1, is the last part of its observation, and what it will remember the last
part of its action: an environment hands it on, and begins each episode with zeros (`Environment.memory`). So acting,
episodes, evaluation and robots need to know of nothing else. In the loss, whole segments of an episode are gone through
in order, beginning with what was remembered when it was acted (Kapturowski et al. 2019), so that gradients pass from
step to step (backpropagation through time, truncated to a segment).
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
"""Where the unit's parameters lie among those of a policy."""
Act = Callable[[Array, jax.Array], tuple[Array, Any]]


def remembered(params: Any, seen: Float[Array, "*batch seen"], memory: int) -> Float[Array, "*batch memory"]:
    """What a policy will remember after an observation.

    Args:
        params: of the policy.
        seen: what it observes, and what it remembers after that; in units of the network.
        memory: how many numbers these are.
    """
    after, _ = linen.GRUCell(memory).apply({"params": params[UNIT]}, seen[..., -memory:], seen[..., :-memory])
    return after


def network(size: int, memory: int, inner: FeedForwardNetwork) -> FeedForwardNetwork:
    """A policy's network with a unit before it.

    Args:
        size: of an observation, without what is remembered.
        memory: how many numbers are remembered.
        inner: sees an observation and what will be remembered after it, `size` + `memory` numbers.

    Returns:
        A network whose observations [..., size + memory, or more] end with what is remembered. Of three dimensions, the
        first one is time.
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
    """Acting whose actions end with what is remembered.

    Args:
        act: of the policy, from observations and a key to actions and whatever else.
        params: of the policy.
        size: of an observation, without what is remembered.
        memory: how many numbers are remembered.
    """

    def with_memory(seen: Float[Array, "*batch seen"], key: jax.Array) -> tuple[Array, Any]:
        action, extras = act(seen, key)
        return jnp.concatenate([action, remembered(params, seen[..., : size + memory], memory)], axis=-1), extras

    return with_memory
