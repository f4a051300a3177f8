"""Recorded rollouts of one object, real or simulated: a file format, and the trajectory that inference sees.

A recording NAME consists of two files: NAME.npz with the arrays below (others are ignored), and NAME.json, which
describes them. `jaxlfi whip render` writes such a recording of a simulated DLO, rollout.npz and rollout.json. Other
formats of the same recordings: `jaxlfi.envs.whip.formats`.

| NAME.npz    | shape      | unit              | what                                                            |
|-------------|------------|-------------------|-----------------------------------------------------------------|
| `times`     | [F]        | s                 | of the frames; 0 is when the first action begins                |
| `gripper`   | [F, 2]     | m                 | x and z of the gripper, as measured                             |
| `keypoints` | [F, 10, 2] | normalised pixels | u to the right, v down, 0 to 1 across the image                 |
| `seen`      | [F, 10]    | boolean           | keypoints that were found; the others are not used, may be NaN  |
| `actions`   | [16, 2]    | m                 | displacements dx, dz of the set-point, one a control interval   |
| `hits`      | [F, 6]     | boolean           | cubes hit so far, bottom-up; may be left out                    |

| NAME.json          | what                                                                                          |
|--------------------|-----------------------------------------------------------------------------------------------|
| `schema`           | "jaxlfi.whip.recording"                                                                       |
| `version`          | 1                                                                                             |
| `source`           | "real" or "simulated"                                                                         |
| `description`      | free text                                                                                     |
| `frame_rate`       | of the frames, in Hz                                                                          |
| `control_interval` | between two actions, in s                                                                     |
| `units`            | of each array, as above                                                                       |
| `keypoints`        | their names in order: "dlo 1" to "dlo 4", then the cubes' colours, bottom-up                  |
| `camera`           | `position` in m, `orientation` as in `vision.camera.Camera`, `field_of_view` in degrees,      |
|                    | `image_size` in pixels                                                                        |
| `colours`          | of what is seen, as "#RRGGBB", by name                                                        |
| `facts`            | what is known of the object, for people to read: inference does not use it                    |
| `provenance`       | where the recording comes from, for people to read                                            |
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.observer import hits_so_far
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, KEYPOINTS, ON_DLO
from jaxlfi.envs.whip.rules import ACTION_LIMIT, STEPS
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.io import files as atomic
from jaxlfi.io.formats import require_version

SCHEMA, VERSION = "jaxlfi.whip.recording", 1
SOURCES = ("simulated", "real")
UNITS = {
    "times": "s",
    "gripper": "m",
    "keypoints": "normalised pixels",
    "seen": "boolean",
    "actions": "m",
    "hits": "boolean",
}
ORDER = (*(f"dlo {i + 1}" for i in range(ON_DLO)), *COLOURS)
"""Names of the keypoints, in order."""
_DESCRIBED = {
    "source": str,
    "description": str,
    "frame_rate": float,
    "control_interval": float,
    "camera": dict,
    "colours": dict,
    "facts": dict,
    "provenance": dict,
}
"""Entries of the description that differ between recordings, and their types."""
_CAMERA = ("position", "orientation", "field_of_view")


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """One rollout of an object, as a camera saw it.

    Attributes:
        times: times of the F frames, in s; 0 is when the first action begins.
        gripper: x and z of the gripper, in m, shape [F, 2].
        keypoints: four on the DLO and six cubes, in normalised pixels, shape [F, 10, 2].
        seen: keypoints that were found, shape [F, 10].
        actions: displacements of the set-point, one per control interval, in m, shape [16, 2].
        camera: camera through which the keypoints were seen.
        source: "simulated" or "real".
        description: free text.
        frame_rate: frame rate, in Hz.
        control_interval: time between two actions, in s.
        image_size: side of the images that the keypoints are from, in pixels.
        hits: cubes hit so far, shape [F, 6], if they were recorded.
        colours: colours of the visible objects, as "#RRGGBB", by name.
        facts: what is known of the object; inference does not use it.
        provenance: where the recording comes from.

    Raises:
        ValueError: for anything that does not fit, naming it.
    """

    times: Float[np.ndarray, " frames"]
    gripper: Float[np.ndarray, "frames 2"]
    keypoints: Float[np.ndarray, "frames 10 2"]
    seen: Bool[np.ndarray, "frames 10"]
    actions: Float[np.ndarray, "16 2"]
    camera: Camera
    source: str
    description: str
    frame_rate: float
    control_interval: float = CONTROL_INTERVAL
    image_size: int = 256
    hits: Bool[np.ndarray, "frames 6"] | None = None
    colours: Mapping[str, str] = dataclasses.field(default_factory=dict)
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for name in ("times", "gripper", "keypoints", "actions", "seen", "hits"):
            value = getattr(self, name)
            if value is not None or name != "hits":
                kind = bool if UNITS[name] == "boolean" else float
                object.__setattr__(self, name, _array(name, value, kind))
        _check_scalars(self)
        _check_arrays(self)


def simulated(arrays: Mapping[str, np.ndarray], camera: Camera, description: str) -> Recording:
    """A rollout of the simulator as a recording, with one frame per control interval.

    Keypoints outside of the image count as not seen.

    Args:
        arrays: `times`, `gripper`, `keypoints`, `seen`, `actions` and `hits`, as in a file.
        camera: camera through which the rollout was seen.
        description: free text.

    Raises:
        ValueError: for a rollout that is not a recording, such as one whose DLO never enters the image.
    """
    inside = (np.abs(arrays["keypoints"] - 0.5) <= 0.5).all(axis=-1)
    return Recording(
        **{name: arrays[name] for name in ("times", "gripper", "keypoints", "hits")},
        seen=arrays["seen"] & inside,
        actions=np.clip(arrays["actions"], -ACTION_LIMIT, ACTION_LIMIT),
        camera=camera,
        source="simulated",
        description=description,
        frame_rate=1 / CONTROL_INTERVAL,
    )


def write(path: str | Path, recording: Recording, others: Mapping[str, np.ndarray] | None = None) -> None:
    """Write NAME.npz and NAME.json.

    Args:
        path: NAME.npz; neither file may exist.
        recording: the recording; times are written in double precision, the rest in single.
        others: further arrays for NAME.npz, with other names.

    Raises:
        ValueError: for another name, or files that exist.
    """
    arrays, description = _files(path)
    for file in (arrays, description):
        if file.exists():
            raise ValueError(f"path: expected a new recording, got {file}, which exists")
    # A recording is complete once the second file exists.
    atomic.write_arrays(arrays, {**(others or {}), **arrays_of(recording)})
    atomic.write_json(description, describe(recording))


def read(path: str | Path) -> Recording:
    """Read a recording.

    Args:
        path: NAME.npz; NAME.json is read from the same folder.

    Raises:
        ValueError: for files that are missing, damaged, of another kind or version, or that do not fit.
    """
    arrays, description = _files(path)
    values = atomic.read_arrays(arrays)
    try:
        return made_of(values, _description(description), description.name)
    except ValueError as error:
        raise ValueError(f"{arrays.with_suffix('')}: {error}") from error


def arrays_of(recording: Recording) -> dict[str, np.ndarray]:
    """The arrays of a recording as stored in files: times in double precision, other numbers in single."""
    named = {name: getattr(recording, name) for name in UNITS if getattr(recording, name) is not None}
    single = lambda name, value: np.asarray(value, np.float32) if value.dtype == float and name != "times" else value
    return {name: single(name, value) for name, value in named.items()}


def describe(recording: Recording) -> dict[str, Any]:
    """The description of a recording as stored in files."""
    units = {name: UNITS[name] for name in UNITS if getattr(recording, name) is not None}
    described = {name: getattr(recording, name) for name in _DESCRIBED if name != "camera"}
    camera = {name: np.asarray(getattr(recording.camera, name), float).tolist() for name in _CAMERA}
    return {
        **{"schema": SCHEMA, "version": VERSION, "units": units, "keypoints": list(ORDER)},
        **described,
        "camera": {**camera, "image_size": recording.image_size},
    }


def made_of(arrays: Mapping[str, np.ndarray], described: Any, where: str) -> Recording:
    """The recording that arrays and a description make up.

    Args:
        arrays: arrays by their names in a file; others are ignored.
        described: contents of the description.
        where: source of the description, for error messages.

    Raises:
        ValueError: for a description of another kind or version, and arrays that do not fit.
    """
    described = dict(checked(described, where))
    if missing := set(described["units"]) - set(arrays):
        raise ValueError(f"arrays: expected {sorted(described['units'])}, got no {', '.join(sorted(missing))}")
    values = {name: arrays[name] for name in described["units"]}
    camera = described.pop("camera")
    view = Camera(**{name: jnp.asarray(_array("camera", camera[name], float), jnp.float32) for name in _CAMERA})
    rest = {name: described[name] for name in _DESCRIBED if name in described}
    return Recording(**values, **rest, camera=view, image_size=camera["image_size"])


def _files(path: str | Path) -> tuple[Path, Path]:
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"path: expected a recording's .npz file, got {str(path)!r}")
    return path, path.with_suffix(".json")


def _description(path: Path) -> Any:
    if not path.exists():
        raise ValueError(f"a recording is two files: expected a description in {path.name} beside the .npz, got none")
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:  # ValueError: not text, not JSON, or too long a number
        raise ValueError(f"expected a description in {path.name}, got {type(error).__name__}") from error


def checked(described: Any, where: str) -> dict[str, Any]:
    """Return a description if it is that of a recording that can be read.

    Raises:
        ValueError: for others, naming their source `where`.
    """
    if not isinstance(described, dict) or described.get("schema") != SCHEMA:
        raise ValueError(f"schema: expected {SCHEMA!r} in {where}, got another kind of file")
    require_version(where, SCHEMA, VERSION, described.get("version"))
    for name, kind in {**_DESCRIBED, "units": dict, "keypoints": list}.items():
        if name not in described:
            raise ValueError(f"{name}: expected in {where}, got none")
        if not isinstance(described[name], int | float if kind is float else kind):
            raise ValueError(f"{name}: expected a {kind.__name__}, got {described[name]!r}")
    required = {name: unit for name, unit in UNITS.items() if name != "hits" or name in described["units"]}
    if described["units"] != required:
        raise ValueError(f"units: expected {required}, got {described['units']}")
    if described["keypoints"] != list(ORDER):
        raise ValueError(f"keypoints: expected the order {list(ORDER)}, got {described['keypoints']}")
    if set(described["camera"]) != {*_CAMERA, "image_size"}:
        raise ValueError(f"camera: expected {[*_CAMERA, 'image_size']}, got {sorted(described['camera'])}")
    return described


def _array(name: str, value: Any, kind: type) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name}: expected an array of {kind.__name__}s, got {value!r}") from error
    if array.dtype.kind not in {bool: "b", float: "fiu"}[kind]:
        raise ValueError(f"{name}: expected an array of {kind.__name__}s, got {array.dtype}")
    array = array.astype(kind)
    array.setflags(write=False)
    return array


def _check_scalars(recording: Recording) -> None:
    if recording.source not in SOURCES:
        raise ValueError(f"source: expected one of {SOURCES}, got {recording.source!r}")
    for name in ("frame_rate", "control_interval", "image_size"):
        value = getattr(recording, name)
        if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: expected a positive number, got {value!r}")
    camera = [np.asarray(getattr(recording.camera, name), float) for name in _CAMERA]
    if [value.shape for value in camera] != [(3,), (4,), ()] or not all(np.isfinite(value).all() for value in camera):
        raise ValueError(
            f"camera: expected a position [3], an orientation [4] and a field of view, got {recording.camera}"
        )
    if abs(np.linalg.norm(camera[1]) - 1) > 1e-3:
        raise ValueError(f"camera: expected a unit quaternion for its orientation, got {camera[1].tolist()}")
    if not 0 < camera[2] < 180:
        raise ValueError(f"camera: expected a field of view between 0 and 180 degrees, got {camera[2]}")


def _check_arrays(recording: Recording) -> None:
    times, seen, actions, hits = recording.times, recording.seen, recording.actions, recording.hits
    frames = times.size
    shapes = {
        "times": (frames,),
        "gripper": (frames, 2),
        "keypoints": (frames, KEYPOINTS, 2),
        "seen": (frames, KEYPOINTS),
        "actions": (STEPS, 2),
        "hits": (frames, len(COLOURS)),
    }
    for name, shape in shapes.items():
        value = getattr(recording, name)
        if value is not None and value.shape != shape:
            raise ValueError(f"{name}: expected shape {list(shape)}, got {list(value.shape)}")
    _check_times(recording)
    for name in ("gripper", "actions"):
        if not np.isfinite(getattr(recording, name)).all():
            raise ValueError(f"{name}: expected finite numbers, got some that are not")
    if not np.isfinite(recording.keypoints[seen]).all():
        raise ValueError("keypoints: expected finite numbers where they are seen, got some that are not")
    if (np.abs(recording.keypoints[seen] - 0.5) > 0.55).any():
        raise ValueError("keypoints: expected normalised pixels, from 0 to 1 across the image, got some far outside")
    if not seen.any(axis=0).all():
        never = [name for name, once in zip(ORDER, seen.any(axis=0), strict=True) if not once]
        raise ValueError(f"seen: expected every keypoint to be seen at least once, got never {never}")
    if (np.abs(actions) > ACTION_LIMIT + 1e-6).any():
        raise ValueError(
            f"actions: expected displacements of at most {ACTION_LIMIT} m, got one of {np.abs(actions).max():g}"
        )
    if hits is not None and (hits[:-1] & ~hits[1:]).any():
        raise ValueError("hits: expected that a cube that has been hit stays hit, got one that does not")


def _check_times(recording: Recording) -> None:
    times, rate = recording.times, recording.frame_rate
    if times.size < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("times: expected at least two increasing time stamps in s, got others")
    measured = 1 / np.median(np.diff(times))
    if abs(measured / rate - 1) > 0.05:  # the median, as cameras drop frames
        raise ValueError(f"frame_rate: expected what the time stamps say, {measured:.4g} Hz, got {rate:g}")
    end = STEPS * recording.control_interval
    if times[0] > 0.5 / rate or times[-1] < end - 1.5 / rate:
        raise ValueError(f"times: expected frames from 0 to {end:g} s, got {times[0]:g} to {times[-1]:g}")


def filled(recording: Recording) -> Float[np.ndarray, "frames 10 2"]:
    """Keypoints of all frames: those not seen are interpolated linearly between the frames in which they were.

    Before the first and after the last of these frames, they keep the position that they have in it.
    """
    out = np.empty_like(recording.keypoints)
    for k in range(KEYPOINTS):
        seen = recording.seen[:, k]
        for axis in range(2):
            out[:, k, axis] = np.interp(recording.times, recording.times[seen], recording.keypoints[seen, k, axis])
    return out


def hit_flags(recording: Recording) -> Bool[np.ndarray, "frames 6"]:
    """Cubes hit so far: as recorded, or else those whose keypoint has been further than 0.06 from its start."""
    if recording.hits is not None:
        return recording.hits
    return hits_so_far(filled(recording))


def resample(recording: Recording) -> Float[np.ndarray, "17 28"]:
    """States before each action and after the last one (section VI-E), for any frame rate.

    Positions are interpolated between the nearest frames; a flag is that of the latest frame.

    Returns:
        The gripper's x and z in m, ten keypoints in normalised pixels, six flags; shape [17, 28].
    """
    times, boundaries = recording.times, np.arange(STEPS + 1) * recording.control_interval
    positions = np.concatenate([recording.gripper, filled(recording).reshape(times.size, -1)], axis=1)
    moving = np.stack([np.interp(boundaries, times, column) for column in positions.T], axis=1)
    last = np.searchsorted(times, boundaries + 1e-6, side="right") - 1
    flags = hit_flags(recording)[np.maximum(last, 0)]
    return np.concatenate([moving, flags], axis=1).astype(np.float32)


def trajectory(recording: Recording) -> Float[np.ndarray, "16 30"]:
    """The trajectory for inference: the state before each action, and the action (section VI-F), shape [16, 30]."""
    actions = recording.actions.astype(np.float32)
    return np.concatenate([resample(recording)[:STEPS], actions], axis=1)
