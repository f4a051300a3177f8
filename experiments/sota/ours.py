"""Our methods with their defaults, one inference at a time, as one compiled program."""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments.ablation import PAPER_EDGE
from experiments.sota.cases import Case
from experiments.sota.measures import DRAWS, Found, points
from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.batch import posterior_after
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.presets import METHODS, QUICK, all_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Fixed
from jaxlfi.tasks.task import Task

PRESET = all_rounds(QUICK).replace(predictive=False)
"""The preset, with the same budget for all: ten rounds, whether posteriors have settled or not."""
NAMES = ("bayessim", "bayessim+edge", "npe", "tsnpe", "apt", "snle")

_COMPILED: dict[tuple, tuple] = {}
"""The last program with its seconds of compilation, for further seeds, which differ only in arguments."""


def settings_of(method: str, simulations: int) -> Settings:
    """A method's defaults for a budget that ten rounds share, failures included."""
    each = simulations // PRESET.rounds
    method = METHODS[method.partition("+")[0]]
    return method(PRESET.replace(simulations_per_round=each, simulation_budget=each)).check()


def infer(method: str, case: Case, simulations: int) -> Found:
    """The posterior of a case by one of `NAMES`; the time covers a call of the compiled program."""
    arguments = key_of(case.seed), jnp.asarray(case.x), case.box, jnp.asarray(points(case))
    name = method, case.task.name, simulations
    if name not in _COMPILED:
        _COMPILED.clear()
        began = time.perf_counter()
        program = jax.jit(functools.partial(_run, method, case.task, simulations)).lower(*arguments).compile()
        _COMPILED[name] = program, time.perf_counter() - began
    program, compiling = _COMPILED[name]
    began = time.perf_counter()
    draws, log_prob, attempted, failed = jax.block_until_ready(program(*arguments))
    seconds = time.perf_counter() - began
    normalised = not settings_of(method, simulations).estimator.is_likelihood
    density = np.asarray(log_prob) if normalised else None
    return Found(np.asarray(draws), density, seconds, compiling, int(attempted), int(failed))


def _run(method: str, task: Task, simulations: int, key: jax.Array, x: jax.Array, box: Support, theta: jax.Array):
    """A whole inference: draws of the posterior, its log-density at theta, simulations attempted and failed."""
    settings, keys = settings_of(method, simulations), run_keys(key)
    rule = PAPER_EDGE if method.endswith("+edge") else Fixed()
    look = lambda index, state, info: (info.simulations.attempted, jnp.sum(info.failed))
    state, (attempted, failed) = algorithm.run(keys.run, task, settings, rule, x, box, look)
    posterior = posterior_after(settings.correction, state.reported, state.network, x)
    draws = posterior.sample(keys.check, DRAWS, space="inference")
    # A likelihood's posterior has no normalised density.
    log_prob = jnp.zeros(()) if settings.estimator.is_likelihood else posterior.log_prob(theta, space="inference")
    return draws, log_prob, jnp.sum(attempted), jnp.sum(failed)
