"""Learning curves for TensorBoard: `tensorboard --logdir DIR` with a training's folder.

DOMAIN/seed_000/events.out.tfevents...      scalars of one training against environment steps

They are written by tensorboardX, which Brax depends on; TensorBoard itself is only needed to view them.
"""

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

EVENTS = "events.out.tfevents.*"
TAGS = {"value": "return", "episodes": "count"}
"""Clearer names in TensorBoard for some arrays of the learning curves."""


class Scalars(contextlib.AbstractContextManager):
    """Writes the learning curves of parallel trainings while they grow; a context manager.

    The first call of `write` writes all updates so far and replaces the files of an earlier process, which may end
    anywhere, so that a resumed training has every step exactly once.
    """

    def __init__(self, out: Path, names: Sequence[tuple[str, int]], steps_per_update: int):
        """Nothing is written yet.

        Args:
            out: folder of the trainings.
            names: domain and seed of each of the R trainings.
            steps_per_update: number of environment steps per update.

        Raises:
            ImportError: without tensorboardX.
        """
        try:
            from tensorboardX.event_file_writer import EventsWriter  # its SummaryWriter starts a thread for each file
            from tensorboardX.proto import event_pb2, summary_pb2
        except ImportError as error:
            raise ImportError("TensorBoard's files need tensorboardX: pip install 'jaxlfi[policy]'") from error
        self._open, self._events, self._summaries = EventsWriter, event_pb2, summary_pb2
        self._steps = steps_per_update
        self._folders = [out / domain / f"seed_{seed:03d}" for domain, seed in names]
        self._writers: list = []
        self._done = 0

    def __exit__(self, *error) -> None:
        """Close the files."""
        for each in self._writers:
            each.close()

    def write(self, curves: Mapping[str, np.ndarray]) -> None:
        """Write the new updates.

        Args:
            curves: all updates so far, shape [U, R] by the names of curves.npz. Values that are not finite are left
                out, such as the return of an update in which no episode ended.
        """
        if not self._writers:
            self._writers = [self._begun(folder) for folder in self._folders]
        updates = len(curves["value"])
        # The times of an earlier process's updates are unknown, but their durations are known.
        ends = time.time() - np.cumsum(curves["seconds"][::-1], axis=0)[::-1] + curves["seconds"]
        for place, each in enumerate(self._writers):
            for update in range(self._done, updates):
                row = {name: float(rows[update, place]) for name, rows in curves.items()}
                scalars = {"speed/steps_per_second": self._steps / row.pop("seconds")}
                scalars |= {_tag(name): value for name, value in row.items() if np.isfinite(value)}
                each.write_event(self._event(update, float(ends[update, place]), scalars))
            each.flush()
        self._done = updates

    def _begun(self, folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob(EVENTS):
            old.unlink()
        file, events = self._open(str(folder / "events")), self._events
        # A running TensorBoard forgets what it read from the earlier file.
        file.write_event(events.Event(session_log=events.SessionLog(status=events.SessionLog.START)))
        return file

    def _event(self, update: int, when: float, scalars: Mapping[str, float]):
        values = [self._summaries.Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        summary = self._summaries.Summary(value=values)
        return self._events.Event(step=(update + 1) * self._steps, wall_time=when, summary=summary)


def _tag(name: str) -> str:
    """The tag of a curve in TensorBoard; losses are already called loss/NAME."""
    return name if "/" in name else f"episodes/{TAGS.get(name, name)}"
