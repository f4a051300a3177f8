"""Compile programs ahead of their first call, several at a time, and keep them in the process and on disk."""

import contextlib
import gc
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from jaxlfi.io import compile_cache
from jaxlfi.io.identity import unchanged

Options = Mapping[str, Any]
"""Options of the compiler on a CPU."""

Call = tuple[Any, tuple, Options]
"""A jitted function, its arguments (arrays, or their shapes), and its compiler options."""

THOROUGH: Options = {}
"""Options for the fastest program."""
QUICK: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
"""Options that halve the compilation time, for programs that run for milliseconds."""
QUICKEST: Options = {**QUICK, "xla_backend_optimization_level": 0}
"""Options that compile in a fifth of the time, for programs that take milliseconds even at a fifth of the speed."""
AT_ONCE = 8
"""Largest number of programs compiled at the same time."""
KEPT = 64
"""Largest number of programs kept in the process."""
SELDOM = (50_000, 20, 50)
"""Thresholds of Python's garbage collector while programs are traced."""

_EXECUTABLES: dict[Any, Any] = {}


def compiled(many: Any, arguments: tuple, options: Options = THOROUGH) -> Any:
    """Compile a jitted function for arguments of these shapes, once and ahead of its first call."""
    return compile_all([(many, arguments, options)])[0]


def call(many: Any, *arguments: Any, options: Options = THOROUGH) -> Any:
    """Call a program that is compiled only once: a state read back from a checkpoint does not recompile it."""
    return compiled(many, arguments, options)(*arguments)


def quickly(many: Any, *arguments: Any, options: Options = QUICKEST) -> Any:
    """Call a jitted function that is compiled with quick options, unless it is part of a program being traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
        return many(*arguments)
    return call(many, *arguments, options=options)


def compile_all(calls: Iterable[Call]) -> list[Any]:
    """Compile jitted functions for arguments of these shapes in parallel: the compiler does not block Python.

    Each starts to compile as soon as `calls` yields it, while the next one is being prepared, for example traced.
    """
    wanted: list[Any] = []
    found: dict[Any, Any] = {}
    begun: dict[Any, Any] = {}
    with _seldom_collected(), contextlib.ExitStack() as compiling:
        for many, arguments, options in calls:
            signature = _signature(many, arguments, options)
            wanted.append(signature)
            if signature in _EXECUTABLES:
                found[signature] = _EXECUTABLES[signature]
            elif signature not in begun:
                if not begun:
                    compiling.enter_context(compile_cache.used())
                    compiling.enter_context(unchanged())
                    threads = compiling.enter_context(ThreadPoolExecutor(AT_ONCE))
                begun[signature] = threads.submit(many.lower(*arguments).compile, _known(options))
        made = {signature: one.result() for signature, one in begun.items()}
    while _EXECUTABLES and len(_EXECUTABLES) + len(made) > KEPT:
        del _EXECUTABLES[next(iter(_EXECUTABLES))]
    _EXECUTABLES.update(made)
    found |= made
    return [found[signature] for signature in wanted]


@contextlib.contextmanager
def _seldom_collected() -> Iterator[None]:
    """Collect garbage less often: it takes a quarter of the time of tracing, which creates millions of objects."""
    before = gc.get_threshold()
    gc.set_threshold(*SELDOM)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _known(options: Options) -> dict[str, Any] | None:
    """The options, if the compiler in use has them; None if they would gain nothing."""
    optimised = not jax.config.read("jax_disable_most_optimizations")
    # Later versions of XLA have no alternative to the fusion emitters on the CPU.
    there = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 10)
    return dict(options) if optimised and there and options else None


def forget() -> None:
    """Drop all compiled programs and the memory they hold; they are recompiled when needed."""
    _EXECUTABLES.clear()


def _signature(many: Any, arguments: tuple, options: Options) -> tuple:
    """The key by which a compiled program is found."""
    leaves, structure = jax.tree.flatten(arguments)
    wide = jax.config.jax_enable_x64  # type: ignore[attr-defined]  # jax defines it at run time
    shapes = tuple((np.shape(leaf), dtype(leaf), _placed(leaf)) for leaf in leaves)
    return many, tuple(options.items()), wide, structure, shapes


def dtype(leaf: Any) -> np.dtype:
    """The type of an array, or the type that a Python number is converted to.

    `jax.dtypes.result_type` cannot tell: for a weakly typed array it returns the default type of the process.
    """
    return getattr(leaf, "dtype", None) or jax.dtypes.result_type(leaf)


def _placed(leaf: Any) -> Any:
    """The placement of an array; None for the default device."""
    sharding = getattr(leaf, "sharding", None)
    return None if sharding is None or sharding.device_set == {jax.local_devices()[0]} else sharding
