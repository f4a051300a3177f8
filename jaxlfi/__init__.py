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
    "Estimator": "jaxlfi.estimators.base",
    "ExecutorError": "jaxlfi.tasks.errors",
    "Fixed": "jaxlfi.heuristics",
    "GaussianMixture": "jaxlfi.distributions.mixture",
    "Heuristic": "jaxlfi.heuristics",
    "HostSimulator": "jaxlfi.tasks.host",
    "METHODS": "jaxlfi.bayessim.presets",
    "MaskedFlow": "jaxlfi.estimators.flow_estimators",
    "Matched": "jaxlfi.heuristics",
    "MisspecificationWarning": "jaxlfi.runs.run",
    "MixtureLikelihood": "jaxlfi.estimators.likelihood_estimators",
    "MixtureNetwork": "jaxlfi.estimators.mixture_network",
    "Mode": "jaxlfi.heuristics",
    "PAPER": "jaxlfi.bayessim.presets",
    "PRESETS": "jaxlfi.bayessim.presets",
    "Posterior": "jaxlfi.estimators.posterior",
    "QUICK": "jaxlfi.bayessim.presets",
    "Run": "jaxlfi.runs.run",
    "Settings": "jaxlfi.bayessim.settings",
    "SimulatorError": "jaxlfi.tasks.errors",
    "SimulatorWarning": "jaxlfi.tasks.errors",
    "SplineFlow": "jaxlfi.estimators.flow_estimators",
    "Support": "jaxlfi.distributions.support",
    "SupportWarning": "jaxlfi.runs.run",
    "Task": "jaxlfi.tasks.task",
    "Truncate": "jaxlfi.heuristics",
    "hyperparameter": "jaxlfi.fields",
    "infer": "jaxlfi.runs.infer",
    "load": "jaxlfi.runs.load",
    "option": "jaxlfi.fields",
    "repeated": "jaxlfi.tasks.trials",
    "with_gaps": "jaxlfi.tasks.gaps",
    "settings_for": "jaxlfi.bayessim.presets",
    "stack": "jaxlfi.bayessim.batch",
    "with_tails": "jaxlfi.tasks.tailed_uniform",
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
