"""A resumable store of a study's results, chunk by chunk."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from jaxlfi.io import files as atomic
from jaxlfi.io.processes import ALONE, Processes
from jaxlfi.io.workfolder import StoreError


@dataclasses.dataclass(frozen=True)
class ChunkStore:
    """Results of N items, computed and saved in chunks; an existing chunk is not computed again.

    Attributes:
        folder: folder of the chunks 000.npz, 001.npz, ...
        size: number of items N.
        length: number of items in a chunk; the last may have fewer.
        fingerprint: hash of everything the results depend on. Chunks with a different one belong to another study.
        names: arrays that every chunk has, with a leading axis of its items.
    """

    folder: Path
    size: int
    length: int
    fingerprint: str
    names: tuple[str, ...]

    @property
    def chunks(self) -> list[range]:
        """The items of each chunk."""
        return [range(first, min(first + self.length, self.size)) for first in range(0, self.size, self.length)]

    def path(self, index: int) -> Path:
        """The path of a chunk's file."""
        return self.folder / f"{index:03d}.npz"

    def done(self) -> list[int]:
        """The indices of the existing chunks, each checked.

        Raises:
            StoreError: for a chunk that is damaged, incomplete or from another study.
        """
        there = [index for index in range(len(self.chunks)) if self.path(index).exists()]
        for index in there:
            self.read(index)
        return there

    def write(self, index: int, arrays: Mapping[str, np.ndarray], seconds: float) -> None:
        """Save a chunk's results, without the padding of the last chunk."""
        count = len(self.chunks[index])
        results = {name: np.asarray(arrays[name])[:count] for name in self.names}
        label = {"fingerprint": np.asarray(self.fingerprint), "seconds": np.asarray(seconds)}
        self.folder.mkdir(exist_ok=True)  # fails if the parent folder has been moved meanwhile
        atomic.write_arrays(self.path(index), results | label, durable=True)

    def read(self, index: int) -> dict[str, np.ndarray]:
        """A chunk's results, and the seconds they took.

        Raises:
            StoreError: for a file that is missing, damaged, incomplete or from another study; it is left as it is.
        """
        path, count = self.path(index), len(self.chunks[index])
        try:
            arrays = atomic.read_arrays(path)
        except ValueError as error:
            raise StoreError(f"{error}: delete it, and resuming computes it again") from error
        if str(arrays.get("fingerprint")) != self.fingerprint:
            raise StoreError(f"{path}: expected a chunk of this study, got one of another")
        if not all(name in arrays and len(arrays[name]) == count for name in self.names):
            raise StoreError(f"{path}: expected {', '.join(self.names)} of {count} runs, got others")
        return arrays

    def compute(
        self, one: Callable[[range], tuple[Mapping[str, np.ndarray], float]], processes: Processes = ALONE
    ) -> None:
        """Compute the missing chunks in order.

        Args:
            one: function from a chunk's items to its results and the seconds they took.
            processes: processes that compute each chunk together; the one that writes checks which chunks exist.
        """
        done = processes.broadcast(np.asarray(self.done() if processes.writes else [], int))
        for index, items in enumerate(self.chunks):
            if index not in done:
                results = one(items)
                if processes.writes:
                    self.write(index, *results)

    def results(self) -> tuple[dict[str, np.ndarray], float]:
        """The results of all items, and the total seconds of all chunks."""
        chunks = [self.read(index) for index in range(len(self.chunks))]
        joined = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in self.names}
        return joined, float(sum(chunk["seconds"] for chunk in chunks))
