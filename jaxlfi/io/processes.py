"""Processes that work on one command together, on one host or several, joined by `jax.distributed`.

Each computes its own part on its own devices. They exchange arrays through the key-value store of jax's coordination
service, which runs in process 0: no collectives, and no other port than the coordinator's. The same service notices
within `LOST` seconds that a process has died, and ends the others.
"""

import contextlib
import dataclasses
import io
import itertools
import json
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

AUTO = "auto"
"""Value of a coordinator's address that takes it from Slurm, Open MPI or Kubernetes."""
CONNECT, LOST = 120, 15
"""Largest difference in s between the starts of processes, and silence in s after which one counts as lost."""
SECOND = 1000
"""One second in the unit of the store, ms."""
PIECE = 2**24
"""Largest number of bytes in a message."""


class ProcessLostError(OSError):
    """Another process has ended."""


@dataclasses.dataclass(frozen=True)
class Processes:
    """All processes of a command, as seen by one of them. All must call the methods that exchange in the same order.

    Attributes:
        index: index of this process; process 0 writes.
        count: number of processes.
    """

    index: int = 0
    count: int = 1
    _calls: Iterator[int] = dataclasses.field(default_factory=itertools.count, repr=False, compare=False)

    @property
    def writes(self) -> bool:
        """Whether this is the one that prints and writes."""
        return self.index == 0

    def gather(self, tree: Any) -> Any:
        """Arrays of all processes, joined along their leading axes, in the one that writes; in others, their own."""
        call = next(self._calls)
        if not self.writes:
            _send(f"{call}/{self.index}", _leaves(tree))
            return tree
        parts = [_leaves(tree), *(_receive(f"{call}/{other}") for other in range(1, self.count))]
        return _like(tree, [np.concatenate(leaves) for leaves in zip(*parts, strict=True)])

    def scatter(self, trees: list[Any]) -> Any:
        """The part that the process that writes has for this one.

        Args:
            trees: arrays for each process, all of one structure; in processes that do not write, only the structure
                matters.
        """
        call = next(self._calls)
        if not self.writes:
            return _like(trees[0], _receive(f"{call}/{self.index}"))
        for other in range(1, self.count):
            _send(f"{call}/{other}", _leaves(trees[other]))
        return trees[0]

    def broadcast(self, tree: Any) -> Any:
        """The arrays of the process that writes, in all processes."""
        return self.scatter([tree] * self.count) if self.count > 1 else tree

    def broadcast_json(self, value: Any) -> Any:
        """The JSON value of the process that writes, in all processes."""
        text = json.dumps(value).encode() if self.writes else b""
        return json.loads(self.broadcast(np.frombuffer(text, np.uint8)).tobytes())

    def leave(self) -> None:
        """End together: the other processes wait until everything is written."""
        if self.count > 1:
            import jax

            self.broadcast(np.zeros(()))
            jax.distributed.shutdown()


ALONE = Processes()
"""A command in a process of its own."""


class Partition:
    """The runs of a batch, divided evenly among processes, and in each of them among its devices.

    Attributes:
        processes: processes among which the runs are divided.
        runs: number of runs.
        devices: number of devices used in each process: all of them, or as many as it takes for one run each.
    """

    def __init__(self, processes: Processes, runs: int, devices: int):
        """Divide the runs.

        Args:
            processes: processes among which to divide them.
            runs: number of runs.
            devices: number of devices of each process.

        Raises:
            ValueError: if there are more processes than runs.
        """
        if processes.count > runs:
            raise ValueError(f"processes: expected at most one per run, got {processes.count} for {runs}")
        self.processes, self.runs = processes, runs
        self.devices = min(devices, math.ceil(runs / processes.count))
        each = self.devices * math.ceil(runs / (self.devices * processes.count))
        padded = np.minimum(np.arange(processes.count * each), runs - 1)  # the last run repeated to fill them
        self._rows = np.split(padded, processes.count)

    def local(self, tree: Any) -> Any:
        """This process's part of arrays of all runs."""
        return self._part(tree, self.processes.index)

    def scatter(self, tree: Any) -> Any:
        """As `local`, for arrays that only the process that writes has; others need `tree` for its structure only."""
        all_of_them = range(self.processes.count) if self.processes.writes else []
        return self.processes.scatter([self._part(tree, index) for index in all_of_them] or [tree])

    def gather(self, tree: Any) -> Any:
        """Arrays of all runs from each process's part, in the process that writes; in others, their part."""
        import jax

        whole = self.processes.gather(tree)
        return jax.tree.map(lambda leaf: leaf[: self.runs], whole) if self.processes.writes else tree

    def _part(self, tree: Any, index: int) -> Any:
        import jax

        rows = self._rows[index]

        def part(leaf: Any) -> Any:
            if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                return leaf[rows]
            # As raw data: jax's key-reuse checker counts the indexing of keys as their use, since rows may repeat.
            return jax.random.wrap_key_data(jax.random.key_data(leaf)[rows])

        return jax.tree.map(part, tree)


