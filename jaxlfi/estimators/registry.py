"""Estimators by name, from installed packages or `module:Class`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxlfi import plugins
from jaxlfi.estimators.base import Estimator
from jaxlfi.fields import declared

GROUP = "jaxlfi.estimators"
"""The entry-point group; ours are registered in pyproject.toml as a third party's would be."""


def load(reference: str) -> type[Estimator]:
    """The class of a registered name, or of "module:Class".

    Raises:
        ValueError: for unknown names, modules that cannot be imported and classes that are no estimators.

    Example:
        >>> load("jaxlfi.estimators.mixture_network:MixtureNetwork").__name__
        'MixtureNetwork'
    """
    return plugins.load(GROUP, "estimator", reference, Estimator)


def name_of(estimator: Estimator) -> str:
    """The registered name of an estimator, or else "module:Class"."""
    return plugins.name_of(GROUP, type(estimator))


def converted(estimator: Estimator, kind: type[Estimator], values: Mapping[str, Any]) -> Estimator:
    """An estimator of another family, with the settings that both have, and some of them replaced.

    Args:
        estimator: whose settings are kept.
        kind: the family.
        values: settings to replace, by name.

    Raises:
        ValueError: for settings the family does not have or does not accept.

    Example:
        >>> from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
        >>> converted(SplineFlow(transforms=3, bins=8), MaskedFlow, {"epochs": 10}).transforms
        3
    """
    known = declared(kind)
    if foreign := sorted(set(values) - set(known)):
        raise ValueError(
            f"{foreign[0]}: expected a setting of {kind.__name__} ({', '.join(known)}), got one it does not have"
        )
    if isinstance(estimator, kind) and type(estimator) is kind:
        return dataclasses.replace(estimator, **values)
    shared = {name: getattr(estimator, name) for name in declared(estimator) if name in known}
    return kind(**(shared | dict(values)))
