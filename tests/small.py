"""Shared by tests of whole runs: settings that take milliseconds, and one task for many runs."""

import functools
import json
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import pytest

from jaxlfi.bayessim.settings import Settings
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.mixture_network import MixtureNetwork

TASK = "jaxlfi.envs.gaussian_linear:task"
# Few and small steps: training amplifies rounding, and runs that should be equal are compared up to a tolerance.
SETTINGS = Settings(
    estimator=MixtureNetwork(hidden=(16,), learning_rate=1e-3, epochs=0, steps=100, batch_size=20, warm_start=False),
    rounds=2,
    simulations_per_round=20,
    simulation_budget=25,
)
FLAGS = (
    "--estimator mdn --hidden 16 --activation tanh --normaliser zscore --parameters feasible --reduction none "
    "--learning-rate 1e-3 --steps 100 --batch-size 20 "
    "--validation 0 --patience 0 --ensemble-size 1 --components 4 --prune 0 --weight-decay 0 --clip-norm inf "
    "--schedule constant --no-warm-start --correction none --restriction clip --inflation 1 "
    "--rounds 2 --min-rounds 0 --simulations-per-round 20 --simulation-budget 25 --no-figures"
).split()
"""The same settings on the command line."""

gaussian = functools.cache(gaussian_linear.task)
"""The task that `TASK` names."""


def settings(**changes) -> Settings:
    """The small settings with some of them replaced."""
    return SETTINGS.replace(**changes)


def command(*arguments: str) -> int:
    """Run the command line in this process; returns its exit status."""
    from jaxlfi.cli import parser as cli

    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return stop.code


def read_ledger(folder: Path) -> list[dict[str, Any]]:
    """The ledger of a run folder, one dictionary per round; unknown numbers are NaN."""
    lines = [json.loads(line) for line in (folder / "ledger.jsonl").read_text().splitlines()]
    return [{name: float("nan") if value is None else value for name, value in line.items()} for line in lines]


@pytest.fixture(autouse=True, scope="module")
def whole_runs():
    """JAX's settings for tests of whole runs; import this into their module.

    The key-reuse checker is off: it takes a vmapped scan over keys for a reuse (jax 0.9.2). Unbatched runs are checked
    elsewhere. Shapes in signatures, whose checks take a quarter of the tracing time, are not checked either: the tests
    of a run's parts check theirs, and `bayessim/test_algorithm.py` and `estimators/test_apt.py` those of whole runs.
    """
    jaxtyping.config.update("jaxtyping_disable", True)
    with jax.debug_key_reuse(False):
        yield
    jaxtyping.config.update("jaxtyping_disable", False)
