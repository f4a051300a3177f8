"""Drives a batch through its rounds."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine
from jaxlfi.bayessim.multi_process import SharedEngine
from jaxlfi.tasks.host import require_success

OnRound = Callable[[int, State, dict[str, np.ndarray], float], Any]
"""Called at the end of a round with its index, the state after it, its record, and the seconds it took."""


def run_rounds(
    engine: BatchEngine | SharedEngine,
    state: State,
    rounds: range,
    on_round: OnRound,
    on_compiled: Callable[[float], Any] = lambda seconds: None,
) -> State:
    """Step a batch through its rounds, or until all of its runs have settled.

    Args:
        engine: engine of the batch.
        state: state before the first of these rounds; it is consumed.
        rounds: indices of the rounds to run.
        on_round: called at the end of each round; it makes this round the last by raising StopIteration.
        on_compiled: called with the seconds that compilation took.

    Returns:
        The state after the last round.

    Raises:
        SimulatorError: for a simulator that breaks its contract, or whose simulations all fail in the first round.
    """
    begun = time.perf_counter()
    if rounds.start == 0:
        engine.begin(state)
    begun = time.perf_counter() - begun
    if rounds:
        began = time.perf_counter()
        engine.compile(state, rounds.start)
        on_compiled(time.perf_counter() - began)
    for index in rounds:
        began = time.perf_counter()
        state, row = engine.round(state, index)
        if index == 0:
            require_success(row["succeeded"], row["failed"], engine.task.reasons, engine.failure_messages)
        try:
            on_round(index, state, row, time.perf_counter() - began + (begun if index == 0 else 0.0))
        except StopIteration:
            break
        if np.all(row["settled"]):
            break
    return state
