"""A policy that acts at random, as a baseline for others."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.rl.environment import Signals


def policy(actions: Signals, key: Float[Array, "2"]) -> Callable[[Array], Array]:
    """A policy of uniform actions that is a function of the observation, from which its random key is derived.

    Args:
        actions: action signals of the environment.
        key: data of a key.
    """

    def act(observation: Float[Array, " obs"]) -> Float[Array, " act"]:
        seen = jax.lax.bitcast_convert_type(observation, jnp.uint32)
        mixed = functools.reduce(jax.random.fold_in, seen, jax.random.wrap_key_data(key))
        return actions.from_unit(jax.random.uniform(mixed, (actions.size,), minval=-1.0, maxval=1.0))

    return act
