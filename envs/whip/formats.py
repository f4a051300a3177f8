"""Recorded rollouts in formats other than their own: LeRobot data sets and MCAP files.

| signal                  | values                                                  | times                      |
|-------------------------|---------------------------------------------------------|----------------------------|
| `observation.state`     | x and z of the gripper, in m                            | of the frames              |
| `observation.keypoints` | u and v of ten keypoints, in normalised pixels          | of the frames              |
| `observation.seen`      | keypoints that were found                               | of the frames              |
| `observation.hits`      | cubes hit so far; may be left out                       | of the frames              |
| `action`                | displacements dx, dz of the set-point, in m             | of the control intervals   |

The description is the rollout's metadata, unchanged (`jaxlfi.envs.whip.recording`). If actions are given per frame, as
in a data set recorded by LeRobot, those of each control interval have to agree.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.recording import ORDER, UNITS, Recording
from jaxlfi.envs.whip.rules import STEPS
from jaxlfi.io import lerobot, mcap
from jaxlfi.io.lerobot import EPISODE, located
from jaxlfi.io.rollout import Rollout, Signal
from jaxlfi.io.serialise import json_safe

TASK = "Whip the deformable linear object so that it hits the top cube and no other."
STATE, ACTION = "observation.state", "action"
OBSERVED = {
    STATE: ("gripper", ("gripper x", "gripper z")),
    "observation.keypoints": ("keypoints", tuple(f"{name} {axis}" for name in ORDER for axis in "uv")),
    "observation.seen": ("seen", ORDER),
    "observation.hits": ("hits", COLOURS),
}
"""Signals with one value per frame: the array of a recording, and the names of its components."""
ACTIONS = ("dx", "dz")
FORMATS = "NAME.npz, NAME.mcap or a folder (a LeRobot data set)"


def read(reference: str | Path) -> Recording:
    """Read a recording of any format.

    Args:
        reference: NAME.npz, NAME.mcap, or the folder of a LeRobot data set, as FOLDER#episode=3 if it has several
            episodes.

    Raises:
        ValueError: for files that have another format, are damaged, or are not rollouts of the whip.
        ImportError: if the extra `robotics` is needed and not installed.
    """
    path, episode = located(reference)
    if path.is_dir():
        if episode is None and len(numbers := lerobot.episodes(path)) > 1:
            raise ValueError(
                f"recording: expected one of {len(numbers)} episodes, as {path}{EPISODE}{numbers[0]}, got {path}"
            )
        rollout = lerobot.read(path, episode)
    elif episode is not None:
        raise ValueError(f"recording: expected {EPISODE}N after the folder of a LeRobot data set, got {reference}")
    elif path.suffix == ".npz":
        return recordings.read(path)
    elif path.suffix == ".mcap":
        rollout = mcap.read(path)
    else:
        raise ValueError(f"recording: expected {FORMATS}, got {str(path)!r}")
    try:
        return of_rollout(rollout)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write(path: str | Path, several: Sequence[Recording]) -> None:
    """Write recordings in the format given by a path's name.

    Args:
        path: a new NAME.npz or NAME.mcap for one recording, or a new folder without a suffix: a LeRobot data set with
            an episode for each.
        several: the recordings, at least one.

    Raises:
        ValueError: for another name, a path that exists, several recordings for a file of one, and recordings of
            different frame rates.
        ImportError: if the extra `robotics` is needed and not installed.
    """
    path = Path(path)
    if path.suffix not in ("", ".npz", ".mcap"):
        raise ValueError(f"path: expected {FORMATS}, got {str(path)!r}")
    if path.suffix and len(several) != 1:
        raise ValueError(f"path: expected a folder for {len(several)} recordings, got {path}, which holds one")
    if path.suffix == ".npz":
        recordings.write(path, several[0])
    elif path.suffix == ".mcap":
        mcap.write(path, as_rollout(several[0]))
    else:
        rates = {one.frame_rate for one in several}
        if len(rates) > 1:
            shown = ", ".join(f"{rate:g}" for rate in sorted(rates))
            raise ValueError(f"frame_rate: expected the same of all episodes of a data set, got {shown} Hz")
        lerobot.write(path, [as_rollout(one) for one in several], STATE, several[0].frame_rate)


def as_rollout(recording: Recording) -> Rollout:
    """A recording as signals."""
    arrays = recordings.arrays_of(recording)
    times = arrays["times"]
    signals = {
        name: Signal(times, arrays[array].reshape(times.size, -1), names, UNITS[array])
        for name, (array, names) in OBSERVED.items()
        if array in arrays
    }
    interval = recording.control_interval
    signals[ACTION] = Signal(interval * np.arange(STEPS), arrays["actions"], ACTIONS, UNITS["actions"], interval)
    return Rollout(signals, json_safe(recordings.describe(recording)), TASK)


def of_rollout(rollout: Rollout) -> Recording:
    """The recording that signals make up; those with other names are ignored.

    Raises:
        ValueError: for signals that are missing or have other components, and anything else that is not a recording.
    """
    signals, where = rollout.signals, "the rollout's metadata"
    expected = {name: names for name, (_, names) in OBSERVED.items()} | {ACTION: ACTIONS}
    if missing := [name for name in expected if name not in signals and name != "observation.hits"]:
        raise ValueError(
            f"expected a rollout of the whip with {', '.join(expected)}, got no {', '.join(missing)} among "
            f"{', '.join(signals) or 'nothing'}; docs/recordings.md says what to rename"
        )
    for name, names in expected.items():
        if name in signals and signals[name].names != names:
            raise ValueError(f"{name}: expected {_few(names)}, got {_few(signals[name].names)}")
    described = recordings.checked(rollout.metadata, where)
    times = signals[STATE].times
    arrays = {"times": times}
    for name, (array, names) in OBSERVED.items():
        if name not in signals:
            continue
        if not np.array_equal(signals[name].times, times):
            raise ValueError(f"{name}: expected the time stamps of {STATE}, got others")
        shape = (times.size, -1, 2) if array == "keypoints" else (times.size, len(names))
        arrays[array] = signals[name].values.reshape(shape)
    action = signals[ACTION]
    try:
        with_frames = action.duration is None and np.array_equal(action.times, times)
        arrays["actions"] = action.each(described["control_interval"], STEPS) if with_frames else action.values
    except ValueError as error:
        raise ValueError(f"{ACTION}: {error}") from error
    return recordings.made_of(arrays, described, where)


def _few(names: Sequence[str]) -> str:
    """The number of names, and the first few of them."""
    shown = ", ".join(names[:3])
    return f"{len(names)} numbers ({shown}{', ...' if len(names) > 3 else ''})"
