"""What a program depends on, as texts that are the same in every process: static values, code, versions, options."""

import contextlib
import contextvars
import dataclasses
import enum
import functools
import hashlib
import importlib
import importlib.metadata
import json
import os
import platform
import sys
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

OURS = "jaxlfi"
KNOWN = {
    OURS, "chex", "distrax", "flax", "jax", "jaxlib", "jaxtyping", "ml_dtypes", "numpy", "optax", "scipy",
    "tensorflow_probability", "typing_extensions",
}  # fmt: skip
"""Packages whose functions and classes are identified by name and version, like those of Python's standard library."""
IRRELEVANT = ("cache", "log", "persistent", "dump", "traceback", "pprint")
"""Parts of the names of JAX's options that do not change programs."""


_ENVIRONMENTS: contextvars.ContextVar[dict[str, str]] = contextvars.ContextVar("environments")
"""Within `unchanged`: environments by module."""


class NotKept(Exception):
    """A program cannot be cached: it depends on something that other processes cannot identify."""


def written(value: Any) -> str:
    """A static value as a text that is the same in every process, and different for every other value.

    Raises:
        NotKept: for values without such a text, such as anything defined by a user.

    Example:
        >>> written((None, 2, "two"))
        'tuple(null, 2, "two")'
    """
    match value:
        case None | bool() | int() | float() | str():
            return json.dumps(value)
        case np.generic() | np.dtype():
            return f"{type(value).__name__} {value!r}"
        case enum.Enum():
            return f"{named(type(value))}.{value.name}"
        case tuple() | list():
            return f"{type(value).__name__}({', '.join(map(written, value))})"
        case dict():
            return f"{{{', '.join(f'{written(name)}: {written(of)}' for name, of in value.items())}}}"
        case np.ndarray() if not value.dtype.hasobject:
            return f"array {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        case type():
            return named(value)
        case types.FunctionType() if value.__closure__ is None:
            return named(value)
    if not dataclasses.is_dataclass(value):
        raise NotKept
    fields = (f"{field.name}={written(getattr(value, field.name))}" for field in dataclasses.fields(value))
    return f"{named(type(value))}({', '.join(fields)})"


def constant(text: str) -> Any:
    """None, a truth value, a number or a text, read back from what `written` made of it.

    Raises:
        NotKept: for anything else.
    """
    with contextlib.suppress(ValueError):
        if (value := json.loads(text)) is None or isinstance(value, bool | int | float | str):
            return value
    raise NotKept


def named(what: Any) -> str:
    """Module and name of a function or class, by which every process can find it.

    Raises:
        NotKept: if it is defined inside a function, or in a package that is not known.
    """
    name = what.__qualname__
    if "<" in name:
        raise NotKept
    return f"{_module(what)}:{name}"


def found(name: str) -> Any:
    """The function or class of that name, from jaxlfi or one of Python's own."""
    module, _, qualified = name.partition(":")
    if module == "builtins":
        return {"NoneType": type(None), "tuple": tuple, "list": list, "dict": dict}[qualified]
    return functools.reduce(getattr, qualified.split("."), importlib.import_module(module))


@contextlib.contextmanager
def unchanged() -> Iterator[None]:
    """Inspect modules and options only once within this context, as that takes longer than everything else.

    Nothing that a program depends on may change within it, as nothing does while the programs of one run are compiled.
    """
    token = _ENVIRONMENTS.set({})
    try:
        yield
    finally:
        _ENVIRONMENTS.reset(token)


def environment(function: Any) -> str:
    """Everything that the program of a function depends on apart from arguments: code, versions, options, backend.

    Raises:
        NotKept: if a module of jaxlfi holds something from an unknown package, such as a replaced function.
    """
    known, module = _ENVIRONMENTS.get({}), _module(function)
    if module not in known:
        known[module] = _environment(module)
    return known[module]


def _environment(module: str) -> str:
    options = {
        name: repr(getattr(jax.config, name, value))
        for name, value in sorted(jax.config.values.items())
        if not any(part in name for part in IRRELEVANT)
    }
    return json.dumps([_installed(), jax.default_backend(), options, list(_modules(module))])


@functools.cache
def _installed() -> list[str]:
    """The source of jaxlfi as a hash, and the versions of what it is built on."""
    source = hashlib.sha256()
    root = importlib.import_module(OURS).__path__[0]
    for folder, _, names in sorted(os.walk(root, followlinks=True)):
        for path in sorted(Path(folder, name) for name in names if name.endswith(".py")):
            source.update(str(path.relative_to(root)).encode() + path.read_bytes())
    packages = ("jax", "jaxlib", "flax", "optax", "numpy")
    return [source.hexdigest(), platform.python_version(), *map(importlib.metadata.version, packages)]


def _modules(first: str) -> Iterator[str]:
    """Present contents of a module and of all jaxlfi modules it uses: constants, and names of functions and classes.

    This is how replaced functions and changed constants are noticed.
    """
    seen, waiting = set(), [first]
    while waiting:
        name = waiting.pop()
        if name in seen or name not in sys.modules:
            continue
        seen.add(name)
        for attribute, value in sorted(vars(sys.modules[name]).items()):
            if not attribute.startswith("__"):
                yield f"{name}.{attribute} {_held(value, name, waiting)}"


def _held(value: Any, module: str, waiting: list[str]) -> str:
    """A short description of one attribute of a module or class; the module that defines it is added to `waiting`."""
    match value:
        case types.ModuleType():
            source = value.__name__
        case None | bool() | int() | float() | str():
            return repr(value)
        case tuple() | list() | set() | frozenset():
            return str(sorted(_held(item, module, waiting) for item in value))
        case Mapping() if all(isinstance(name, str) for name in value):  # a registry, not a cache
            return str([f"{name} {_held(item, module, waiting)}" for name, item in value.items()])
        case _ if isinstance(getattr(value, "__module__", None), str):
            source = _module(value)
        case _:
            return type(value).__name__
    if source.partition(".")[0] == OURS:
        waiting.append(source)
    inside = vars(value) if isinstance(value, type) and source == module else {}
    own = [f"{name} {_held(item, module, waiting)}" for name, item in inside.items() if not name.startswith("_")]
    return f"{source}:{getattr(value, '__qualname__', type(value).__name__)} {own}"


def _module(what: Any) -> str:
    """The module that a function, a class, or the class of an object comes from.

    Raises:
        NotKept: if that belongs neither to jaxlfi nor to a known package.
    """
    module = what.__module__ or ""  # a function that exec makes has none
    root = module.partition(".")[0]
    if (root not in KNOWN and root not in sys.stdlib_module_names) or module in ("__main__", "unittest.mock"):
        raise NotKept
    return module