def join(coordinator: str, index: int | None = None, count: int | None = None) -> Processes:
    """Join the other processes of this command; call this before jax sees its devices.

    Args:
        coordinator: "HOST:PORT", where process 0 listens; or `AUTO`.
        index: index of this process, from 0; None for `AUTO`.
        count: number of processes; None for `AUTO`.

    Raises:
        ValueError: if they cannot be joined.
    """
    import jax

    if jax.distributed.is_initialized():
        return Processes(_state().process_id, _state().num_processes)
    by_hand = {"coordinator_address": coordinator, "num_processes": count, "process_id": index}
    if coordinator != AUTO:
        by_hand["cluster_detection_method"] = "deactivate"
    try:
        jax.distributed.initialize(
            **({} if coordinator == AUTO else by_hand), initialization_timeout=CONNECT, heartbeat_timeout_seconds=LOST
        )
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"coordinator: expected to join the other processes at {coordinator}, got: {error}") from error
    jax.local_devices()  # jax 0.12 initialises those of all processes together, before any of them works or exits
    return Processes(_state().process_id, _state().num_processes)


def _state() -> Any:
    """State of the processes in jax: nothing public gives the store, or their number before devices are initialised."""
    from jax._src import distributed

    return distributed.global_state


def _send(name: str, leaves: list[np.ndarray]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, *leaves)
    content = buffer.getvalue()
    with _lost():
        for place, first in enumerate(range(0, len(content), PIECE)):
            _state().client.key_value_set_bytes(f"jaxlfi/{name}/{place}", content[first : first + PIECE])
        _state().client.key_value_set(f"jaxlfi/{name}", str(place + 1))


def _receive(name: str) -> list[np.ndarray]:
    client = _state().client
    with _lost():
        pieces = _awaited(client, f"jaxlfi/{name}")
        wait = LOST * SECOND  # they are there, but a busy machine may take a while to say so
        content = b"".join(client.blocking_key_value_get_bytes(f"jaxlfi/{name}/{i}", wait) for i in range(pieces))
        client.key_value_delete(f"jaxlfi/{name}")  # with its pieces
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return [arrays[f"arr_{place}"] for place in range(len(arrays.files))]


def _awaited(client: Any, name: str) -> int:
    """Wait for a number; interruptions are handled every second."""
    while True:
        try:
            return int(client.blocking_key_value_get(name, SECOND))
        except RuntimeError as error:
            if "DEADLINE_EXCEEDED" not in str(error):
                raise


@contextlib.contextmanager
def _lost() -> Iterator[None]:
    """Turn the store's errors into one that says why, raised only if jax does not end this process first."""
    try:
        yield
    except RuntimeError as error:
        time.sleep(LOST)
        raise ProcessLostError("another process of this command was lost") from error


def _leaves(tree: Any) -> list[np.ndarray]:
    import jax

    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def _like(tree: Any, leaves: list[np.ndarray]) -> Any:
    import jax

    return jax.tree.unflatten(jax.tree.structure(tree), leaves)
