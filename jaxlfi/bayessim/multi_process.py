"""A batch whose runs are divided among several processes, each with the devices of its own host."""

from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine, RunInputs
from jaxlfi.bayessim.settings import Settings
from jaxlfi.io.processes import Partition, Processes
from jaxlfi.tasks.simulation import Simulations
from jaxlfi.tasks.task import Task

STEERING = ("settled", "succeeded", "failed")
"""Entries of a round's record that decide about the next one; every process gets those of all runs."""


class SharedEngine:
    """Steps a batch as `BatchEngine` does, in several processes; the writing process sees all of it.

    Each device steps the same runs with the same program as in a single process with as many devices.
    """

    failure_messages: str = ""
    references: np.ndarray | None = None

    def __init__(
        self, task: Task, settings: Settings, inputs: RunInputs, processes: Processes, first: Simulations | None = None
    ):
        """Prepare, without compiling; see `BatchEngine`.

        Raises:
            ValueError: if there are more processes than runs.
        """
        self.task, self.runs, self._processes = task, len(inputs.x), processes
        self._partition = Partition(processes, self.runs, jax.local_device_count())
        local = jax.local_devices()[: self._partition.devices]
        self._own = BatchEngine(task, settings, self._partition.local(inputs), local, first)

    def start(self) -> State:
        """The state of this process's runs before the first round."""
        return self._own.start()

    def begin(self, state: State) -> None:
        """See `BatchEngine.begin`."""
        self._own.begin(state)

    def compile(self, state: State, index: int = 0) -> list[Any]:
        """See `BatchEngine.compile`."""
        return self._own.compile(state, index)

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every run; the record covers all runs, but in processes that do not write only `STEERING`."""
        state, row = self._own.round(state, index)
        row = self._partition.gather(row)
        steering = self._processes.broadcast({name: row[name] for name in STEERING})
        return state, row | steering if self._processes.writes else steering

    def fetch(self, state: State) -> State:
        """The state of all runs, on the host of the writing process; all processes must call it."""
        return self._partition.gather(self._own.fetch(state))

    def place(self, tree: Any) -> Any:
        """Distribute a state of all runs from the writing process; all processes must call it."""
        return self._own.place(self._partition.scatter(tree))
