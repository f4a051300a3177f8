"""Setting, listing, replacing and checking the hyperparameters of heuristics and of those they wrap."""

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np

from jaxlfi.fields import Declared, check_fields, declared
from jaxlfi.heuristics.base import Heuristic
from jaxlfi.registry import HEURISTICS


def build(kind: type[Heuristic], values: Mapping[str, Any], dim: int) -> Heuristic:
    """A heuristic with these hyperparameters, and its defaults for the others.

    Args:
        kind: class of the heuristic.
        values: hyperparameters by name, each one number or one per dimension.
        dim: number of parameters D.

    Raises:
        ValueError: for hyperparameters it does not have, or values it does not accept.

    Example:
        >>> from jaxlfi.heuristics import Edge
        >>> build(Edge, {"expansion": [0.1, 0.3], "tail": [0.5]}, dim=2).tail
        0.5
    """
    name, known = HEURISTICS.name_of(kind), declared(kind)
    refuse_foreign(values, {name: kind})
    made = {one: value if known[one].static else _leaf(one, value, dim) for one, value in values.items()}
    try:
        rule = kind(**made)
    except TypeError as error:
        raise ValueError(f"heuristic: {name!r} cannot be made of its hyperparameters: {error}") from error
    check(rule, dim)
    return rule


def _leaf(name: str, value: Any, dim: int) -> Any:
    numbers = np.atleast_1d(value).tolist()
    if len(numbers) not in (1, dim) or not np.isfinite(numbers).all():
        raise ValueError(f"{name}: expected one finite number or {dim}, got {numbers}")
    return numbers[0] if len(numbers) == 1 else np.asarray(numbers, np.float32)


def all_declared(rule: Heuristic | type[Heuristic]) -> dict[str, Declared]:
    """The declared fields of a heuristic and of the rules it wraps, by name.

    Example:
        >>> from jaxlfi.heuristics import Matched, Mode
        >>> all_declared(Matched(Mode()))["proximity"].default
        0.4
    """
    found = declared(rule)
    for inner in [] if isinstance(rule, type) else _wrapped(rule):
        found = found | {name: field for name, field in all_declared(inner).items() if name not in found}
    return found


def replaced(rule: Heuristic, values: Mapping[str, Any]) -> Heuristic:
    """The heuristic with these hyperparameters replaced, both its own and those of the rules it wraps.

    Raises:
        ValueError: for hyperparameters it does not have, or values it does not accept.

    Example:
        >>> from jaxlfi.heuristics import Matched, Mode
        >>> replaced(Matched(Mode()), {"proximity": 0.3}).rule.proximity
        0.3
    """
    if foreign := set(values) - set(all_declared(rule)):
        raise ValueError(
            f"{min(foreign)}: expected a hyperparameter of {HEURISTICS.name_of(type(rule))}, got one it does not have"
        )
    return _replaced(rule, values)


def check(rule: Any, dim: int) -> None:
    """Check a heuristic and its hyperparameters' shapes and ranges.

    Args:
        rule: heuristic to check; its leaves may be traced.
        dim: number of parameters D.

    Raises:
        ValueError: naming what was expected.
    """
    if not isinstance(rule, Heuristic):
        shown = f"the class {rule.__name__}" if inspect.isclass(rule) else " ".join(repr(rule).split())
        raise ValueError(f"heuristic: expected an instance such as jaxlfi.Edge(), got {shown}")
    for leaf in jax.tree.leaves(rule):
        if not isinstance(leaf, bool | int | float | np.generic | np.ndarray | jax.Array):
            raise ValueError(f"heuristic: expected hyperparameters that are numbers, got {leaf!r}")
        if np.shape(leaf) not in ((), (dim,)):
            raise ValueError(
                f"heuristic: expected hyperparameters that are scalars or {dim} values, got shape {np.shape(leaf)}"
            )
    _check_ranges(rule)


def refuse_foreign(given: Iterable[str], used: Mapping[str, type[Heuristic]]) -> None:
    """Refuse a hyperparameter that none of the heuristics in use has, as it would silently have no effect.

    Args:
        given: names of hyperparameters.
        used: heuristics by name.

    Raises:
        ValueError: naming the hyperparameter and the known ones.
    """
    known = sorted({name for kind in used.values() for name in declared(kind)})
    for name in given:
        if name not in known:
            raise ValueError(
                f"{name}: expected a hyperparameter of {' or '.join(sorted(used))} ({', '.join(known) or 'none'}), "
                "got one they do not have"
            )


def _check_ranges(rule: Heuristic) -> None:
    check_fields(rule)
    for inner in _wrapped(rule):
        _check_ranges(inner)


def _wrapped(rule: Heuristic) -> list[Heuristic]:
    """The rules contained in a heuristic's fields."""
    found: list[Heuristic] = []

    def note(inner: Heuristic) -> Heuristic:
        found.append(inner)
        return inner

    for field in dataclasses.fields(rule):
        _map_rules(note, getattr(rule, field.name))
    return found


def _replaced(rule: Heuristic, values: Mapping[str, Any]) -> Heuristic:
    changes = {name: value for name, value in values.items() if name in declared(rule)}
    for field in dataclasses.fields(rule):
        value = getattr(rule, field.name)
        nested = _map_rules(lambda inner: _replaced(inner, values), value)
        if nested is not value:
            changes[field.name] = nested
    return dataclasses.replace(rule, **changes)


def _map_rules(function: Callable[[Heuristic], Heuristic], value: Any) -> Any:
    """The value with each rule in it replaced; the same object if it holds none."""
    if isinstance(value, Heuristic):
        return function(value)
    if isinstance(value, tuple | list):
        parts = [_map_rules(function, part) for part in value]
        unchanged = all(new is old for new, old in zip(parts, value, strict=True))
        return value if unchanged else type(value)(parts)
    if isinstance(value, dict):
        named = {name: _map_rules(function, part) for name, part in value.items()}
        return value if all(named[name] is value[name] for name in value) else named
    return value
