"""Drives a batch through its rounds."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine
from jaxlfi.bayessim.multi_process import SharedEngine
from jaxlfi.tasks.host import SimulatorError
from jaxlfi.tasks.task import Task

OnRound = Callable[[int, State, dict[str, np.ndarray], float], Any]
"""Called as a round ends: its index, the state after it, its record, and the seconds it took."""


def drive(
    engine: BatchEngine | SharedEngine,
    state: State,
    rounds: range,
    on_round: OnRound,
    on_compiled: Callable[[float], Any] = lambda seconds: None,
) -> State:
    """Step a batch through its rounds, or until all of its runs have settled.

    Args:
        engine: of the batch.
        state: before the first of these rounds; it is consumed.
        rounds: indices of the rounds to do.
        on_round: called as each ends; it makes this round the last by raising StopIteration.
        on_compiled: called with the seconds that compiling took.

    Returns:
        The state after the last round.

    Raises:
        SimulatorError: for a simulator that breaks its contract, or whose simulations all fail in the first round.
    """
    if rounds:
        began = time.perf_counter()
        engine.compile(state, rounds.start)
        on_compiled(time.perf_counter() - began)
    for index in rounds:
        began = time.perf_counter()
        state, row = engine.round(state, index)
        if index == 0:
            require_success(row["succeeded"], row["failed"], engine.task, engine.known_failures)
        try:
            on_round(index, state, row, time.perf_counter() - began)
        except StopIteration:
            break
        if np.all(row["settled"]):
            break
    return state


def require_success(succeeded: np.ndarray, failed: np.ndarray, task: Task, known: str = "") -> None:
    """Stop if no simulation of the first round succeeded in any run; `known` says what is known of failures.

    Raises:
        SimulatorError: with the counts by reason.
    """
    if np.sum(succeeded) > 0:
        return
    counts = np.sum(np.atleast_2d(failed), axis=0)
    listed = ", ".join(f"{reason}: {count}" for reason, count in zip(task.reasons, counts, strict=True))
    raise SimulatorError(f"simulate: expected some valid simulations in the first round, got none ({listed}){known}")
