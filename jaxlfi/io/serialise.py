"""Settings, heuristics and supports as plain JSON values, and back."""

import dataclasses
import math
from typing import Any

import numpy as np

from jaxlfi.bayessim.algorithm import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.estimator import Estimator
from jaxlfi.heuristics import HEURISTICS, Heuristic, Matched


def settings_to_json(settings: Settings) -> dict[str, Any]:
    """All settings by name, the estimator's in a dictionary of their own."""
    plain = {field.name: plain_value(getattr(settings, field.name)) for field in _other_fields(settings)}
    estimator = {f.name: plain_value(getattr(settings.estimator, f.name)) for f in dataclasses.fields(Estimator)}
    return plain | {"estimator": estimator}


def settings_from_json(description: dict[str, Any]) -> Settings:
    """The settings that `settings_to_json` described."""
    estimator = {name: _restored(value) for name, value in description["estimator"].items()}
    others = {name: value for name, value in description.items() if name != "estimator"}
    return Settings(estimator=Estimator(**estimator), **others)


def heuristic_to_json(heuristic: Heuristic) -> dict[str, Any]:
    """A heuristic's name and hyperparameters; `matched` where its components are paired first.

    A reader's own heuristic goes by the name of its class.
    """
    matched = isinstance(heuristic, Matched)
    rule = heuristic.rule if matched else heuristic
    known = {kind: name for name, kind in HEURISTICS.items()}
    values = {f.name: plain_value(getattr(rule, f.name)) for f in dataclasses.fields(rule)}
    return {"name": known.get(type(rule), type(rule).__name__), "matched": matched, "hyperparameters": values}


def heuristic_from_json(description: dict[str, Any]) -> Heuristic:
    """The heuristic that `heuristic_to_json` described."""
    if description["name"] not in HEURISTICS:
        raise ValueError(f"heuristic: expected one of {sorted(HEURISTICS)}, got {description['name']!r}")
    rule = HEURISTICS[description["name"]](**{k: _restored(v) for k, v in description["hyperparameters"].items()})
    return Matched(rule) if description["matched"] else rule


def support_to_json(support: Support) -> dict[str, list[float]]:
    """A box's bounds."""
    return {"low": np.asarray(support.low).tolist(), "high": np.asarray(support.high).tolist()}


def support_from_json(description: dict[str, list[float]]) -> Support:
    """The box that `support_to_json` described."""
    return Support(description["low"], description["high"])


def plain_value(value: Any) -> Any:
    """Numbers, strings and lists; numbers that JSON does not know are written as words."""
    if isinstance(value, str | bool | int | None):
        return value
    if isinstance(value, tuple | list):
        return [plain_value(item) for item in value]
    array = np.asarray(value)
    if array.ndim:
        return [plain_value(item) for item in array.tolist()]
    number = array.item()
    return number if isinstance(number, int) or math.isfinite(number) else str(number)


def json_safe(value: Any) -> Any:
    """The same nested value with null for numbers that are not finite, as JSON has no NaN."""
    if isinstance(value, dict):
        return {name: json_safe(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _restored(value: Any) -> Any:
    """A value as a constructor takes it: tuples of integers (layers), vectors, and infinity from its word."""
    if isinstance(value, list):
        return tuple(value) if all(isinstance(item, int) for item in value) else np.asarray(value, np.float32)
    return float(value) if value in ("inf", "-inf", "nan") else value


def _other_fields(settings: Settings) -> list[dataclasses.Field]:
    return [field for field in dataclasses.fields(settings) if field.name != "estimator"]
