"""Checks of arguments at the entry points of the library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.arguments import as_key, is_concrete, require_count


def test_a_key_is_one_typed_key():
    key = jax.random.key(3)
    assert as_key(key) is key
    seeds = (3, np.int64(3), np.array([0, 3], np.uint32), jnp.array([0, 3], jnp.uint32))
    assert all(bool(as_key(seed) == key) for seed in seeds)
    for wrong in (-1, 2**32, True, 1.0, jnp.zeros(3, jnp.uint32), jax.random.split(key), None, "key"):
        with pytest.raises(ValueError, match=r"^key: expected one key such as jax.random.key\(0\), or a seed, got"):
            as_key(wrong)


def test_counts_are_whole_and_large_enough():
    assert require_count(3, "n") == 3
    assert require_count(np.int64(2), "n") == 2
    assert require_count(0, "n", least=0) == 0
    for wrong in (0, -1, 2.5, 2.0, True, "3", None, [1]):
        with pytest.raises(ValueError, match=r"^n: expected a whole number of at least 1, got"):
            require_count(wrong, "n")


def test_tracers_are_seen_anywhere_in_a_tree():
    seen = []
    jax.jit(lambda x: seen.append(is_concrete({"a": jnp.ones(2), "b": (x, 1)})))(1.0)
    assert seen == [False]
    assert is_concrete({"a": jnp.ones(2), "b": (np.ones(1), 1, None)})
