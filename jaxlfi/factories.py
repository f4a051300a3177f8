"""Objects made by name: by registered factories (entry points) or `module:factory`, with options given as text.

A reference is a name, and options for its factory, as in "whip,object=dlo-0,detector=clean". Options are converted to
the types that the factory's signature declares: int, float, bool, str, Path, Literal, unions of them, and tuples of any
number of one of them, whose items ";" separates.
"""

import importlib
import inspect
import os
import sys
import types
import typing
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

SEPARATOR = ";"
"""Between the items of an option of a tuple's type."""
BOOLEANS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
"""Words for an option of type bool."""


def names(group: str) -> list[str]:
    """All registered names of a group."""
    return sorted({point.name for point in entry_points(group=group)})


def parse(reference: str, word: str = "task") -> tuple[str, dict[str, str]]:
    """The name and the options of a reference.

    Args:
        reference: to parse.
        word: what it names, for errors.

    Raises:
        ValueError: for options that are none, or given twice.

    Example:
        >>> parse("whip,object=dlo-0")
        ('whip', {'object': 'dlo-0'})
    """
    if not isinstance(reference, str):
        raise ValueError(f"{word}: expected a name, got {reference!r}")
    name, *parts = reference.split(",")
    options = dict(part.partition("=")[::2] for part in parts)
    if len(options) < len(parts) or not all(key.isidentifier() and value for key, value in options.items()):
        raise ValueError(f"{word}: expected options as NAME,key=value,key=value, each key once, got {reference!r}")
    return name, options


def find(group: str, word: str, reference: str) -> Any:
    """The factory, or the ready-made object, that a registered name or "module:factory" refers to.

    Raises:
        ValueError: for unknown names, and modules that cannot be imported.
    """
    if ":" in reference:
        module_name, _, attribute = reference.partition(":")
        if module_name.endswith(".py"):
            raise ValueError(
                f"{word}: expected module:factory, got {reference!r}: leave out '.py' and run from the file's folder"
            )
        if os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())
        # A third party's module may raise anything while it is imported.
        try:
            return getattr(importlib.import_module(module_name), attribute)
        except Exception as error:
            raise ValueError(f"{word}: cannot load {reference!r}: {type(error).__name__}: {error}") from error
    points = {point.name: point for point in entry_points(group=group)}
    if reference not in points:
        raise ValueError(f"{word}: expected one of {sorted(points)} or module:factory, got {reference!r}")
    try:
        return points[reference].load()
    except Exception as error:
        raise ValueError(
            f"{word}: cannot load {reference!r} ({points[reference].value}): {type(error).__name__}: {error}"
        ) from error


def _signature(factory) -> inspect.Signature | None:
    """The signature of a factory, where it has one."""
    try:
        return inspect.signature(factory, eval_str=True)
    except (TypeError, ValueError, NameError):  # not every callable has one
        return None


def parameters(factory: Any) -> tuple[str, ...]:
    """Names of a factory's options; empty for an object that is not callable."""
    signature = _signature(factory)
    return () if signature is None else tuple(signature.parameters)


def made(word: str, reference: str, factory: Any, options: dict[str, str], kind: type) -> Any:
    """The object that a factory makes with these options; or the object itself, if it was given ready-made.

    Raises:
        ValueError: for options that the factory does not have or of another type, and for whatever it raises.
    """
    if (isinstance(factory, kind) and not isinstance(factory, type)) or not callable(factory):
        if options:
            raise ValueError(f"{word}: expected no options of {reference!r}, which is not made by a function")
        return factory
    signature = _signature(factory)
    if signature is not None:
        try:
            signature.bind(**options)
        except TypeError as error:
            known = ", ".join(signature.parameters) or "none"
            raise ValueError(f"{word}: expected options among {known}, got {reference!r}: {error}") from error
    try:
        return factory(**_converted(signature, options))
    except Exception as error:
        raise ValueError(f"{word}: {reference!r} failed: {type(error).__name__}: {error}") from error


def _converted(signature: inspect.Signature | None, options: dict[str, str]) -> dict[str, Any]:
    """Options in the types of the factory's parameters."""
    if signature is None:
        return dict(options)
    kinds = {name: parameter.annotation for name, parameter in signature.parameters.items()}
    return {name: convert(value, kinds.get(name, str), name) for name, value in options.items()}


def convert(text: str, kind: Any, name: str) -> Any:
    """An option's text as a value of a type; the text itself where the type is none that text can be read as.

    Example:
        >>> convert("20", float | None, "duration")
        20.0
        >>> convert("a;b", tuple[str, ...], "object")
        ('a', 'b')
    """
    if isinstance(kind, str):  # an annotation that was not evaluated
        kind = {"int": int, "float": float, "bool": bool}.get(kind, str)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        for one in typing.get_args(kind):
            if one is type(None):
                continue
            try:
                return convert(text, one, name)
            except ValueError as error:
                refused = error
        raise refused
    if typing.get_origin(kind) is tuple and typing.get_args(kind)[1:] == (...,):
        return tuple(convert(item, typing.get_args(kind)[0], name) for item in text.split(SEPARATOR))
    if typing.get_origin(kind) is typing.Literal:
        known = {str(value): value for value in typing.get_args(kind)}
        if text not in known:
            raise ValueError(f"{name}: expected one of {sorted(known)}, got {text!r}")
        return known[text]
    if kind is bool:
        if text.lower() not in BOOLEANS:
            raise ValueError(f"{name}: expected true or false, got {text!r}")
        return BOOLEANS[text.lower()]
    if kind in (int, float, Path):
        try:
            return kind(text)
        except ValueError:
            raise ValueError(f"{name}: expected a value of type {kind.__name__}, got {text!r}") from None
    return text
