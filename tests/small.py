"""What the tests of whole runs share: settings that take milliseconds, and one engine for many runs."""

import dataclasses
import functools

import jax
import pytest

from envs import gaussian_linear
from jaxlfi.bayessim.algorithm import Settings
from jaxlfi.bayessim import batch as lanes
from jaxlfi.estimators.estimator import Estimator

TASK = "envs.gaussian_linear:task"
# Few and small steps: training amplifies rounding, and runs that ought to be equal are compared to a
# tolerance.
SETTINGS = Settings(
    estimator=Estimator(hidden=(16,), learning_rate=1e-3, epochs=0, steps=100, batch_size=20, warm_start=False),
    rounds=2,
    simulations_per_round=20,
    simulation_budget=25,
)
FLAGS = (
    "--hidden 16 --activation tanh --normaliser zscore --learning-rate 1e-3 --steps 100 --batch-size 20 "
    "--validation 0 --patience 0 --ensemble-size 1 --components 4 --prune 0 --weight-decay 0 --clip-norm inf "
    "--schedule constant --no-warm-start --correction none --restriction clip "
    "--rounds 2 --simulations-per-round 20 --simulation-budget 25 --no-figures"
).split()
"""The same on the command line."""

gaussian = functools.cache(gaussian_linear.task)
"""One task object, so that programs compiled for it are found again."""


def settings(**changes) -> Settings:
    """The small settings with some of them replaced."""
    return dataclasses.replace(SETTINGS, **changes)


class SharedEngine(lanes.LaneEngine):
    """An engine that compiles once however many runs use it."""

    def compile(self, state) -> None:
        """Compile the first time only."""
        if hasattr(self._round, "lower"):
            super().compile(state)


def share_engine(monkeypatch) -> None:
    """Let all sessions of a test use one task and one engine: their lanes and observations must be equal."""
    from jaxlfi.runs import session
    from jaxlfi.tasks import registry as tasks

    made = []

    def engine(task, settings, inputs):
        if not made:
            made.append(SharedEngine(task, settings, inputs))
        return made[0]

    monkeypatch.setattr(session, "LaneEngine", engine)
    monkeypatch.setattr(tasks, "load", lambda reference: gaussian())


def command(*arguments: str) -> int:
    """Run the command line in this process; its exit status."""
    from jaxlfi.cli import parser as cli

    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return stop.code


@pytest.fixture(autouse=True, scope="module")
def whole_runs():
    """What tests of whole runs need of jax; import this into their module.

    No key-reuse checker: it takes a vmapped scan over keys for a reuse (jax 0.9.2). Unbatched runs are checked
    elsewhere.
    """
    with jax.debug_key_reuse(False):
        yield
