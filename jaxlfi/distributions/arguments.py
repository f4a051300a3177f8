"""Checks of arguments of the library's public functions; each raises a ValueError that names the argument."""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def as_key(key: Any, name: str = "key") -> jax.Array:
    """One typed key, from a typed key, a seed or an untyped key.

    Raises:
        ValueError: for anything else, or several keys.

    Example:
        >>> as_key(7) == jax.random.key(7)
        Array(True, dtype=bool)
    """
    if isinstance(key, int | np.integer) and not isinstance(key, bool) and 0 <= key < 2**32:
        return jax.random.key(int(key))
    dtype = getattr(key, "dtype", None)
    if dtype == np.uint32 and key.shape == (2,):
        return jax.random.wrap_key_data(key, impl="threefry2x32")
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key) or key.shape != ():
        raise ValueError(
            f"{name}: expected one key such as jax.random.key(0), or a seed, got {' '.join(repr(key).split())}"
        )
    return key


def require_count(value: Any, name: str, least: int = 1, most: int | None = None) -> int:
    """Refuse anything but a whole number of at least `least` and at most `most`.

    Raises:
        ValueError: naming the argument.
    """
    try:
        count = operator.index(value)
    except TypeError:
        count = None
    if count is None or isinstance(value, bool) or count < least:
        raise ValueError(f"{name}: expected a whole number of at least {least}, got {value!r}")
    if most is not None and count > most:
        raise ValueError(f"{name}: expected at most {most}, got {value!r}")
    return count


def require_texts(value: Any, name: str) -> tuple[str, ...]:
    """Refuse anything but a sequence of strings.

    Raises:
        ValueError: naming the argument.
    """
    try:
        texts = () if isinstance(value, str) else tuple(value)
    except TypeError:
        texts = (None,)
    if isinstance(value, str) or not all(isinstance(text, str) for text in texts):
        what = "the string " * isinstance(value, str)
        raise ValueError(f"{name}: expected a sequence of names, got {what}{value!r}")
    return texts


def is_concrete(tree: Any) -> bool:
    """Whether no leaf of a pytree is being traced."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
