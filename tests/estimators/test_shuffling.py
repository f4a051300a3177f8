"""The order of rows in an epoch."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.estimators.shuffling import LARGEST_PLACE, shuffled

BEYOND = 2**LARGEST_PLACE + 1
"""A number of rows that is too large for the fast method."""
_shuffled = jax.jit(shuffled)
"""One program for each capacity: one by one, its operations would be twenty programs."""


CAPACITIES = (1, 2, 5, 64, 127, 128, 129, 300)
"""Only a few, as each is compiled separately: powers of two, their neighbours, and others."""


@given(seed=st.integers(0, 2**32 - 1), capacity=st.sampled_from(CAPACITIES), data=st.data())
def test_the_filled_rows_stay_in_front_and_each_is_there_once(seed, capacity, data):
    count = data.draw(st.integers(0, capacity))
    rows = np.random.default_rng(seed).permutation(capacity)
    order = np.asarray(_shuffled(jax.random.key(seed), jnp.asarray(rows), count))
    np.testing.assert_array_equal(np.sort(order[:count]), np.sort(rows[:count]))
    np.testing.assert_array_equal(order[count:], rows[count:])


@pytest.mark.parametrize("capacity", [2**LARGEST_PLACE, BEYOND])
def test_many_rows(capacity):
    order = np.asarray(_shuffled(jax.random.key(0), jnp.arange(capacity), capacity - 5))
    np.testing.assert_array_equal(np.sort(order), np.arange(capacity))
    np.testing.assert_array_equal(order[-5:], np.arange(capacity - 5, capacity))
    assert abs(scipy.stats.spearmanr(order[:-5], np.arange(capacity - 5)).statistic) < 4 / np.sqrt(capacity)


@pytest.mark.parametrize("capacity", [7, 8, 9])
def test_every_order_of_four_rows_is_as_likely(capacity):
    keys = jax.random.split(jax.random.key(3), 24_000)
    orders = jax.jit(jax.vmap(lambda key: shuffled(key, jnp.arange(capacity), 4)[:4]))(keys)
    _, counts = np.unique(np.asarray(orders), axis=0, return_counts=True)
    assert len(counts) == 24
    assert scipy.stats.chisquare(counts).pvalue > 1e-4


def test_a_row_goes_anywhere_of_five_hundred():
    keys = jax.random.split(jax.random.key(4), 20_000)
    place = jax.jit(jax.vmap(lambda key: jnp.argmax(shuffled(key, jnp.arange(500), 250) == 17)))
    counts, _ = np.histogram(np.asarray(place(keys)), bins=50, range=(0, 250))
    assert counts.sum() == 20_000
    assert scipy.stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("capacity", [50, BEYOND])
def test_eager_is_jit_and_vmap_is_a_loop(capacity):
    keys, counts = jax.random.split(jax.random.key(5), 3), jnp.array([0, capacity // 2, capacity])
    rows = jnp.arange(capacity)
    eager = jnp.stack([shuffled(key, rows, count) for key, count in zip(keys, counts, strict=True)])
    together = jax.jit(jax.vmap(shuffled, in_axes=(0, None, 0)))(keys, rows, counts)
    chex.assert_trees_all_equal(eager, together)
