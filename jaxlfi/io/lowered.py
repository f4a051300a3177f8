"""Lowered programs cached on disk, so that the next process does not have to trace and lower them again.

What the compiler receives depends on code, settings and the types of the arguments, but not on their values. If all of
that belongs to jaxlfi, the program is stored as StableHLO (`jax.export`) next to the compiled programs
(`jaxlfi.io.compile_cache`). The name of the file is a hash of everything that the program depends on
(`jaxlfi.io.identity`). Programs that contain a user's simulator, heuristic or prior, or a function of jaxlfi that has
been replaced, are traced as before.

Measured with jax 0.9.2 on one core, default settings: tracing and lowering the stages of a round takes 10 s, reading
them 1 s.
"""

import dataclasses
import functools
import hashlib
import json
import os
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.io import compile_cache
from jaxlfi.io.executables import dtype
from jaxlfi.io.files import write_bytes
from jaxlfi.io.identity import NotKept, constant, environment, found, named, written

UNGUARANTEED = ("lapack_sgesvd_ffi",)
"""Calls into jaxlib that its next version may no longer have; its version is part of the name of the file."""


class Lowered(NamedTuple):
    """A program ready to be compiled, which takes and returns leaves, and the shapes that it returns, as a pytree."""

    lowered: Any
    shapes: Any

    def compile(self, options: Mapping[str, Any] | None = None) -> "Compiled":
        """The compiled program."""
        return Compiled(self.lowered.compile(options), jax.tree.structure(self.shapes))


class Compiled(NamedTuple):
    """A compiled program, which takes and returns leaves, and the structure of what it returns."""

    executable: Any
    structure: Any

    def __call__(self, *arguments: Any) -> Any:
        """Call it as the function that it was made from."""
        return jax.tree.unflatten(self.structure, self.executable(*jax.tree.leaves(arguments)))

    def memory_analysis(self) -> Any:
        """The program's memory in bytes, as the compiler reports it; None if it does not."""
        return self.executable.memory_analysis()


class Program:
    """A jitted function whose lowered form is cached on disk if it can be."""

    def __init__(
        self, function: Callable[..., Any], core: Callable[..., Any], static: Any, donate: tuple[int, ...] = ()
    ):
        """Prepare, without tracing.

        Args:
            function: the function to jit.
            core: the function of jaxlfi that it was made from.
            static: everything else that it was made from.
            donate: positions of arguments whose memory the results may reuse.
        """
        self.jitted = jax.jit(function, donate_argnums=donate)
        self._function, self._core, self._static, self._donate = function, core, static, donate
        self._kept: dict[str, Lowered] = {}
        self.__name__ = core.__name__

    def __call__(self, *arguments: Any) -> Any:
        """Call the jitted function."""
        return self.jitted(*arguments)

    def shapes(self, *arguments: Any) -> Any:
        """The shapes of what it returns for arguments of these shapes, as a pytree."""
        kept = self._as_kept(arguments)
        return jax.eval_shape(self.jitted, *arguments) if kept is None else kept.shapes

    def lower(self, *arguments: Any) -> Any:
        """The program for arguments of these shapes, ready to be compiled: read from the disk if it is there."""
        return self._as_kept(arguments) or self.jitted.lower(*arguments)

    def _as_kept(self, arguments: tuple) -> Lowered | None:
        """The cached program, which is cached now if it was not before; None if it cannot be."""
        if (folder := compile_cache.kept_in()) is None:
            return None
        static: dict[str, Any] = {}
        try:
            types = _types(arguments)
            tree = _tree(jax.tree.structure(arguments), static)
            made_of = [named(self._core), written(self._static), self._donate, *map(str, types), tree]
            name = hashlib.sha256(json.dumps([environment(self._core), made_of]).encode()).hexdigest()
            if name not in self._kept:
                path = folder / "lowered" / f"{self.__name__}-{name}"
                self._kept[name] = _read(path, types, static) or self._made(path, types, arguments, static)
        except NotKept:
            return None
        return self._kept[name]

    def _made(self, path: Path, types: list, arguments: tuple, static: dict[str, Any]) -> Lowered:
        """Trace and lower the program, and cache it; the first process runs what later ones will read."""
        structure = jax.tree.structure(arguments)
        returned: list[Any] = []

        def flat(*leaves: Any) -> list:
            result, own = jax.tree.flatten(self._function(*jax.tree.unflatten(structure, leaves)))
            returned.append(own)
            return result

        flat.__name__ = self.__name__  # in profiles
        sizes = [len(jax.tree.leaves(argument)) for argument in arguments]
        given = [place for place, size in enumerate(sizes) for _ in range(size)]
        donated = [place for place, argument in enumerate(given) if argument in self._donate]
        checks = [jax.export.DisabledSafetyCheck.custom_call(call) for call in UNGUARANTEED]
        try:
            exported = jax.export.export(jax.jit(flat), disabled_checks=checks)(*types)
        except ValueError as error:  # it calls back to Python
            raise NotKept from error
        header = {"returns": _tree(returned[0]), "donated": donated}
        if jax.tree.structure(_built(header["returns"], static, iter(exported.out_avals))) != returned[0]:
            raise NotKept
        content = json.dumps(header).encode() + b"\n" + bytes(exported.serialize())
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            own = path.with_name(f"{path.name}-{os.getpid()}")  # another process may be writing the same program
            write_bytes(own, zlib.crc32(content).to_bytes(4, "big") + content)
            own.replace(path)
        except OSError as error:
            _say_once(str(error))
        return _lowered(exported, header, types, static)


