"""Programs compiled ahead of their first call, several at a time, and kept: in the process, and on disk."""

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
"""Of the compiler, on a CPU."""

Call = tuple[Any, tuple, Options]
"""A jitted function, what it is called with (arrays, or their shapes), and how it is compiled."""

THOROUGH: Options = {}
"""To run as fast as it can."""
QUICK: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
"""In half of the time, what runs for milliseconds."""
QUICKEST: Options = {**QUICK, "xla_backend_optimization_level": 0}
"""In a fifth of the time, what runs for milliseconds even at a fifth of the speed."""
AT_ONCE = 8
"""Programs that are compiled at the same time, at most."""
KEPT = 64
"""Number of programs that are kept."""
SELDOM = (50_000, 20, 50)
"""Thresholds of Python's garbage collector while programs are traced."""

_EXECUTABLES: dict[Any, Any] = {}


def compiled(many: Any, arguments: tuple, options: Options = THOROUGH) -> Any:
    """A jitted function compiled for arguments of these shapes: ahead of its first call, and once."""
    return compile_all([(many, arguments, options)])[0]


def call(many: Any, *arguments: Any, options: Options = THOROUGH) -> Any:
    """Call a program compiled once: a state that was read back from a checkpoint does not recompile it."""
    return compiled(many, arguments, options)(*arguments)


def quickly(many: Any, *arguments: Any, options: Options = QUICKEST) -> Any:
    """Call a jitted function that is compiled sooner than it would be, unless it is part of a program being traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
        return many(*arguments)
    return call(many, *arguments, options=options)


def compile_all(calls: Iterable[Call]) -> list[Any]:
    """Compile jitted functions for arguments of these shapes, side by side: the compiler leaves Python alone.

    Each begins to be compiled as it is named: what it takes to name the next, such as to trace it, goes on meanwhile.
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
    """Python seldom looks for cycles within, which costs a quarter of tracing: that makes objects by the million."""
    before = gc.get_threshold()
    gc.set_threshold(*SELDOM)
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _known(options: Options) -> dict[str, Any] | None:
    """Options for the compiler that is used; None where they would gain nothing."""
    optimised = not jax.config.read("jax_disable_most_optimizations")
    # Later versions of XLA have no other fusions on the CPU.
    there = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 10)
    return dict(options) if optimised and there and options else None


def forget() -> None:
    """Drop all compiled programs, and the memory they hold; they are recompiled when they are needed."""
    _EXECUTABLES.clear()


def _signature(many: Any, arguments: tuple, options: Options) -> tuple:
    """What a compiled program is known by."""
    leaves, structure = jax.tree.flatten(arguments)
    wide = jax.config.jax_enable_x64  # type: ignore[attr-defined]  # jax makes it at run time
    shapes = tuple((np.shape(leaf), dtype(leaf), _placed(leaf)) for leaf in leaves)
    return many, tuple(options.items()), wide, structure, shapes


def dtype(leaf: Any) -> np.dtype:
    """The type of an array, or the type that a Python number is converted to.

    `jax.dtypes.result_type` cannot tell: of a weakly typed array it returns the default type of the process.
    """
    return getattr(leaf, "dtype", None) or jax.dtypes.result_type(leaf)


def _placed(leaf: Any) -> Any:
    """Where an array is, unless it is where all are by default."""
    sharding = getattr(leaf, "sharding", None)
    return None if sharding is None or sharding.device_set == {jax.local_devices()[0]} else sharding
