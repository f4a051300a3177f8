"""Flags of the command line and the glossary, made from what classes declare of their fields.

Values that are given are collected by name in one dictionary of the parsed arguments, so that a field that a package
adds cannot be taken for another argument.
"""

import argparse
import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

from jaxlfi.fields import Declared

Families = Mapping[str, Mapping[str, Declared]]
"""Fields by the name of the class that declares them, and by their own name."""
WIDTH = 120
"""Characters of a line of the glossary."""


def add(group: argparse._ArgumentGroup, families: Families, into: str, several: bool = False) -> None:
    """Add a flag for every field, one for all classes that have a field of that name.

    A flag that the parser has already, for something else, begins with `into` without its last letter:
    `--hyperparameter-steps`.

    Args:
        group: to add the flags to.
        families: classes and their fields.
        into: the argument that collects the values; make it an empty dictionary by `set_defaults`.
        several: whether a number can be given for each parameter of the task.
    """
    for name, owners in by_field(families).items():
        flag = f"--{name.replace('_', '-')}"
        if flag in group._option_string_actions:
            flag = f"--{into.removesuffix('s')}-{flag[2:]}"
        group.add_argument(
            flag,
            dest=name,
            action=_Collect,
            into=into,
            help=_help(owners),
            **_reading(next(iter(owners.values())), several),
        )


def by_field(families: Families) -> dict[str, dict[str, Declared]]:
    """The same fields by their own name, and by the name of the class."""
    found: dict[str, dict[str, Declared]] = {}
    for family, fields in families.items():
        for name, field in fields.items():
            found.setdefault(name, {})[family] = field
    return found


def glossary(families: Families) -> str:
    """A line for every field that has a symbol."""
    lines = [
        f"  {name:<15} {next(iter(owners.values())).info.symbol}, {_told(owners)}"
        for name, owners in by_field(families).items()
        if all(field.info.symbol for field in owners.values())
    ]
    return "".join(f"{textwrap.fill(line, WIDTH, subsequent_indent=' ' * 18)}\n" for line in lines)


class _Collect(argparse.Action):
    """Put the value into a dictionary of the arguments, under the field's name."""

    def __init__(self, *args: Any, into: str, **kwargs: Any):
        super().__init__(*args, default=argparse.SUPPRESS, **kwargs)
        self.into = into

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        collected = getattr(namespace, self.into, None) or {}
        setattr(namespace, self.into, collected | {self.dest: values})


def _reading(field: Declared, several: bool) -> dict[str, Any]:
    """How argparse reads a field's values: by the type of its default."""
    if not field.static:
        reading = {"type": int if type(field.default) is int and not several else float, "metavar": "X"}
        return reading | ({"nargs": "+"} if several else {})
    example = field.default[0] if isinstance(field.default, tuple) and field.default else field.default
    reading = {"type": _reader(example), "metavar": {bool: "yes|no", int: "N", float: "X"}.get(type(example), "NAME")}
    return reading | ({"nargs": "+"} if isinstance(field.default, tuple) else {})


def _reader(example: Any) -> Callable[[str], Any]:
    return _truth if isinstance(example, bool) else type(example) if isinstance(example, int | float) else str


def _truth(text: str) -> bool:
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"expected yes or no, got {text!r}")
    return text == "yes"


def _help(owners: Mapping[str, Declared]) -> str:
    """Whose field it is, what it is, its symbol, range and default."""
    some = next(iter(owners.values())).info
    facts = [some.symbol] if some.symbol else []
    ranges = dict.fromkeys(_range(field) for field in owners.values())
    facts += [word for word in ranges if word] if len(ranges) == 1 else []
    defaults = {family: _shown(field.default) for family, field in owners.items()}
    if len(set(defaults.values())) == 1:
        facts.append(f"default: {next(iter(defaults.values()))}")
    else:
        facts.append("default: " + ", ".join(f"{value} ({family})" for family, value in defaults.items()))
    return f"{_told(owners, always=True)} ({'; '.join(facts)})".replace("%", "%%")


def _told(owners: Mapping[str, Declared], always: bool = False) -> str:
    """The help texts, each after the classes that it is of; without these where there is one text, unless `always`."""
    texts: dict[str, list[str]] = {}
    for family, field in owners.items():
        texts.setdefault(field.info.help, []).append(family)
    if len(texts) == 1 and not always:
        return next(iter(texts))
    return "; ".join(f"{', '.join(own)}: {text}" for text, own in texts.items())


def _range(field: Declared) -> str:
    info = field.info
    if info.choices is not None:
        return ", ".join(map(str, info.choices))
    limited = [limit for limit in (info.low, info.high, info.above, info.below) if limit is not None]
    return info.interval if limited and not all(map(math.isinf, limited)) else ""


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_shown, value)) or "none"
    return (
        {True: "yes", False: "no"}[value]
        if isinstance(value, bool)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )
