"""Rows in random order, reshuffled every epoch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

LARGEST_PLACE = 16
"""Largest number of bits for a row's place that leaves enough of 31 to be random."""


def shuffled(key: jax.Array, rows: Int[Array, " cap"], count: Int[Array, ""] | int) -> Int[Array, " cap"]:
    """The first `count` rows in random order, followed by the others.

    One number per row is sorted, random in its upper bits and with the row's place in its lower ones: XLA sorts numbers
    several times faster than pairs. If upper bits are equal, the earlier place comes first.
    """
    capacity = rows.shape[0]
    place = jnp.arange(capacity, dtype=jnp.uint32)
    bits = max(capacity - 1, 1).bit_length()
    if bits > LARGEST_PLACE:
        rank = jnp.where(place < count, jax.random.uniform(key, (capacity,)), 2.0)
        return rows[jnp.argsort(rank)]
    random = jax.random.bits(key, (capacity,)) >> (bits + 1) << bits
    behind = jnp.uint32(1 << 31)
    in_order = jnp.sort(jnp.where(place < count, random, behind) | place, stable=False)
    return rows[in_order & ((1 << bits) - 1)]
