"""What packages add by name: entry points of installed packages, or `module:name`.

Nothing is imported before it is loaded: the command line lists names without waiting for jax. Where two packages
register one name, using that name is an error, and nothing else is.
"""

import importlib
import inspect
import os
import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def points(group: str) -> dict[str, list[EntryPoint]]:
    """The entry points of a group by name, sorted: one each, or several that lead to different objects."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for point in sorted(entry_points(group=group), key=lambda point: (point.name, point.value)):
        found.setdefault(point.name, {}).setdefault(point.value, point)
    return {name: list(by_value.values()) for name, by_value in found.items()}


def names(group: str) -> list[str]:
    """All registered names of a group."""
    return list(points(group))


def package_of(point: EntryPoint) -> str:
    """The name of the package that registers an entry point."""
    return point.dist.name if point.dist is not None else point.value.partition(":")[0].partition(".")[0]


def place_of(point: EntryPoint) -> tuple[str, str]:
    """The module and the attribute that an entry point leads to; empty where it is not written as one."""
    match = EntryPoint.pattern.match(point.value)
    return (match["module"], match["attr"] or "") if match else ("", "")


def find(group: str, word: str, reference: str, own: str = "module:factory") -> Any:
    """The object of that name, imported.

    Args:
        group: of entry points.
        word: what the object is, for errors.
        reference: a registered name, or "module:name" in a module that can be imported from the current folder.
        own: how a reference to the user's own is written, for errors.

    Raises:
        ValueError: for unknown names, those that several packages register, and modules that cannot be imported.
    """
    if ":" in reference:
        return named(word, reference)
    registered = points(group)
    if reference not in registered:
        raise ValueError(f"{word}: expected one of {list(registered)} or {own}, got {reference!r}")
    point, *others = registered[reference]
    if others:
        packages = [f"{package_of(each)} ({each.value})" for each in (point, *others)]
        refuse_clash(word, reference, packages, f": name the one that is meant as {own}")
    return _loaded(word, f"{reference!r} ({point.value})", *place_of(point))


def refuse_clash(word: str, name: str, packages: list[str], advice: str = "") -> None:
    """Refuse a name that several packages register.

    Raises:
        ValueError: naming them.
    """
    raise ValueError(f"{word}: expected one package that registers {name!r}, got {' and '.join(packages)}{advice}")


def load(group: str, word: str, reference: str, base: type) -> type:
    """The class of that name, as of `find`.

    Args:
        group: of entry points.
        word: what the class is, for errors.
        reference: a registered name, or "module:Class".
        base: what it must derive from.

    Raises:
        ValueError: as of `find`, and for objects that are no such classes.
    """
    kind = find(group, word, reference, "module:Class")
    if not (isinstance(kind, type) and issubclass(kind, base)) or inspect.isabstract(kind):
        wanted = f"a class derived from {base.__name__} with all its methods"
        raise ValueError(f"{word}: expected {reference!r} to be {wanted}, got {' '.join(repr(kind).split())}")
    return kind


def named(word: str, reference: str) -> Any:
    """What "module:name" refers to, in a module that can be imported from the current folder.

    Raises:
        ValueError: if it cannot be imported or has no such attribute.
    """
    module, _, attribute = reference.partition(":")
    if module.endswith(".py"):
        raise ValueError(
            f"{word}: expected module:name, got {reference!r}: leave out '.py' and run from the file's folder"
        )
    return _loaded(word, repr(reference), module, attribute)


def name_of(group: str, kind: type) -> str:
    """The registered name of a class, or else "module:Class"; `load` leads back.

    Example:
        >>> name_of("jaxlfi.none", dict)
        'builtins:dict'
    """
    own = f"{kind.__module__}:{kind.__qualname__}"
    for name, (point, *others) in points(group).items():
        # A name may lead through a package that imports the class: where there is the class, that is imported too.
        module, attribute = place_of(point)
        there = module in sys.modules and getattr(sys.modules[module], attribute, None) is kind
        if not others and (point.value == own or there):
            return name
    return own


def look_here() -> None:
    """Let modules be found in the current folder, as `python -m` does."""
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())


def _loaded(word: str, shown: str, module: str, attribute: str) -> Any:
    look_here()
    # A third party's module may raise anything while it is imported.
    try:
        found = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except Exception as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{word}: cannot load {shown}: {type(error).__name__}: {text}") from error
    return found
