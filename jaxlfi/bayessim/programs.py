"""Compiled programs of batches, shared by all engines of equal tasks."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from jaxlfi.distributions.precision import single
from jaxlfi.io import executables
from jaxlfi.io.lowered import Program

KEPT = 64
"""Number of jitted functions kept in the cache."""


def program(one: functools.partial, mesh: Mesh, in_axes: tuple[int | None, ...], donate: tuple[int, ...] = ()) -> Any:
    """A function of one run as a jitted function of a batch; the same one for equal arguments.

    Args:
        one: the function, with its static arguments bound.
        mesh: mesh with one axis, of the devices that the runs are divided over.
        in_axes: axes of the other arguments: 0 for one value per run, None for a value that all share.
        donate: places of arguments whose memory the results may reuse.
    """
    return _program(one.func, one.args, mesh, in_axes, donate)


@functools.lru_cache(maxsize=KEPT)
def _program(function, bound: tuple, mesh: Mesh, in_axes: tuple[int | None, ...], donate: tuple[int, ...]):
    many = side_by_side(functools.partial(function, *bound), mesh, in_axes)
    return Program(many, function, (bound, in_axes, mesh.size), donate)


def side_by_side(one: functools.partial, mesh: Mesh, in_axes: tuple[int | None, ...]) -> Callable[..., Any]:
    """A function of one run as a function of a batch: `vmap` over the runs, which are divided over devices.

    Arguments are as in `program`; the number of runs must be a multiple of the devices.
    """
    mapped = jax.vmap(one, in_axes=in_axes)

    @single
    def many(*arguments):
        return _alone(one, in_axes, arguments) if _runs(in_axes, arguments) == 1 else mapped(*arguments)

    many.__name__ = one.func.__name__  # in profiles
    if mesh.size == 1:
        return many
    # Runs are divided by shard_map, as the predicates of while-loops must not depend on several devices.
    split = PartitionSpec(mesh.axis_names[0])
    specs = tuple(PartitionSpec() if axis is None else split for axis in in_axes)
    return jax.shard_map(many, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)


def _runs(in_axes: tuple[int | None, ...], arguments: tuple) -> int:
    """Number of runs of a batch (on one device)."""
    return next(len(jax.tree.leaves(value)[0]) for axis, value in zip(in_axes, arguments, strict=True) if axis == 0)


def _alone(one: functools.partial, in_axes: tuple[int | None, ...], arguments: tuple) -> Any:
    """A batch of one run without `vmap`, whose loops and scatters would take a tenth longer to compile and to run."""
    own = [
        value if axis is None else jax.tree.map(lambda leaf: leaf[0], value)
        for axis, value in zip(in_axes, arguments, strict=True)
    ]
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], one(*own))


def forget() -> None:
    """Drop all compiled programs and the memory they hold; they are recompiled when needed."""
    executables.forget()
    _program.cache_clear()
