"""Rounds around a host simulator: inference is compiled, simulations are made between its parts.

What comes before the simulations of a round (drawing parameters) and after (fitting, adapting) is compiled; the
simulator is called between (`jaxlfi.tasks.simulation.simulate_in_waves`).
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine, RunInputs, check_draws, propose_one, update_one
from jaxlfi.bayessim.programs import compiled, program
from jaxlfi.bayessim.record import record
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.discrepancy import Discrepancy, compared, not_simulated
from jaxlfi.tasks.simulation import Simulations, simulate_batch, simulate_in_waves
from jaxlfi.tasks.task import Task


def engine_for(task: Task, settings: Settings, inputs: RunInputs, first: Simulations | None = None) -> BatchEngine:
    """The engine that steps a batch: one compiled program, or rounds around a host simulator."""
    return (HostEngine if task.on_host else BatchEngine)(task, settings, inputs, first=first)


class HostEngine(BatchEngine):
    """Steps the runs of a batch by one round each, simulating them one after another on the host."""

    def __init__(self, task: Task, settings: Settings, inputs: RunInputs, first: Simulations | None = None):
        """Prepare, without compiling; see `BatchEngine`."""
        super().__init__(task, settings, inputs, devices=jax.local_devices()[:1], first=first)
        part = lambda one, *axes: program(functools.partial(one, task), self.mesh, (None, 0, 0, None, *axes))
        self._propose_many, self._update_many = part(propose_one), part(update_one, 0)

    def compile(self, state: State, index: int = 0) -> None:
        """Compile the parts of a round ahead of their first use, while no simulator waits."""
        place = jnp.asarray(index)
        theta, _ = self._propose(state, place)
        if index == 0 and self.first is not None:
            simulations = self.first_round()
        else:
            flags = jnp.zeros(theta.shape[:2], bool)
            x = jnp.zeros((*theta.shape[:2], self.inputs.x.shape[-1]))
            simulations = Simulations(theta, x, jnp.zeros(flags.shape, jnp.int32), flags, flags, jnp.ones(flags.shape))
        compiled(self._update_many, (self.settings, self.inputs, state, place, simulations))
        compiled(_check_draws, (self.inputs, state, place))

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every run; see `BatchEngine.round`."""
        place = jnp.asarray(index)
        if index == 0 and self.first is not None:
            simulations = self.first_round()
        else:
            simulations = self._simulated(*self._propose(state, place))
        state, info = _call(self._update_many, self.settings, self.inputs, state, place, simulations)
        return state, jax.device_get(record(info, self._checked(state, place)))

    def _propose(self, state: State, place: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _call(self._propose_many, self.settings, self.inputs, state, place)

    def _simulated(self, theta: jax.Array, keys: jax.Array) -> Simulations:
        shape, wanted = self.inputs.observed.shape[1:], self.settings.simulations_per_round
        each = [simulate_in_waves(key, self.task, own, wanted, shape) for key, own in zip(keys, theta, strict=True)]
        return _stacked(each)

    def _checked(self, state: State, index: jax.Array) -> Discrepancy:
        """How far the runs' posteriors are from truth and observation."""
        theta, keys = _call(_check_draws, self.inputs, state, index)
        observed = self.inputs.observed
        if not self.settings.predictive:
            return _stacked([not_simulated(self.task, own, observed[0], self.inputs.x.shape[-1]) for own in theta])
        return _stacked(
            [
                compared(
                    self.task, own, *map(jnp.asarray, simulate_batch(key, self.task, own, observed.shape[1:])), seen
                )
                for key, own, seen in zip(keys, theta, observed, strict=True)
            ]
        )


_check_draws = jax.jit(jax.vmap(check_draws, in_axes=(0, 0, None)))


def _call(many: Any, *arguments: Any) -> Any:
    """Call a program compiled once: a state that was read back from a checkpoint does not compile it anew."""
    return compiled(many, arguments)(*arguments)


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
