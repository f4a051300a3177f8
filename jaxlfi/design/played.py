"""A design's controls as files: a table, and an MCAP file for ROS 2 and Foxglove."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlfi.io import files, mcap, text_table
from jaxlfi.io.rollout import Rollout, Signal

TIMES = "time [s]"
"""The heading of the first column of controls that are signals over time."""
TOPIC = "action"
"""The name of their signal in an MCAP file, the same as in a recorded rollout."""


def write(stem: Path, headings: Sequence[str], rows: Float[np.ndarray, "times columns"]) -> list[Path]:
    """Write STEM.csv, and STEM.mcap if the rows have times and mcap is installed.

    Args:
        stem: path of the files without suffix.
        headings: headings of the columns, such as "motor [N m]".
        rows: numbers of the table.

    Returns:
        The paths of the files written.
    """
    rows = np.asarray(rows, float)
    text = text_table.as_csv(headings, ([f"{value:.9g}" for value in row] for row in rows))
    paths = [stem.with_suffix(".csv")]
    files.write_bytes(paths[0], text.encode())
    if headings[0] == TIMES and mcap.installed():
        paths.append(stem.with_suffix(".mcap"))
        mcap.write(paths[1], as_rollout(headings, rows))
    return paths


def as_rollout(headings: Sequence[str], rows: Float[np.ndarray, "times columns"]) -> Rollout:
    """Columns of controls as one signal.

    Example:
        >>> made = as_rollout(["time [s]", "motor [N m]"], np.array([[0.0, 1.0], [0.1, 2.0]]))
        >>> made.signals["action"].names, made.signals["action"].units
        (('motor',), ('N m',))
    """
    named = [heading.removesuffix("]").partition(" [") for heading in headings[1:]]
    names, units = tuple(name for name, _, _ in named), tuple(unit for _, _, unit in named)
    return Rollout({TOPIC: Signal(rows[:, 0], rows[:, 1:], names, units)})


def lacking(controls: Callable[[Any], Any] | None) -> str:
    """Why there is no MCAP file of a task's controls, in one line; "" if there is one, or the task has no controls."""
    return "" if controls is None or mcap.installed() else mcap.INSTALL
