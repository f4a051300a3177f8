"""Pytrees of arrays as named arrays, which files can hold, and back."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def named_leaves(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their path."""
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def to_arrays(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """The leaves of a pytree as NumPy arrays, named by a prefix and their path; keys become their data."""
    return {prefix + name: _plain(leaf) for name, leaf in named_leaves(tree).items()}


def from_arrays(arrays: Mapping[str, np.ndarray], like: Any, prefix: str = "") -> Any:
    """The pytree from which `to_arrays` made these arrays.

    Args:
        arrays: arrays by name; further ones are ignored.
        like: a pytree of the same structure, shapes and types; its leaves may be `jax.ShapeDtypeStruct`.
        prefix: prefix of the names.

    Raises:
        ValueError: for a leaf that is missing or of another shape or type, naming it.
    """
    leaves = []
    for name, leaf in named_leaves(like).items():
        key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        expected = jax.eval_shape(jax.random.key_data, leaf) if key else leaf
        array = arrays.get(prefix + name)
        if array is None:
            raise ValueError(f"expected an array {prefix + name}, got none")
        if array.shape != expected.shape or array.dtype != expected.dtype:
            raise ValueError(
                f"expected {prefix + name} of shape {expected.shape} and type {expected.dtype}, "
                f"got {array.shape} and {array.dtype}"
            )
        leaves.append(jax.random.wrap_key_data(jnp.asarray(array)) if key else jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _plain(leaf: Any) -> np.ndarray:
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)
