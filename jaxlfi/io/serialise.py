"""Dataclasses as plain JSON values, and back."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxlfi import registry

NameOf = Callable[[Any], str]
Load = Callable[[str], type]


def to_json(value: Any, name_of: NameOf) -> dict[str, Any]:
    """A dataclass as its name and the values of its fields; dataclasses among them are written in the same way.

    Tuples and lists become lists; an array keeps its type, {"array": [...], "dtype": "float32"}, unless it is a single
    number; numbers that JSON does not have are written as {"float": "inf"}.

    Args:
        value: an instance of a dataclass.
        name_of: function that gives the name of an instance's class, registered or "module:Class".

    Raises:
        ValueError: for a field that holds anything else, such as a function.

    Example:
        >>> from jaxlfi.distributions.support import Support
        >>> to_json(Support([0.0], [1.0]), class_name)["hyperparameters"]["low"]
        {'array': [0.0], 'dtype': 'float32'}
    """
    return {"name": name_of(value), "hyperparameters": fields_to_json(value, name_of)}


def from_json(description: Mapping[str, Any], load: Load) -> Any:
    """The instance that `to_json` described.

    Args:
        description: result of `to_json`.
        load: function that gives the class of a name; it raises ValueError if there is none.

    Raises:
        ValueError: for anything that is not a description, or not one of this class.
    """
    named = isinstance(description, Mapping) and set(description) == {"name", "hyperparameters"}
    if not named or not isinstance(description["name"], str):
        raise ValueError(f"expected a description by name and hyperparameters, got {description!r}")
    return made_of(load(description["name"]), description["name"], description["hyperparameters"], load)


def fields_to_json(value: Any, name_of: NameOf) -> dict[str, Any]:
    """The fields of a dataclass by name."""
    described = {}
    for field in dataclasses.fields(value):
        try:
            described[field.name] = _encoded(getattr(value, field.name), name_of)
        except TypeError as error:
            raise ValueError(f"{field.name}: expected a value that can be written as JSON, got {error}") from error
    return described


def class_name(value: Any) -> str:
    """The class of an instance as "module:Class", for those that are not registered."""
    return f"{type(value).__module__}:{type(value).__qualname__}"


def dataclass_of(reference: str) -> type:
    """The dataclass of "module:Class".

    Raises:
        ValueError: if there is none.
    """
    kind = registry.named("description", reference)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"description: expected {reference!r} to be a dataclass, got {kind!r}")
    return kind


def plain_value(value: Any) -> Any:
    """A number, a string, or a list of them, as JSON values."""
    return _encoded(value, class_name)


def json_safe(value: Any) -> Any:
    """The same nested value with null for numbers that are not finite, as JSON has no NaN."""
    if isinstance(value, dict):
        return {name: json_safe(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def made_of(kind: type, name: str, values: Any, load: Load) -> Any:
    """A dataclass made from the fields that `fields_to_json` wrote."""
    known = {field.name for field in dataclasses.fields(kind)}
    if not isinstance(values, Mapping) or not set(values) <= known:
        raise ValueError(f"{name}: expected values of {', '.join(sorted(known)) or 'nothing'}, got {values!r}")
    try:
        return kind(**{field: _decoded(value, load) for field, value in values.items()})
    except TypeError as error:
        raise ValueError(f"{name}: expected the description of one, got another: {error}") from error


def _encoded(value: Any, name_of: NameOf) -> Any:
    if isinstance(value, str | bool | int | None):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": str(value)}
    if isinstance(value, tuple | list):
        return [_encoded(item, name_of) for item in value]
    if isinstance(value, Mapping):
        return {"mapping": [[_encoded(name, name_of), _encoded(item, name_of)] for name, item in value.items()]}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_json(value, name_of)
    if not hasattr(value, "dtype"):
        raise TypeError(f"a {type(value).__name__}")
    array = np.asarray(value)
    if array.dtype == object:
        raise TypeError(f"a {type(value).__name__}")
    numbers = array.tolist()
    if array.ndim == 0:
        return _encoded(numbers, name_of)
    return {"array": _encoded(numbers, name_of), "dtype": array.dtype.name}


def _decoded(value: Any, load: Load) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(item, load) for item in value)
    if not isinstance(value, dict):
        return value
    if set(value) == {"float"}:
        return float(value["float"])
    if set(value) == {"mapping"}:
        return {_decoded(name, load): _decoded(item, load) for name, item in value["mapping"]}
    if set(value) == {"array", "dtype"}:
        return np.array(_decoded(value["array"], load), value["dtype"])
    return from_json(value, load)
