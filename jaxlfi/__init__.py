"""Likelihood-free inference in JAX that notices when its prior's support is wrong, and moves it.

Names are loaded when they are first used, so that the command line answers at once.
"""

import importlib

__version__ = "0.1.0"

_HOMES = {
    "Belief": "jaxlfi.belief",
    "Centre": "jaxlfi.heuristics",
    "Choice": "jaxlfi.heuristics",
    "Edge": "jaxlfi.heuristics",
    "Estimator": "jaxlfi.estimator",
    "Fixed": "jaxlfi.heuristics",
    "GaussianMixture": "jaxlfi.mixture",
    "Heuristic": "jaxlfi.heuristics",
    "METHODS": "jaxlfi.presets",
    "Matched": "jaxlfi.heuristics",
    "Mode": "jaxlfi.heuristics",
    "PAPER": "jaxlfi.presets",
    "PRESETS": "jaxlfi.presets",
    "QUICK": "jaxlfi.presets",
    "Run": "jaxlfi.inference",
    "Settings": "jaxlfi.bayessim",
    "SimulatorError": "jaxlfi.observation",
    "Support": "jaxlfi.support",
    "SupportWarning": "jaxlfi.inference",
    "Task": "jaxlfi.task",
    "Truncate": "jaxlfi.heuristics",
    "hyperparameter": "jaxlfi.fields",
    "infer": "jaxlfi.inference",
    "option": "jaxlfi.fields",
    "stack": "jaxlfi.lanes",
    "with_tails": "jaxlfi.tailed",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str):
    """Load a public name from the module it lives in."""
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxlfi' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
