"""A cheap counter-based random generator for inner loops that draw one number per event.

`jax.random` runs threefry with twenty rounds, which is two thirds of the cost of a Gillespie step.
Here a `Seed` of 64 bits, itself drawn by threefry from a typed key, turns a 32-bit counter into a
32-bit word by three multiplications. There is no state: the words of a seed can be
computed in any order, so a loop over events needs only the event number. It is not cryptographic,
and a seed has 2**32 words.

The mixing function is an xor-shift-multiply finaliser in the manner of MurmurHash3 (A. Appleby,
2011, whose two multipliers are used) and of the counter-based generators of Salmon, Moraes, Dror,
Shaw (2011), "Parallel random numbers: as easy as 1, 2, 3". Statistical tests are in
`tests/envs/lotka_volterra/test_jump_process.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_GOLDEN_STEP = np.uint32(0x9E3779B9)  # 2**32 / golden ratio: spreads neighbouring counters
_MULTIPLIERS = (np.uint32(0x85EBCA6B), np.uint32(0xC2B2AE35), np.uint32(0x27D4EB2F))


class Seed(NamedTuple):
    """The 64 bits that name a stream, as two words of any (equal) shape."""

    low: jax.Array
    high: jax.Array


def seed_from_key(key: jax.Array) -> Seed:
    """Draws one stream's seed from one typed `jax.random.key`, which is consumed."""
    words = jax.random.bits(key, (2,), jnp.uint32)
    return Seed(words[0], words[1])


def random_word(seed: Seed, counter: jax.Array) -> jax.Array:
    """Returns word number `counter` (uint32) of the stream `seed`, broadcasting the two.

    `seed.low` shifts the counter and `seed.high` enters between the multiplications: with the shift
    alone, two simulations whose low words lie close together would replay each other's stream a few
    events later.
    """
    word = counter * _GOLDEN_STEP + seed.low
    word = (word ^ (word >> 16)) * _MULTIPLIERS[0] + seed.high
    word = (word ^ (word >> 15)) * _MULTIPLIERS[1]
    word = (word ^ (word >> 16)) * _MULTIPLIERS[2]
    return word ^ (word >> 15)


def uniform(word: jax.Array) -> jax.Array:
    """Maps a word to a multiple of 2**-24 in [0, 1): `uniform(w) * a < a` for any normal a > 0."""
    return (word >> 8).astype(jnp.int32).astype(jnp.float32) * np.float32(2.0**-24)


def exponential(word: jax.Array) -> jax.Array:
    """Maps a word to a standard exponential, in [0, 22.2].

    The uniform below the logarithm keeps all 31 leading bits (float32 is finer near zero), so that
    the tail, which gives the long waiting times, is not truncated at -log(2**-24) = 16.6.
    """
    # Through int32: one vector instruction converts it to float; uint32 takes several.
    positive = (word >> 1).astype(jnp.int32).astype(jnp.float32) + np.float32(0.5)
    return -jnp.log(positive * np.float32(2.0**-31))
