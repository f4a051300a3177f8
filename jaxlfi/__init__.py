"""Likelihood-free inference in JAX that notices when its prior's support is wrong, and moves it.

Names are loaded when they are first used, so that the command line answers at once.
"""

import importlib

__version__ = "0.1.0"

_HOMES = {
    "Belief": "jaxlfi.distributions.belief",
    "Centre": "jaxlfi.heuristics",
    "Choice": "jaxlfi.heuristics",
    "Edge": "jaxlfi.heuristics",
    "Estimator": "jaxlfi.estimators.estimator",
    "Fixed": "jaxlfi.heuristics",
    "GaussianMixture": "jaxlfi.distributions.mixture",
    "METHODS": "jaxlfi.bayessim.presets",
    "Matched": "jaxlfi.heuristics",
    "Mode": "jaxlfi.heuristics",
    "PAPER": "jaxlfi.bayessim.presets",
    "PRESETS": "jaxlfi.bayessim.presets",
    "QUICK": "jaxlfi.bayessim.presets",
    "Run": "jaxlfi.runs.inference",
    "Settings": "jaxlfi.bayessim.algorithm",
    "SimulatorError": "jaxlfi.tasks.observation",
    "Support": "jaxlfi.distributions.support",
    "SupportWarning": "jaxlfi.runs.inference",
    "Task": "jaxlfi.tasks.task",
    "Truncate": "jaxlfi.heuristics",
    "infer": "jaxlfi.runs.inference",
    "stack": "jaxlfi.bayessim.batch",
    "with_tails": "jaxlfi.tasks.priors",
}

_MODULES = ("plot",)
"""Modules that are found as `jaxlfi.NAME` without an import of their own."""

__all__ = sorted(_HOMES)


def __getattr__(name: str):
    """Load a public name from the module it lives in."""
    if name in _MODULES:
        return importlib.import_module(f"jaxlfi.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxlfi' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})
