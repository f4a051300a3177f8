"""Classes that packages add by name: entry points of installed packages, or `module:Class`.

Nothing is imported before it is loaded: the command line lists names without waiting for jax.
"""

import importlib
import inspect
import os
import sys
from importlib.metadata import EntryPoint, entry_points


def points(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name, sorted.

    Raises:
        ValueError: where two packages register different classes by one name.
    """
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda point: point.name):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise ValueError(f"{group}: expected one {point.name!r}, got {other.value} and {point.value}")
    return found


def names(group: str) -> list[str]:
    """Names of all registered classes of a group."""
    return list(points(group))


def load(group: str, word: str, reference: str, base: type) -> type:
    """The class of that name.

    Args:
        group: of entry points.
        word: what the class is, for errors.
        reference: a registered name, or "module:Class" in a module that can be imported from the current folder.
        base: what it must derive from.

    Raises:
        ValueError: for unknown names, modules that cannot be imported, and objects that are no such classes.
    """
    if ":" in reference:
        kind = _loaded(word, reference, reference)
    else:
        registered = points(group)
        if reference not in registered:
            raise ValueError(f"{word}: expected one of {list(registered)} or module:Class, got {reference!r}")
        kind = _loaded(word, reference, registered[reference].value)
    if not (isinstance(kind, type) and issubclass(kind, base)) or inspect.isabstract(kind):
        wanted = f"a class derived from {base.__name__} with all its methods"
        raise ValueError(f"{word}: expected {reference!r} to be {wanted}, got {' '.join(repr(kind).split())}")
    return kind


def named(word: str, reference: str) -> object:
    """What "module:Class" refers to, in a module that can be imported from the current folder.

    Raises:
        ValueError: if it cannot be imported or has no such attribute.
    """
    return _loaded(word, reference, reference)


def name_of(group: str, kind: type) -> str:
    """The registered name of a class, or else "module:Class"; `load` leads back.

    Example:
        >>> name_of("jaxlfi.none", dict)
        'builtins:dict'
    """
    own = f"{kind.__module__}:{kind.__qualname__}"
    for name, point in points(group).items():
        # A name may lead through a package that imports the class: where there is the class, that is imported too.
        module = sys.modules.get(point.module)
        if point.value == own or (module is not None and getattr(module, point.attr, None) is kind):
            return name
    return own


def look_here() -> None:
    """Let modules be found in the current folder, as `python -m` does."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())


def _loaded(word: str, reference: str, value: str) -> object:
    module, _, attribute = value.partition(":")
    look_here()
    # A third party's module may raise anything while it is imported.
    try:
        found = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except Exception as error:
        origin = "" if value == reference else f" ({value})"
        text = " ".join(str(error).split())
        raise ValueError(f"{word}: cannot load {reference!r}{origin}: {type(error).__name__}: {text}") from error
    return found
