"""Single precision for inference, whatever the process has switched on; a user's own functions keep the process's.

Simulators that integrate differential equations need double precision at times (`jax_enable_x64`). Inference does not:
it is always compiled in single precision, with such a simulator in double precision within it.
"""

import contextlib
import contextvars
import functools
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

_DOUBLE = contextvars.ContextVar("double", default=False)
"""Whether double precision was on when a function in single precision was entered."""
_NARROW = {"float64": jnp.float32, "int64": jnp.int32, "uint64": jnp.uint32, "complex128": jnp.complex64}


def single(function: Callable[..., Any]) -> Callable[..., Any]:
    """Have a function traced in single precision, for `jax.jit` to compile; unchanged if double precision is off.

    Functions that it calls are traced in single precision, too, except within `own`. Only compiled functions may
    contain such parts: `jax.jit` goes around the result, not inside it.

    Example:
        >>> jax.jit(single(lambda x: x + jnp.ones(2)))(jnp.zeros(2)).dtype
        dtype('float32')
    """

    @functools.wraps(function)
    def traced(*arguments: Any, **named: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]  # jax defines it at run time
            return function(*arguments, **named)
        token = _DOUBLE.set(True)
        try:
            with jax.enable_x64(False), warnings.catch_warnings():
                # Constants in double precision, such as a prior's, are rounded on purpose.
                warnings.filterwarnings("ignore", message="Explicitly requested dtype")
                arguments, named = jax.tree.map(_narrowed, (arguments, named))
                return function(*arguments, **named)
        finally:
            _DOUBLE.reset(token)

    return traced


@contextlib.contextmanager
def own() -> Iterator[None]:
    """Restore the precision of the process, for a user's function within `single`."""
    if not _DOUBLE.get():
        yield
        return
    token = _DOUBLE.set(False)
    try:
        with jax.enable_x64(True):
            yield
    finally:
        _DOUBLE.reset(token)


def _narrowed(leaf: Any) -> Any:
    kind = _NARROW.get(str(getattr(leaf, "dtype", "")))
    return leaf if kind is None else leaf.astype(kind)
