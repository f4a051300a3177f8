"""Simulations through executors: processes on this machine, a Dask cluster, or any `concurrent.futures.Executor`."""

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor

from jaxlfi.tasks.errors import ExecutorError
from jaxlfi.tasks.supervisor import Supervisor, enlist
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.worker import OneOfBatch

CONNECT = 10.0
"""Seconds to wait for a scheduler to answer."""


def one_by_one(task: Task, executor: Executor | None = None, timeout: float | None = None) -> Task:
    """The task with simulations that are made one by one, each with its own generator.

    A simulator of batches is called for batches of one.

    Args:
        task: with a simulator on the host.
        executor: makes the simulations; None leaves it as it is.
        timeout: seconds after which a simulation is given up; None leaves it as it is.

    Raises:
        ValueError: for a task whose simulator JAX compiles, or an invalid executor.
    """
    if not task.on_host:
        raise ValueError(
            f"executor: expected a task with a host simulator, got {task.name}, whose simulations JAX compiles"
        )
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise ValueError(f"executor: expected a concurrent.futures.Executor, got {type(executor).__name__}")
    simulate = task.simulate
    if not simulate.each:
        simulate = dataclasses.replace(simulate, function=OneOfBatch(simulate.function), each=True)
    changes = {"executor": executor, "timeout": timeout}
    given = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(task, simulate=dataclasses.replace(simulate, **given))


@contextlib.contextmanager
def workers(count: int) -> Iterator[Executor]:
    """Processes on this machine, which end with the context, even in the middle of simulations.

    Raises:
        ValueError: for fewer than one.
    """
    if count < 1:
        raise ValueError(f"workers: expected at least 1, got {count}")
    supervisors: list[Supervisor] = []
    executor = ThreadPoolExecutor(count, "simulations", initializer=enlist, initargs=(supervisors,))
    try:
        yield executor
    finally:
        executor.shutdown(wait=False, cancel_futures=True)
        for supervisor in tuple(supervisors):
            supervisor.end()
        executor.shutdown()


@contextlib.contextmanager
def scheduler(address: str) -> Iterator[Executor]:
    """The workers of an existing Dask cluster, which stays when the context ends.

    Args:
        address: of its scheduler, as "tcp://127.0.0.1:8786".

    Raises:
        ValueError: if `distributed` is not installed.
        ExecutorError: if no scheduler answers.
    """
    try:
        import distributed
    except ImportError as error:
        raise ValueError("scheduler: expected distributed to be installed: pip install 'jaxlfi[dask]'") from error
    for name in logging.root.manager.loggerDict:  # our one-line message reports a lost scheduler
        if name.partition(".")[0] in ("distributed", "tornado", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ExecutorError(
            f"scheduler: expected a Dask scheduler at {address}, got {type(error).__name__}: {error}"
        ) from error
    try:
        yield client.get_executor()
    finally:
        with contextlib.suppress(Exception):  # the connection to the scheduler is lost
            client.close(timeout=1)
