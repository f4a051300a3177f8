"""References as text: a name and options of its factory, as in "whip,object=dlo-0".

Options are converted to the types that a signature declares: int, float, bool, str, Path, Literal, unions of them, and
tuples of any length of one of them, with items separated by ";". In a quoted value, separators are part of the value
and "" stands for a quotation mark. A path with separators needs no quotation marks if it exists, or if the text after
each of its commas does not look like an option.
"""

import inspect
import itertools
import os
import re
import types
import typing
from pathlib import Path
from typing import Any

SEPARATOR = ";"
"""Separator between the items of a tuple."""
BOOLEANS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
"""Values of an option of type bool."""
_QUOTED = r'(?<![^,=;])"(?:[^"]|"")*"(?![^,;])'
"""A value in quotation marks, from one separator to the next."""


def parse(reference: str, word: str = "task") -> tuple[str, dict[str, str]]:
    """The name and the options of a reference.

    Args:
        reference: text to parse.
        word: kind of object that it names, for errors.

    Raises:
        ValueError: for options that are malformed or given twice.

    Example:
        >>> parse("whip,object=dlo-0")
        ('whip', {'object': 'dlo-0'})
    """
    if not isinstance(reference, str):
        raise ValueError(f"{word}: expected a name, got {reference!r}")
    name, *parts = _split(reference, ",")
    options: dict[str, str] = {}
    while parts:
        # A value may be a path with commas: it takes all parts that together name a file, or do not begin an option.
        key, _, first = parts[0].partition("=")
        values = [first, *parts[1:]]
        whole = _length_of_path(values, ",")
        while whole < len(values) and not _begins_option(values[whole]):
            whole += 1
        if not (key.isidentifier() and first) or key in options:
            raise ValueError(f"{word}: expected options as NAME,key=value,key=value, each key once, got {reference!r}")
        options[key], parts = ",".join(values[:whole]), parts[whole:]
    return name, options


def with_option(reference: str, name: str, *values: str) -> str:
    """A reference with one more option, whose values are quoted if necessary.

    Example:
        >>> with_option("whip", "object", "monday,rope.npz", "dlo-0")
        'whip,object="monday,rope.npz";dlo-0'
        >>> convert(parse(with_option("whip", "object", "a;b", "c"))[1]["object"], tuple[str, ...], "object")
        ('a;b', 'c')
    """
    return f"{reference},{name}={SEPARATOR.join(map(_quoted, values))}"


def _begins_option(part: str) -> bool:
    return part.partition("=")[0].strip().isidentifier()


def _length_of_path(parts: list[str], separator: str) -> int:
    """Largest number of leading parts that together name an existing file; 1 if none do."""
    return next((n for n in range(len(parts), 1, -1) if os.path.lexists(separator.join(parts[:n]))), 1)


def _split(text: str, separator: str) -> list[str]:
    """The parts of a text between separators, except separators in quotation marks."""
    at = [match.start() for match in re.finditer(f"{_QUOTED}|{separator}", text) if match[0] == separator]
    return [text[start + 1 : stop] for start, stop in itertools.pairwise([-1, *at, len(text)])]


def _quoted(value: str) -> str:
    plain = not re.search(f'[,{SEPARATOR}]|^"', value)
    return value if plain else '"' + value.replace('"', '""') + '"'


def _unquoted(text: str) -> str:
    return text[1:-1].replace('""', '"') if re.fullmatch(_QUOTED, text) else text


def _items(text: str) -> list[str]:
    """The items of a value, some of which may be paths with separators."""
    parts, items = _split(text, SEPARATOR), []
    while parts:
        whole = _length_of_path(parts, SEPARATOR)
        items.append(_unquoted(SEPARATOR.join(parts[:whole])))
        parts = parts[whole:]
    return items


def converted(signature: inspect.Signature | None, options: dict[str, str]) -> dict[str, Any]:
    """Options converted to the types of a signature's parameters; left as text if there is no signature."""
    if signature is None:
        return {name: _unquoted(value) for name, value in options.items()}
    kinds = {name: parameter.annotation for name, parameter in signature.parameters.items()}
    return {name: convert(value, kinds.get(name, str), name) for name, value in options.items()}


def convert(text: str, kind: Any, name: str) -> Any:
    """An option's text converted to a type; the text itself if the type is not supported.

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
        return tuple(convert(item, typing.get_args(kind)[0], name) for item in _items(text))
    text = _unquoted(text)
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
