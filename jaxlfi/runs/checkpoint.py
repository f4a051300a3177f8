"""Checkpoints: the files from which a killed run continues, written at the end of each round.

A checkpoint is a folder of .npz files, each replaced as a whole: `start.npz` holds the observations (and the first
round's simulations, if they were given), `round_000.npz` and so on hold the record of each round, and `state.npz` the
last state, with the number of finished rounds. Only the state is rewritten, so early and late rounds cost the same. A
round that was written but is not yet counted in the state is repeated, with the same result. `simulations.bin` holds
simulations that were made one by one for an unfinished round.
"""

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.record import FINAL, split_final
from jaxlfi.io import files as atomic
from jaxlfi.io import trees
from jaxlfi.io.formats import written_by
from jaxlfi.tasks.simulation import Simulations

FOLDER = "checkpoint"
_DONE = "rounds_done"
GIVEN = "given/"
"""Prefix of the names of given simulations' arrays."""


EXTENDED = "extended"
"""Key in config.json of the rounds that a run was asked for before it was given more."""
OF_ALL_ROUNDS = (".dataset", ".proposals", ".attempts")
"""Parts of a state whose second axis has room for all rounds."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; it is left as it is."""


class Checkpoint:
    """The checkpoint of a batch of runs, in `folder/checkpoint`."""

    def __init__(self, folder: Path):
        """Nothing is read or written yet."""
        self.folder = folder / FOLDER

    def write_start(self, observed: np.ndarray, x: np.ndarray, first: Simulations | None = None) -> None:
        """Write the runs' observations, shape [L, T, C], their summaries, shape [L, S], and given simulations."""
        self.folder.mkdir(parents=True)
        given = {} if first is None else {GIVEN + name: leaf for name, leaf in vars(first).items()}
        atomic.write_sealed(self.folder / "start.npz", {"observed": observed, "x": x} | given)

    def read_start(self) -> tuple[np.ndarray, np.ndarray, Simulations | None]:
        """The runs' observations and summaries, and the simulations that were given for the first round."""
        start = self._read("start.npz")
        given: dict[str, Any] = {
            name.removeprefix(GIVEN): leaf for name, leaf in start.items() if name.startswith(GIVEN)
        }
        given |= {name: jnp.asarray(leaf) for name, leaf in given.items() if name != "x"}  # x may be double
        observed, x = (self._named(start, "start.npz", name) for name in ("observed", "x"))
        try:
            return observed, x, Simulations(**given) if given else None
        except TypeError as error:
            raise CheckpointError(f"{self.folder / 'start.npz'}: expected whole simulations, got: {error}") from error

    def write_round(self, index: int, state: Any, rows: dict[str, np.ndarray], seconds: float) -> None:
        """Write a round's record and the state after it; some arrays are of the last round only (`split_final`)."""
        rows, final = split_final(rows)
        atomic.write_sealed(self.folder / _round_name(index), rows | {"seconds": np.asarray(seconds)})
        leaves = trees.to_arrays(state)
        done = {_DONE: np.asarray(index + 1)}
        atomic.write_sealed(self.folder / "state.npz", leaves | done | final)

    @property
    def simulations(self) -> Path:
        """The file with the simulations of an unfinished round (`jaxlfi.tasks.journal`)."""
        return self.folder / "simulations.bin"

    def rounds_done(self) -> int:
        """Number of finished rounds according to the state."""
        if not (self.folder / "state.npz").exists():
            return 0
        return int(self._named(self._read("state.npz"), "state.npz", _DONE))

    def read_rounds(self, count: int) -> tuple[list[dict[str, np.ndarray]], list[float], dict[str, np.ndarray]]:
        """Records of the first `count` rounds, their durations in s, and the arrays kept for the last round only."""
        rows, seconds = [], []
        for index in range(count):
            arrays = self._read(_round_name(index))
            seconds.append(float(self._named(arrays, _round_name(index), "seconds")))
            rows.append({name: value for name, value in arrays.items() if name != "seconds"})
        state = self._read("state.npz") if count else {}
        return rows, seconds, {name: value for name, value in state.items() if name.startswith(FINAL)}

    def read_state(self, template: Any) -> Any:
        """The last state.

        Args:
            template: a state of the same shapes; a fresh one if the run has been given more rounds since.
        """
        arrays = self._read("state.npz")
        if self._config().get(EXTENDED):
            arrays = _with_room(arrays, trees.named_leaves(template))
        try:
            return trees.from_arrays(arrays, template)
        except ValueError as error:
            raise CheckpointError(f"{self.folder / 'state.npz'}: {error}{self._begun_by()}") from error

    def require_records(self, before: Iterable[str], now: Iterable[str]) -> None:
        """Refuse to add a round's record to those of earlier rounds that hold other arrays.

        Raises:
            CheckpointError: naming one of them.
        """
        if other := sorted({*before} ^ {*now}):
            raise CheckpointError(
                f"{self.folder / _round_name(0)}: expected a record of the same arrays as later rounds have, got one "
                f"that differs in {other[0]}{self._begun_by()}"
            )

    def _begun_by(self) -> str:
        """The jaxlfi version that can continue the run, for the end of an error."""
        author = written_by(self._config())
        return f"; {author} began the run and goes on with it" if author else ""

    def _config(self) -> dict[str, Any]:
        """The folder's config.json; empty if it cannot be read."""
        try:
            config = atomic.read_json(self.folder.parent / "config.json")
        except ValueError:
            return {}
        return config if isinstance(config, dict) else {}

    def remove(self, keep_state: bool = False) -> None:
        """Clean up after a complete run, with the option to keep the state for more rounds."""
        if keep_state:
            self.simulations.unlink(missing_ok=True)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _read(self, name: str) -> dict[str, np.ndarray]:
        try:
            return atomic.read_sealed(self.folder / name)
        except ValueError as error:
            raise CheckpointError(str(error)) from error

    def _named(self, arrays: dict[str, np.ndarray], file: str, name: str) -> np.ndarray:
        if name not in arrays:
            raise CheckpointError(f"{self.folder / file}: expected an array {name}, got none")
        return arrays[name]


def _with_room(arrays: dict[str, np.ndarray], fresh: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays of a state, extended by the entries of a fresh state to have room for all rounds."""
    found = dict(arrays)
    for name, leaf in fresh.items():
        old = arrays.get(name)
        if old is None or old.ndim < 2 or old.ndim != leaf.ndim or not name.startswith(OF_ALL_ROUNDS):
            continue
        if (old.shape[0], *old.shape[2:]) == (leaf.shape[0], *leaf.shape[2:]):
            whole = np.concatenate([old, np.asarray(leaf)[:, old.shape[1] :]], axis=1)
            found[name] = whole[:, : leaf.shape[1]]  # it may also shrink, if the run ended long before its last round
    return found


def _round_name(index: int) -> str:
    return f"round_{index:03d}.npz"
