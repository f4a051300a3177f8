"""Lowered programs, kept on disk, so that the next process neither traces nor lowers them.

What the compiler is given depends on code, on settings and on the types of arguments, and not on their values. Where
all of that is jaxlfi's own, a program is kept as StableHLO (`jax.export`) beside the compiled ones
(`jaxlfi.io.compile_cache`), under a name that is a hash of it all: the source of jaxlfi, what its modules hold at this
moment, versions, jax's configuration, the types of the arguments and everything static in them. A simulator, heuristic
or prior of the user's own, and a function of jaxlfi that somebody has replaced, have no such name: programs that hold
them are traced as ever.

Measured with jax 0.9.2 on one core, default settings: tracing and lowering the stages of a round takes 10 s, reading
them 1 s.
"""

import dataclasses
import functools
import hashlib
import json
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.io import compile_cache
from jaxlfi.io.files import write_bytes
from jaxlfi.io.identity import NotKept, constant, environment, found, named, written

UNGUARANTEED = ("lapack_sgesvd_ffi",)
"""Calls of jaxlib's that may be others in its next version, which has programs of its own."""


class Lowered(NamedTuple):
    """A program ready to be compiled, from leaves to leaves, and what it returns: a pytree of shapes."""

    lowered: Any
    shapes: Any

    def compile(self, options: Mapping[str, Any] | None = None) -> "Compiled":
        """The compiled program."""
        return Compiled(self.lowered.compile(options), jax.tree.structure(self.shapes))


class Compiled(NamedTuple):
    """A compiled program, from leaves to leaves, and the structure of what it returns."""

    executable: Any
    structure: Any

    def __call__(self, *arguments: Any) -> Any:
        """As the function that it was made of."""
        return jax.tree.unflatten(self.structure, self.executable(*jax.tree.leaves(arguments)))

    def memory_analysis(self) -> Any:
        """Bytes that it needs, as the compiler says; None where it does not."""
        return self.executable.memory_analysis()


class Program:
    """A jitted function whose lowered form is kept on disk where it can be."""

    def __init__(
        self, function: Callable[..., Any], core: Callable[..., Any], static: Any, donate: tuple[int, ...] = ()
    ):
        """Prepare, without tracing.

        Args:
            function: to be jitted.
            core: the function that it is made of.
            static: what else it is made of.
            donate: places of arguments whose memory the results may take.
        """
        self.jitted = jax.jit(function, donate_argnums=donate)
        self._function, self._core, self._static, self._donate = function, core, static, donate
        self._kept: dict[str, Lowered] = {}
        self.__name__ = core.__name__

    def __call__(self, *arguments: Any) -> Any:
        """As the jitted function."""
        return self.jitted(*arguments)

    def shapes(self, *arguments: Any) -> Any:
        """What it returns for arguments of these shapes, as a pytree of shapes."""
        kept = self._as_kept(arguments)
        return jax.eval_shape(self.jitted, *arguments) if kept is None else kept.shapes

    def lower(self, *arguments: Any) -> Any:
        """The program for arguments of these shapes, ready to be compiled: read from the disk if it is there."""
        return self._as_kept(arguments) or self.jitted.lower(*arguments)

    def _as_kept(self, arguments: tuple) -> Lowered | None:
        """The program as it is kept, from now on if not before; None where it cannot be."""
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
        """Trace and lower the program, and keep it; its first use is as its others will be."""
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
            write_bytes(path, zlib.crc32(content).to_bytes(4, "big") + content)
        except OSError as error:
            _say_once(str(error))
        return _lowered(exported, header, types, static)


def _read(path: Path, types: list, static: dict[str, Any]) -> Lowered | None:
    """A program as it was kept; None where there is none, or a damaged one."""
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
    """Have jaxlib look up the functions of LAPACK, as it does when the first of them is lowered, and not before."""
    jax.jit(jnp.linalg.cholesky).lower(np.ones((1, 1), np.float32))


@functools.cache
def _say_once(reason: str) -> None:
    warnings.warn(f"programs are traced anew in the next process: {reason}", stacklevel=2)


def _types(arguments: tuple) -> list[jax.ShapeDtypeStruct]:
    """Shapes and types of the leaves.

    Raises:
        NotKept: where one lies elsewhere than on the first device.
    """
    first = {jax.local_devices()[0]}
    types = []
    for leaf in jax.tree.leaves(arguments):
        sharding = getattr(leaf, "sharding", None)
        if sharding is not None and sharding.device_set != first:
            raise NotKept
        types.append(jax.ShapeDtypeStruct(np.shape(leaf), jax.dtypes.result_type(leaf)))
    return types


def _tree(structure: Any, static: dict[str, Any] | None = None) -> Any:
    """A pytree's structure as JSON: class, static fields and children of each node; `static` takes up the fields."""
    if structure.node_data() is None:
        return None
    kind, fields = structure.node_data()
    values = fields if isinstance(fields, tuple | list) else (fields,)
    texts = [written(value) for value in values]
    if static is not None:
        static.update(zip(texts, values, strict=True))
    return [named(kind), texts, [_tree(child, static) for child in structure.children()]]


def _built(tree: Any, static: Mapping[str, Any], leaves: Iterator[Any]) -> Any:
    """The pytree with these leaves that has been written as JSON; its static fields are those of the arguments.

    Raises:
        NotKept: where another static field is wanted.
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
