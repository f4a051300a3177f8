"""Compiled programs of batches, shared by all engines of equal tasks."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxlfi.distributions.precision import single
from jaxlfi.io import compile_cache

KEPT = 64
"""Number of jitted functions that are kept, and number of their compiled versions for some shapes of arguments."""


Call = tuple[Any, tuple]
"""A jitted function, and what it is called with: arrays, or their shapes."""

QUICK = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
"""Compiler options on a CPU that take half of the time or less, of programs that run for milliseconds."""


def program(
    one: functools.partial,
    mesh: Mesh,
    in_axes: tuple[int | None, ...],
    donate: tuple[int, ...] = (),
    quick: bool = False,
) -> Any:
    """A function of one run as a jitted function of a batch; the same one for equal arguments.

    Args:
        one: the function, with its static arguments bound.
        mesh: of the devices that the runs are divided over, of one axis.
        in_axes: of the other arguments: 0 for one value a run, None for a value that all share.
        donate: places of arguments whose memory the results may take.
        quick: whether it matters more how long it takes to compile than to run.
    """
    return _program(one.func, one.args, mesh, in_axes, donate, quick)


@functools.lru_cache(maxsize=KEPT)
def _program(function, bound: tuple, mesh: Mesh, in_axes: tuple[int | None, ...], donate: tuple[int, ...], quick: bool):
    many = side_by_side(functools.partial(function, *bound), mesh, in_axes)
    # Later versions of XLA have no other fusions on the CPU.
    options = QUICK if quick and jax.default_backend() == "cpu" and jax.__version_info__ < (0, 10) else None
    return jax.jit(many, donate_argnums=donate, compiler_options=options)


def side_by_side(one: functools.partial, mesh: Mesh, in_axes: tuple[int | None, ...]) -> Callable[..., Any]:
    """A function of one run as a function of a batch: `vmap` over the runs, which are divided over devices.

    Arguments are as of `program`; the number of devices divides that of the runs.
    """
    mapped = jax.vmap(one, in_axes=in_axes)

    @single
    def many(*arguments):
        return _alone(one, in_axes, arguments) if _runs(in_axes, arguments) == 1 else mapped(*arguments)

    many.__name__ = one.func.__name__  # in profiles
    if mesh.size == 1:
        return many
    # Runs are divided by shard_map, as while-loops must not get predicates that cross devices.
    split = PartitionSpec(mesh.axis_names[0])
    specs = tuple(PartitionSpec() if axis is None else split for axis in in_axes)
    return jax.shard_map(many, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)


def _runs(in_axes: tuple[int | None, ...], arguments: tuple) -> int:
    """Number of runs of a batch (on one device)."""
    return next(len(jax.tree.leaves(value)[0]) for axis, value in zip(in_axes, arguments, strict=True) if axis == 0)


def _alone(one: functools.partial, in_axes: tuple[int | None, ...], arguments: tuple) -> Any:
    """A batch of one run without `vmap`, whose loops and scatters would take a tenth longer, to compile and to run."""
    own = [
        value if axis is None else jax.tree.map(lambda leaf: leaf[0], value)
        for axis, value in zip(in_axes, arguments, strict=True)
    ]
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], one(*own))


_EXECUTABLES: dict[Any, Any] = {}


def compiled(many: Any, arguments: tuple) -> Any:
    """A jitted function compiled for arguments of these shapes: ahead of its first call, and once."""
    compile_all([(many, arguments)])
    return _EXECUTABLES[_signature(many, arguments)]


def call(many: Any, *arguments: Any) -> Any:
    """Call a program compiled once: a state that was read back from a checkpoint does not compile it anew."""
    return compiled(many, arguments)(*arguments)


def compile_all(calls: Sequence[Call]) -> None:
    """Compile jitted functions for arguments of these shapes, side by side: the compiler leaves Python alone."""
    missing = {signature: one for one in calls if (signature := _signature(*one)) not in _EXECUTABLES}
    if not missing:
        return
    compile_cache.start()
    while _EXECUTABLES and len(_EXECUTABLES) + len(missing) > KEPT:
        del _EXECUTABLES[next(iter(_EXECUTABLES))]
    with ThreadPoolExecutor(len(missing)) as threads:
        begun = {signature: threads.submit(many.lower(*given).compile) for signature, (many, given) in missing.items()}
        _EXECUTABLES.update({signature: one.result() for signature, one in begun.items()})


def _signature(many: Any, arguments: tuple) -> tuple:
    """What a compiled program is known by."""
    leaves, structure = jax.tree.flatten(arguments)
    wide = jax.config.jax_enable_x64  # type: ignore[attr-defined]  # jax makes it at run time
    return many, wide, structure, tuple((np.shape(leaf), jax.dtypes.result_type(leaf)) for leaf in leaves)


def forget() -> None:
    """Drop all compiled programs, and the memory they hold; they are compiled anew when they are needed."""
    _EXECUTABLES.clear()
    _program.cache_clear()
