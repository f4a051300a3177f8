"""Finding tasks by name: entry points of installed packages, or `module:factory`, with options for the factory."""

import importlib
import inspect
import os
import sys
from importlib.metadata import entry_points

from jaxlfi.task import Task

GROUP = "jaxlfi.tasks"
"""The entry-point group; packages add tasks by `[project.entry-points."jaxlfi.tasks"]` in pyproject.toml."""


def names() -> list[str]:
    """Names of all registered tasks."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def load(reference: str) -> Task:
    """The task of that name.

    Args:
        reference: a registered name, or "module:factory" for a callable that returns a `Task` (or a `Task`
            itself) in a module that can be imported from the current folder; then the factory's options, if any,
            as in "whip,object=dlo-0,detector=clean".

    Raises:
        ValueError: for unknown names, modules that cannot be imported, options that the factory does not have, and
            things that are no tasks.

    Example:
        >>> load("jaxlfi.envs.gaussian_linear:task").name
        'gaussian_linear'
    """
    name, options = parse(reference)
    made = _made(reference, _factory(name), options)
    if not isinstance(made, Task):
        raise ValueError(f"task: expected {reference!r} to give a jaxlfi.Task, got {type(made).__name__}")
    return made


def parse(reference: str) -> tuple[str, dict[str, str]]:
    """The name and the options of a reference.

    Example:
        >>> parse("whip,object=dlo-0")
        ('whip', {'object': 'dlo-0'})
    """
    name, *parts = reference.split(",")
    options = dict(part.partition("=")[::2] for part in parts)
    if len(options) < len(parts) or not all(key.isidentifier() and value for key, value in options.items()):
        raise ValueError(f"task: expected options as NAME,key=value,key=value, each key once, got {reference!r}")
    return name, options


def _factory(reference: str):
    """What a reference points to: a `Task` or something that makes one."""
    if ":" in reference:
        module_name, _, attribute = reference.partition(":")
        if os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())
        # A third party's module may raise anything while it is imported.
        try:
            return getattr(importlib.import_module(module_name), attribute)
        except Exception as error:
            raise ValueError(f"task: cannot load {reference!r}: {type(error).__name__}: {error}") from error
    points = {point.name: point for point in entry_points(group=GROUP)}
    if reference not in points:
        raise ValueError(f"task: expected one of {sorted(points)} or module:factory, got {reference!r}")
    try:
        return points[reference].load()
    except Exception as error:
        raise ValueError(
            f"task: cannot load {reference!r} ({points[reference].value}): {type(error).__name__}: {error}"
        ) from error


def _made(reference: str, factory, options: dict[str, str]) -> object:
    """Call a factory."""
    if isinstance(factory, Task) or not callable(factory):
        if options:
            raise ValueError(f"task: expected no options of {reference!r}, which is not made by a function")
        return factory
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # not every callable tells
        signature = None
    if signature is not None:
        try:
            signature.bind(**options)
        except TypeError as error:
            known = ", ".join(signature.parameters) or "none"
            raise ValueError(f"task: expected options among {known}, got {reference!r}: {error}") from error
    try:
        return factory(**options)
    except Exception as error:
        raise ValueError(f"task: {reference!r} failed: {type(error).__name__}: {error}") from error
