"""Command-line flags and the glossary, generated from the fields that classes declare.

The given values are collected by name in one dictionary of the parsed arguments, so that a field added by a package
cannot be confused with another argument.
"""

import argparse
import math
import os
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxlfi.fields import Declared, check_value

Families = Mapping[str, Mapping[str, Declared]]
"""Fields by the name of the class that declares them, then by their own name."""
WIDTH = 120
"""Width of the glossary in characters."""


def add(
    group: argparse._ArgumentGroup,
    families: Families,
    into: str,
    several: bool = False,
    presets: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Add a flag for every field name, shared by all classes that have a field of that name.

    If the parser already has a flag of that name, the new one is prefixed with the singular of `into`:
    `--hyperparameter-steps`.

    Args:
        group: argument group to add the flags to.
        families: classes and their fields.
        into: name of the argument that collects the values; initialise it to an empty dictionary with `set_defaults`.
        several: whether one number can be given for each parameter of the task.
        presets: defaults of the command line by preset and field; None for the fields' own defaults.
    """
    for name, owners in by_field(families).items():
        flag = f"--{name.replace('_', '-')}"
        if flag in group._option_string_actions:
            flag = f"--{into.removesuffix('s')}-{flag[2:]}"
        some = next(iter(owners.values()))
        if some.static and isinstance(some.default, bool):
            reading = {"action": _Switch, "no": f"--no-{flag[2:]}"}
            names = (flag, f"--no-{flag[2:]}")
        else:
            reading, names = {"action": _Collect} | _reading(some, several), (flag,)
        group.add_argument(*names, dest=name, into=into, owners=owners, help=_help(name, owners, presets), **reading)


def seed(text: str) -> int:
    """A seed's value, from 0 to 2^63 - 1.

    Raises:
        ArgumentTypeError: for any other text.
    """
    try:
        number = int(text)
    except ValueError:
        number = -1
    if not 0 <= number < 2**63:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 2^63 - 1, got {textwrap.shorten(text, 40)!r}")
    return number


def output(text: str) -> Path:
    """The path of results. `..` is resolved, so that folders that the path only passes through are not created."""
    return Path(os.path.relpath(os.path.realpath(text))) if ".." in Path(text).parts else Path(text)


def by_field(families: Families) -> dict[str, dict[str, Declared]]:
    """The same fields by their own name, then by the name of the class."""
    found: dict[str, dict[str, Declared]] = {}
    for family, fields in families.items():
        for name, field in fields.items():
            found.setdefault(name, {})[family] = field
    return found


def glossary(families: Families) -> str:
    """One entry for every field that has a symbol."""
    lines = [
        f"  {name:<15} {next(iter(owners.values())).info.symbol}, {_described(owners)}"
        for name, owners in by_field(families).items()
        if all(field.info.symbol for field in owners.values())
    ]
    return "".join(f"{textwrap.fill(line, WIDTH, subsequent_indent=' ' * 18)}\n" for line in lines)


class _Collect(argparse.Action):
    """Put the value into a dictionary of the arguments, under the field's name.

    A value that no class with such a field accepts raises a ValueError at once, before jax starts.
    """

    def __init__(
        self,
        *args: Any,
        into: str,
        owners: Mapping[str, Declared],
        kind: Callable[[Any], Any] = lambda values: values,
        **kwargs: Any,
    ):
        super().__init__(*args, default=argparse.SUPPRESS, **kwargs)
        self.into, self.owners, self.kind = into, owners, kind

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        collected, value = getattr(namespace, self.into, None) or {}, self.kind(values)
        _require(self.owners, value)
        setattr(namespace, self.into, collected | {self.dest: value})


class _Switch(_Collect):
    """Collect True for a flag, and False for the one that begins with "no"."""

    def __init__(self, *args: Any, no: str, **kwargs: Any):
        super().__init__(*args, nargs=0, **kwargs)
        self.no = no

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        super().__call__(parser, namespace, option_string != self.no)


def _require(owners: Mapping[str, Declared], value: Any) -> None:
    """Refuse a value, or one of several numbers, that no class with such a field accepts.

    Raises:
        ValueError: with the message of the first of these classes.
    """
    for one in value if isinstance(value, list) else [value]:
        errors = []
        for field in owners.values():
            try:
                check_value(field, one)
            except ValueError as error:
                errors.append(error)
        if len(errors) == len(owners):
            raise errors[0]


def _reading(field: Declared, several: bool) -> dict[str, Any]:
    """How argparse reads a field's values, from the type of its default."""
    if not field.static:
        reading = {"type": int if type(field.default) is int and not several else float, "metavar": "X"}
        return reading | ({"nargs": "+"} if several else {})
    example = field.default[0] if isinstance(field.default, tuple) and field.default else field.default
    reading = {"type": _reader(example), "metavar": {bool: "yes|no", int: "N", float: "X"}.get(type(example), "NAME")}
    return reading | ({"nargs": "+", "kind": tuple} if isinstance(field.default, tuple) else {})


def _reader(example: Any) -> Callable[[str], Any]:
    return _truth if isinstance(example, bool) else type(example) if isinstance(example, int | float) else str


def _truth(text: str) -> bool:
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"expected yes or no, got {text!r}")
    return text == "yes"


def _help(name: str, owners: Mapping[str, Declared], presets: Mapping[str, Mapping[str, Any]] | None) -> str:
    """The classes that have the field, its description, symbol, range and default."""
    some = next(iter(owners.values())).info
    facts = [some.symbol] if some.symbol else []
    ranges = dict.fromkeys(_range(field) for field in owners.values())
    facts += [word for word in ranges if word] if len(ranges) == 1 else []
    if presets is None:
        defaults = {family: _shown(field.default) for family, field in owners.items()}
    else:
        defaults = {preset: _shown(values[name]) for preset, values in presets.items() if name in values}
    if len(set(defaults.values())) == 1:
        facts.append(f"default: {next(iter(defaults.values()))}")
    elif defaults:
        facts.append("default: " + ", ".join(f"{value} ({family})" for family, value in defaults.items()))
    text = _described(owners, always=presets is None)
    return (f"{text} ({'; '.join(facts)})" if facts else text).replace("%", "%%")


def _described(owners: Mapping[str, Declared], always: bool = False) -> str:
    """The help texts, each after the names of its classes; a single text has no names, unless `always`."""
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
