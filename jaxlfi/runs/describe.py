"""Settings, heuristics and supports as plain JSON values, and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Estimator
from jaxlfi.heuristics import Heuristic
from jaxlfi.io.serialise import class_name, dataclass_of, fields_to_json, from_json, made_of, to_json
from jaxlfi.registry import ESTIMATORS, HEURISTICS, Classes


def settings_to_json(settings: Settings) -> dict[str, Any]:
    """All settings by name, with the estimator under its registered name."""
    return fields_to_json(settings, _name)


def settings_from_json(description: Mapping[str, Any]) -> Settings:
    """The settings that `settings_to_json` described.

    Raises:
        ValueError: for a description of anything else, of invalid values, or of an estimator that is not installed.
    """
    return made_of(Settings, "settings", _renamed(description), _loader(ESTIMATORS)).check()


def _renamed(description: Mapping[str, Any]) -> Mapping[str, Any]:
    """Settings of format version 2, in which a normaliser that fits its units had another name, with today's name."""
    estimator = description.get("estimator") if isinstance(description, Mapping) else None
    fields = estimator.get("hyperparameters") if isinstance(estimator, Mapping) else None
    if estimator is None or not isinstance(fields, Mapping) or fields.get("normaliser") != "fitted-asinh":
        return description
    fields = {**fields, "normaliser": "asinh"}
    return {**description, "estimator": {**estimator, "hyperparameters": fields}}


def heuristic_to_json(heuristic: Heuristic) -> dict[str, Any]:
    """A heuristic's name and hyperparameters; rules that it wraps are described in the same way.

    Example:
        >>> from jaxlfi.heuristics import Matched, Mode
        >>> heuristic_to_json(Matched(Mode()))["hyperparameters"]["rule"]["hyperparameters"]["proximity"]
        0.4
    """
    return to_json(heuristic, _name)


def heuristic_from_json(description: Mapping[str, Any]) -> Heuristic:
    """The heuristic that `heuristic_to_json` described.

    Raises:
        ValueError: for a description of anything else, or of a heuristic that is not installed.
    """
    heuristic = from_json(_without_factor(description), _loader(HEURISTICS))
    if not isinstance(heuristic, Heuristic):
        raise ValueError(f"heuristic: expected the description of one, got {description['name']!r}")
    return heuristic


def _without_factor(description: Any) -> Any:
    """Complete EDGE of earlier versions, also within other rules: its threshold did not depend on the posterior."""
    if isinstance(description, list):
        return [_without_factor(part) for part in description]
    if not isinstance(description, Mapping):
        return description
    found = {name: _without_factor(part) for name, part in description.items()}
    if found.get("name") == "edge" and isinstance(found.get("hyperparameters"), Mapping):
        found["hyperparameters"] = {"uninformed_factor": 1.0, **found["hyperparameters"]}
    return found


def support_to_json(support: Support) -> dict[str, list[float]]:
    """A box's bounds, in inference space."""
    return {"low": np.asarray(support.low).tolist(), "high": np.asarray(support.high).tolist()}


def support_from_json(description: Mapping[str, list[float]]) -> Support:
    """The box that `support_to_json` described."""
    return Support(list(description["low"]), list(description["high"]))


def _name(value: Any) -> str:
    for family in (HEURISTICS, ESTIMATORS):
        if isinstance(value, family.kind):
            return family.name_of(type(value))
    return class_name(value)


def _loader(family: Classes):
    """A loader of classes by registered name, or by "module:Class" for those that a registered class holds."""

    def load(name: str) -> type:
        if ":" not in name:
            return family.load(name)
        kind = dataclass_of(name)
        if not issubclass(kind, Heuristic | Estimator | Support):
            raise ValueError(f"description: expected a heuristic, an estimator or a support, got {name!r}")
        return kind

    return load
