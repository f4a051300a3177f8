"""Simulations one by one, here or through an executor, with bit-identical results in any order of arrival."""

import functools
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np

from jaxlfi.tasks.errors import ExecutorError, SimulatorError
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.supervisor import REFUSED, simulate_supervised
from jaxlfi.tasks.worker import Answer, Request, failed

LOOK = 5.0
"""Seconds between two checks of an executor from which nothing arrives."""
Submit = Callable[[Request], Future]


def simulate_each(
    submit: Submit,
    requests: Sequence[Request],
    wanted: int | None,
    journal: Journal,
    at_once: int | None = None,
    alive: Callable[[], bool] = lambda: True,
) -> list[Answer]:
    """Make simulations in their order until enough have succeeded, or all are made.

    As many simulations are in flight as successes are missing, and one more for each that fails. So none is made that
    is not needed, no worker waits for a slow one, and the order of arrival does not affect which ones are made.

    Args:
        submit: begins one simulation (`here`, `through`).
        requests: all that may be made.
        wanted: number of successes; None makes all.
        journal: has earlier simulations, and records new ones.
        at_once: largest number in flight.
        alive: called now and then, whether more can arrive.

    Returns:
        The answers to the first requests, as many as were made.

    Raises:
        ExecutorError: if the executor is lost.
        SimulatorError: if its workers cannot load the simulator.
    """
    answers: dict[int, Answer] = {}
    arrived: queue.SimpleQueue[tuple[int, Future]] = queue.SimpleQueue()
    pending: dict[int, Future] = {}
    begun, successes = 0, 0
    arrive = lambda place, future: arrived.put((place, future))
    missing = lambda: len(requests) if wanted is None else wanted - successes
    journal.expect(len(requests) if wanted is None else min(wanted, len(requests)))
    try:
        while missing() > 0:
            while begun < len(requests) and len(pending) < min(missing(), at_once or len(requests)):
                known = journal.find(requests[begun])
                if known is None:
                    pending[begun] = _submitted(submit, requests[begun])
                    pending[begun].add_done_callback(functools.partial(arrive, begun))
                else:
                    answers[begun] = known
                    successes += known.succeeded
                begun += 1
            if not pending:
                break
            place, future = _next(arrived, alive)
            del pending[place]
            answers[place] = answer = _answer(future)
            journal.add(requests[place], answer)
            successes += answer.succeeded
    finally:
        for future in pending.values():
            future.cancel()
    return [answers[place] for place in range(begun)]


def here(simulate: Callable[[Request], Answer]) -> Submit:
    """Simulations in this thread, each made as it is submitted."""

    def submit(request: Request) -> Future:
        future: Future = Future()
        future.set_result(simulate(request))
        return future

    return submit


def through(executor: Executor, payload: bytes, timeout: float | None) -> Submit:
    """Simulations through an executor, each in a process that its worker keeps (`jaxlfi.tasks.supervisor`)."""
    return lambda request: executor.submit(simulate_supervised, payload, request, timeout)


def alive(executor: Executor) -> bool:
    """Whether simulations can arrive. Dask's may never arrive if its scheduler was lost at the wrong moment."""
    client = getattr(executor, "_client", None)
    return client is None or getattr(client, "status", "running") == "running"


def _next(arrived: queue.SimpleQueue, alive: Callable[[], bool]) -> tuple[int, Future]:
    """The next future to arrive, and its place."""
    while True:
        try:
            return arrived.get(timeout=LOOK)
        except queue.Empty:
            if not alive():
                raise ExecutorError(
                    "executor: connection lost while simulating (its scheduler does not answer)"
                ) from None


def _submitted(submit: Submit, request: Request) -> Future:
    try:
        return submit(request)
    except (RuntimeError, OSError) as error:  # the executor is shut down or broken
        raise _lost(error) from error


def _answer(future: Future) -> Answer:
    """The answer of a finished future. Simulations raise nothing (`jaxlfi.tasks.worker`): errors are its executor's.

    Dask reruns a task on another worker if one dies, and gives up a task that has killed several.
    """
    try:
        answer = future.result()
    except BaseException as error:
        if type(error).__name__ == "KilledWorker":
            return failed("crash", str(error))
        if isinstance(error, KeyboardInterrupt):
            raise
        raise _lost(error) from error
    if answer.outcome == REFUSED:
        raise SimulatorError(f"simulate: a worker cannot load the simulator: {answer.message}")
    return answer


def _lost(error: BaseException) -> ExecutorError:
    words: Any = " ".join(str(error).split()) or "no more is known"
    return ExecutorError(f"executor: connection lost while simulating ({type(error).__name__}: {words})")


def stacked(answers: Sequence[Answer], shape: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories [N, *shape], zero where there is none, and outcomes [N]."""
    trajectories = np.zeros((len(answers), *shape))
    for place, answer in enumerate(answers):
        if answer.outcome >= 0:
            trajectories[place] = answer.trajectory
    return trajectories, np.array([answer.outcome for answer in answers], int)