def _read(path: Path, types: list, static: dict[str, Any]) -> Lowered | None:
    """A cached program; None if there is none, or the file is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if zlib.crc32(content[4:]).to_bytes(4, "big") != content[:4]:
        return None
    header, _, program = content[4:].partition(b"\n")
    _start_lapack()
    return _lowered(jax.export.deserialize(bytearray(program)), json.loads(header), types, static)


def _lowered(exported: jax.export.Exported, header: dict, types: list, static: dict[str, Any]) -> Lowered:
    shapes = _built(header["returns"], static, iter(exported.out_avals))
    lowered = jax.jit(exported.call, donate_argnums=header["donated"]).lower(*types)
    return Lowered(lowered, jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), shapes))


@functools.cache
def _start_lapack() -> None:
    """Have jaxlib look up the functions of LAPACK, which it only does when it lowers the first call of one."""
    jax.jit(jnp.linalg.cholesky).lower(np.ones((1, 1), np.float32))


@functools.cache
def _say_once(reason: str) -> None:
    warnings.warn(f"programs are traced anew in the next process: {reason}", stacklevel=2)


def _types(arguments: tuple) -> list[jax.ShapeDtypeStruct]:
    """Shapes and types of the leaves.

    Raises:
        NotKept: if one lies on another device than the first.
    """
    first = {jax.local_devices()[0]}
    types = []
    for leaf in jax.tree.leaves(arguments):
        sharding = getattr(leaf, "sharding", None)
        if sharding is not None and sharding.device_set != first:
            raise NotKept
        types.append(jax.ShapeDtypeStruct(np.shape(leaf), dtype(leaf)))
    return types


def _tree(structure: Any, static: dict[str, Any] | None = None) -> Any:
    """A pytree's structure as JSON: class, static fields and children of each node; the fields are put in `static`."""
    if structure.node_data() is None:
        return None
    kind, fields = structure.node_data()
    values = fields if isinstance(fields, tuple | list) else (fields,)
    texts = [written(value) for value in values]
    if static is not None:
        static.update(zip(texts, values, strict=True))
    return [named(kind), texts, [_tree(child, static) for child in structure.children()]]


def _built(tree: Any, static: Mapping[str, Any], leaves: Iterator[Any]) -> Any:
    """The pytree with these leaves whose structure was written as JSON, with static fields from the arguments.

    Raises:
        NotKept: if it needs another static field.
    """
    if tree is None:
        return next(leaves)
    name, texts, children = tree
    kind: Any = found(name)
    nodes = [_built(child, static, leaves) for child in children]
    if kind is type(None):
        return None
    if kind in (tuple, list):
        return kind(nodes)
    fields = [static[text] if text in static else constant(text) for text in texts]
    if kind is dict:
        return dict(zip(fields, nodes, strict=True))
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise NotKept
    node = object.__new__(kind)
    given = {True: iter(nodes), False: iter(fields)}
    for field in dataclasses.fields(kind):
        object.__setattr__(node, field.name, next(given[field.metadata.get("pytree_node", True)]))
    return node
