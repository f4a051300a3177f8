"""The keys of a run: one seed, split by purpose. No other module splits a run's key.

A run's key is split in the same way for its start and for every round, each of which takes another part of it: a clone
tells JAX's key-reuse checker that this is intended.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Int


class RunKeys(struct.PyTreeNode):
    """Independent keys derived from one.

    Attributes:
        observe: key for simulating the observation, if the truth is known and no observation was given.
        run: key for the inference itself.
        check: key for draws and simulations by which posteriors are compared with truth and observation.
    """

    observe: jax.Array
    run: jax.Array
    check: jax.Array

    def of_check(self, index: Int[Array, ""] | int) -> jax.Array:
        """The key of one round's comparison; the index after all rounds is for the last posterior's saved draws."""
        return jax.random.fold_in(self.check, index)

    def of_predictive(self, index: Int[Array, ""] | int) -> tuple[jax.Array, jax.Array]:
        """The keys of one round's posterior draws and of their simulations."""
        draw, simulate = jax.random.split(self.of_check(index))
        return draw, simulate


class RoundKeys(NamedTuple):
    """Keys of one round: for proposals, for their simulations, and for the rest of the round."""

    propose: jax.Array
    simulate: jax.Array
    update: jax.Array


def run_keys(key: jax.Array) -> RunKeys:
    """The keys of a run, from its own. Runs with the same key share their observation."""
    return RunKeys(*(jax.random.fold_in(key, purpose) for purpose in range(3)))


def init_key(run: jax.Array) -> jax.Array:
    """The key of a run's first network."""
    return jax.random.split(jax.random.clone(run))[0]


def round_keys(run: jax.Array, index: Int[Array, ""] | int) -> RoundKeys:
    """The keys of one round of a run."""
    return RoundKeys(*jax.random.split(jax.random.fold_in(jax.random.split(jax.random.clone(run))[1], index), 3))


def seed_of(key: jax.Array) -> int:
    """The integer that a key was made from, or one that represents it: `key_of` is the inverse.

    Raises:
        ValueError: for a key that is not of JAX's default implementation.
    """
    words = np.asarray(jax.random.key_data(key), ">u4")
    if words.shape != (2,):
        raise ValueError(f"key: expected one of JAX's default implementation, got {key!r}")
    return int.from_bytes(words.tobytes(), "big")


def key_of(seed: int) -> jax.Array:
    """The key of a seed: `jax.random.key(seed)`, also for seeds of more than 32 bits."""
    words = np.frombuffer(int(seed).to_bytes(8, "big"), ">u4").astype(np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl="threefry2x32")
