"""LeRobot data sets, version 3: folders of Parquet and JSON files that hold episodes as rows at a camera's rate.

meta/info.json                              version, frame rate, and the features: type, shape and names of each column
meta/stats.json                             minimum, maximum, mean, standard deviation and quantiles of the features
meta/tasks.parquet                          descriptions of the tasks
meta/episodes/chunk-000/file-000.parquet    one row per episode: where its frames are
data/chunk-000/file-000.parquet             one row per frame

A data set's rows are regular in time: `timestamp` is the frame's number divided by the frame rate. The recorded time
stamps are the feature `time`, in double precision. Signals that are not sampled with the frames, such as actions at a
rate of their own, are held from frame to frame, which is what LeRobot's learners see; their original samples are in the
column `jaxlfi` of the episodes, with the metadata of the rollout. Videos are not read.

Needs the extra `robotics` (pyarrow), but not the package lerobot.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io import clocks, files, units
from jaxlfi.io.formats import require_version
from jaxlfi.io.rollout import Rollout, Signal, array, numbers

VERSION = "v3.0"
COLUMN, COLUMN_VERSION = "jaxlfi", 1
"""Column of the episodes with what rows at the frame rate cannot hold, as JSON, and the version of that JSON."""
CLOCK = "time"
"""Feature of the frames' time stamps, in s."""
COUNTED = ("frame_index", "episode_index", "index", "task_index")
_EVERY = {"timestamp": {"dtype": "float32", "shape": [1]}, "frame_index": {"dtype": "int64", "shape": [1]}}
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
INSTALL = "LeRobot data sets need the package pyarrow: pip install 'jaxlfi[robotics]'"
EPISODE, EPISODES_OF = "#episode=", "#episodes="
"""Separators of a data set's folder from the number of an episode, or from the first and last of several."""
FARTHEST = 100.0
"""Largest median interval between successive time stamps, in intervals of the frame rate."""
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def write(path: str | Path, rollouts: Sequence[Rollout], clock: str, fps: float, robot_type: str | None = None) -> None:
    """Write a data set, with one episode for each rollout.

    Args:
        path: a new folder.
        rollouts: rollouts, all with the same signals.
        clock: the signal whose time stamps are those of the frames.
        fps: nominal rate of the frames, in Hz.
        robot_type: type of the robot.

    Raises:
        ValueError: for a path that exists, and rollouts that do not belong together.
        ImportError: without pyarrow.
    """
    path = Path(path)
    if path.exists():
        raise ValueError(f"path: expected a new folder, got {path}, which exists")
    features = _features(rollouts, clock)
    pyarrow, parquet = _libraries()
    tasks = list(dict.fromkeys(rollout.task for rollout in rollouts))
    frames = _frames(rollouts, tasks, clock, fps)
    total = sum(len(columns[CLOCK]) for columns in frames)
    info = {
        "codebase_version": VERSION,
        "robot_type": robot_type,
        **{"total_episodes": len(rollouts), "total_frames": total, "total_tasks": len(tasks)},
        **{"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200},
        "fps": int(fps) if float(fps).is_integer() else float(fps),
        "splits": {"train": f"0:{len(rollouts)}"},
        **{"data_path": DATA, "video_path": None},
        "features": features,
    }
    everything = {name: np.concatenate([columns[name] for columns in frames]) for name in features}
    rows = [_episode(rollout, columns, clock) for rollout, columns in zip(rollouts, frames, strict=True)]
    tables = [_rows_table(pyarrow, columns) for columns in frames]
    # The folder appears when it is complete.
    staging = path.with_name(f".{path.name}.{os.getpid()}.part")
    data = staging / DATA.format(chunk_index=0, file_index=0)
    try:
        for file in (staging / EPISODES, data):
            file.parent.mkdir(parents=True)
        files.write_json(staging / "meta/info.json", info)
        files.write_json(staging / "meta/stats.json", {name: _stats(values) for name, values in everything.items()})
        parquet.write_table(_tasks_table(pyarrow, tasks), staging / "meta/tasks.parquet")
        parquet.write_table(pyarrow.Table.from_pylist(rows), staging / EPISODES, write_page_checksum=True)
        # A row group for each episode, as LeRobot writes them, so that one can be read without the others.
        with parquet.ParquetWriter(data, tables[0].schema, write_page_checksum=True) as writer:
            for table in tables:
                writer.write_table(table)
        staging.rename(path)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def episodes(path: str | Path) -> list[int]:
    """Numbers of the episodes of a data set.

    Raises:
        ValueError: for folders that are not data sets, damaged or of another version.
        ImportError: without pyarrow.
    """
    path = Path(path)
    _info(path)
    try:
        return sorted(_episodes(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def located(reference: str | Path) -> tuple[Path, int | None]:
    """The path and, after "#episode=", the number that a reference names.

    Raises:
        ValueError: if that is not a number.
    """
    path, mark, number = str(reference).rpartition(EPISODE)
    if not mark or Path(reference).exists():
        return Path(reference), None
    if not (number.isascii() and number.isdigit()):
        raise ValueError(f"recording: expected a number after {EPISODE}, got {number!r}")
    return Path(path), int(number)


def selected(reference: str | Path) -> tuple[Path, Sequence[int] | None]:
    """The path and the numbers of the episodes that a reference names: after "#episode=", or "#episodes=" as 0-9.

    Raises:
        ValueError: if these are not numbers.
    """
    path, mark, span = str(reference).rpartition(EPISODES_OF)
    if not mark or Path(reference).exists():
        path, episode = located(reference)
        return path, None if episode is None else [episode]
    first, dash, last = span.partition("-")
    numbers = [int(text) if text.isascii() and text.isdigit() else -1 for text in (first, last if dash else first)]
    if min(numbers) < 0 or numbers[1] < numbers[0]:
        raise ValueError(f"recording: expected the first and the last number after {EPISODES_OF}, as 0-9, got {span!r}")
    return Path(path), range(numbers[0], numbers[1] + 1)


def read(path: str | Path, episode: int | None = None) -> Rollout:
    """Read an episode of a data set.

    Features that are not numbers, such as images, are left out; those of several dimensions become vectors.

    Args:
        path: the data set's folder.
        episode: number of the episode; it may be omitted if there is only one.

    Raises:
        ValueError: for folders that are not data sets, damaged or of another version, and episodes that are not there.
        ImportError: without pyarrow.
    """
    (rollout,) = read_several(path, None if episode is None else [episode])
    return rollout


def read_several(path: str | Path, numbers: Sequence[int] | None) -> Iterator[Rollout]:
    """Read episodes of a data set, one after another.

    Args:
        path: the data set's folder.
        numbers: numbers of the episodes; they may be omitted if there is only one.

    Raises:
        ValueError: for folders that are not data sets, damaged or of another version, and episodes that are not there.
        ImportError: without pyarrow.
    """
    path = Path(path)
    info = _info(path)
    try:
        listed = _episodes(path)
        if numbers is None and len(listed) != 1:
            raise ValueError(
                f"expected the number of one of its {len(listed)} episodes, got none: name it as "
                f"{path.name}{EPISODE}{min(listed)}, or several as {path.name}{EPISODES_OF}{min(listed)}-{max(listed)}"
            )
        chosen = list(listed) if numbers is None else numbers
        if missing := [number for number in chosen if number not in listed]:
            raise ValueError(f"expected an episode from {min(listed)} to {max(listed)}, got {missing[0]}")
        for number in chosen:
            yield _rollout(path, info, number, listed[number])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _libraries() -> tuple[Any, Any]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(INSTALL) from error
    return pyarrow, parquet


# ----------------------------------------------------------------------------------------------------------- writing


def _features(rollouts: Sequence[Rollout], clock: str) -> dict[str, dict[str, Any]]:
    """The features as info.json describes them."""
    if not rollouts:
        raise ValueError("rollouts: expected at least one, got none")

    def described(rollout: Rollout) -> dict[str, dict[str, Any]]:
        if clock not in rollout.signals:
            raise ValueError(f"clock: expected one of {', '.join(rollout.signals)}, got {clock!r}")
        if taken := {CLOCK, "timestamp", *COUNTED} & set(rollout.signals):
            raise ValueError(f"signals: expected other names than the data set's own, got {', '.join(sorted(taken))}")
        return {
            name: {
                "dtype": signal.values.dtype.name,
                "shape": [signal.values.shape[1]],
                "names": list(signal.names),
                "info": {"unit": signal.unit},
            }
            for name, signal in rollout.signals.items()
        }

    first = described(rollouts[0])
    for rollout in rollouts[1:]:
        if (other := described(rollout)) != first:
            different = sorted(name for name in {*first, *other} if first.get(name) != other.get(name))
            raise ValueError(f"rollouts: expected the same signals in all, got different {', '.join(different)}")
    plain = lambda dtype: {"dtype": dtype, "shape": [1], "names": None}
    own = {CLOCK: plain("float64"), "timestamp": plain("float32")} | {name: plain("int64") for name in COUNTED}
    return first | own


def _frames(rollouts: Sequence[Rollout], tasks: Sequence[str], clock: str, fps: float) -> list[dict[str, np.ndarray]]:
    """Columns of each episode's frames by name, each of shape [F, n]."""
    made, total = [], 0
    for episode, rollout in enumerate(rollouts):
        times = rollout.signals[clock].times
        columns = {
            name: signal.values if _with_frames(signal, times) else signal.held(times)
            for name, signal in rollout.signals.items()
        }
        number = np.arange(times.size)
        own = {
            CLOCK: times,
            "timestamp": (number / fps).astype(np.float32),
            "frame_index": number,
            "episode_index": np.full(times.size, episode),
            "index": total + number,
            "task_index": np.full(times.size, tasks.index(rollout.task)),
        }
        made.append(columns | {name: values[:, None] for name, values in own.items()})
        total += times.size
    return made


def _with_frames(signal: Signal, times: np.ndarray) -> bool:
    return signal.duration is None and np.array_equal(signal.times, times)


def _rows_table(pyarrow: Any, columns: Mapping[str, np.ndarray]) -> Any:
    def column(values: np.ndarray) -> Any:
        flat = pyarrow.array(np.ascontiguousarray(values).ravel())
        return flat if values.shape[1] == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])

    return pyarrow.table({name: column(values) for name, values in columns.items()})


def _episode(rollout: Rollout, columns: Mapping[str, np.ndarray], clock: str) -> dict[str, Any]:
    """A row of the table of episodes."""
    frames = rollout.signals[clock].times
    apart = {
        name: {"times": signal.times.tolist(), "values": numbers(signal.values), "duration": signal.duration}
        for name, signal in rollout.signals.items()
        if not _with_frames(signal, frames)
    }
    own = {"version": COLUMN_VERSION, "metadata": dict(rollout.metadata), "signals": apart}
    stats = {f"stats/{name}/{word}": value for name, rows in columns.items() for word, value in _stats(rows).items()}
    first = int(columns["index"][0, 0])
    return {
        "episode_index": int(columns["episode_index"][0, 0]),
        "tasks": [rollout.task],
        "length": frames.size,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": first,
        "dataset_to_index": first + frames.size,
        **stats,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        COLUMN: json.dumps(own, allow_nan=False),
    }


def _stats(rows: np.ndarray) -> dict[str, list]:
    """Statistics of the finite values in each column of rows [N, n]; zero for a column without any."""
    values = rows.astype(float)
    values[~np.isfinite(values)] = np.nan
    values[:, np.isnan(values).all(axis=0)] = 0.0
    made = {"min": np.nanmin, "max": np.nanmax, "mean": np.nanmean, "std": np.nanstd}
    stats = {name: function(values, axis=0).tolist() for name, function in made.items()}
    quantiles = np.nanquantile(values, list(QUANTILES.values()), axis=0)
    return {**stats, "count": [len(rows)], **dict(zip(QUANTILES, quantiles.tolist(), strict=True))}


def _tasks_table(pyarrow: Any, tasks: Sequence[str]) -> Any:
    """A table of tasks whose descriptions become the index in pandas, with which LeRobot reads it."""
    column = lambda name, kind, numpy: {
        **{"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy},
        "metadata": None,
    }
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.0.0",
    }
    table = pyarrow.table({"task_index": np.arange(len(tasks)), "task": list(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


# ----------------------------------------------------------------------------------------------------------- reading


def _info(path: Path) -> dict[str, Any]:
    """The content of meta/info.json, if it is of a version that can be read."""
    try:
        info = json.loads((path / "meta/info.json").read_text())
        version, features = str(info["codebase_version"]), info["features"]
        major = int(version.removeprefix("v").split(".")[0])
        info["data_path"].format(chunk_index=0, file_index=0)
        if not all(isinstance(feature, dict) and "dtype" in feature for feature in features.values()):
            raise TypeError("features are described by their dtype")
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected a LeRobot data set, got a folder without a readable meta/info.json"
        ) from error
    if major < 3:
        raise ValueError(
            f"{path}: expected a LeRobot data set of {VERSION}, got {version}: convert it with LeRobot's "
            "convert_dataset_v21_to_v30"
        )
    if major > 3:
        raise ValueError(f"{path}: expected a LeRobot data set of {VERSION}, got {version}: a newer jaxlfi may read it")
    return info


def _table(path: Path, columns: Sequence[str] | None = None, filters: Any = None) -> Any:
    _, parquet = _libraries()
    try:
        table = parquet.read_table(path, columns=columns, filters=filters, page_checksum_verification=True)
        table.validate()
    except Exception as error:  # pyarrow and the operating system each raise their own for a damaged file
        raise ValueError(
            f"expected a complete Parquet file {path.name} with {columns}, got {files.first_line(error)}"
        ) from error
    return table


def _episodes(path: Path) -> dict[int, dict[str, Any]]:
    """The rows of the table of episodes, by episode number."""
    found = {}
    for file in sorted((path / "meta/episodes").glob("*/*.parquet")):
        _, parquet = _libraries()
        needed = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        try:
            names = parquet.read_schema(file).names
        except Exception as error:
            raise ValueError(f"expected a complete Parquet file {file.name}, got {files.first_line(error)}") from error
        needed += [name for name in ("tasks", COLUMN) if name in names]
        found |= {row["episode_index"]: row for row in _table(file, needed).to_pylist()}
    if not found:
        raise ValueError("expected episodes in meta/episodes/*/*.parquet, got none")
    return found


def _rollout(path: Path, info: Mapping[str, Any], number: int, row: Mapping[str, Any]) -> Rollout:
    features = {
        name: feature
        for name, feature in info["features"].items()
        if feature["dtype"] not in ("image", "video", "string", "language")
    }
    own = _own(row.get(COLUMN))
    file = path / info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
    features |= {name: feature for name, feature in _unlisted(file).items() if name not in features}
    names = [name for name in features if name not in COUNTED or name == "frame_index"]
    table = _table(file, names, [("episode_index", "=", number)])
    if table.num_rows != row["length"] or not table.num_rows:
        raise ValueError(f"expected {row['length']} frames of episode {number} in {file.name}, got {table.num_rows}")
    columns = {name: _values(name, table.column(name), feature) for name, feature in features.items() if name in names}
    clock = CLOCK if CLOCK in columns and columns[CLOCK].shape[1] == 1 else "timestamp"
    if clock not in columns:
        raise ValueError("expected a feature timestamp, got none")
    times = _seconds(clock, columns[clock][:, 0], features[clock], info.get("fps"))
    times = _of_frames(times, columns.get("frame_index"), info.get("fps")) if clock != CLOCK else times
    frames, fault = clocks.order(times, "frame", repeated=True)
    if not len(frames):
        raise ValueError(f"{clock}: expected finite times, got {fault}")
    times, signals = times[frames], {}
    for name, recorded in columns.items():
        if name in (CLOCK, "timestamp", *COUNTED):
            continue
        values = recorded[frames]
        words = _words(name, features[name].get("names"), values.shape[1])
        unit = _unit(name, features[name])
        signal = Signal(times, values, words, unit)
        if name in own["signals"]:
            apart = own["signals"][name]
            exact = array(apart["values"], values.dtype.name).reshape(-1, values.shape[1])
            signal = Signal(apart["times"], exact, words, unit, apart["duration"])
            if not np.array_equal(signal.held(times), values, equal_nan=values.dtype.kind == "f"):
                raise ValueError(
                    f"{name}: expected what the column {COLUMN!r} of episode {number} says of it, got other values; "
                    "remove the entry from that column if the rows are right"
                )
        signals[name] = signal
    if not signals:
        raise ValueError(f"expected features that are numbers, got {', '.join(info['features'])}")
    faults = (f"{clock}: expected times in order, got {fault}",) if fault else ()
    return Rollout(signals, own["metadata"], (row.get("tasks") or [""])[0], faults)


def _unlisted(file: Path) -> dict[str, dict[str, Any]]:
    """Features that every data set has, if this file has them: not every info.json lists them."""
    _, parquet = _libraries()
    try:
        there = parquet.read_schema(file).names
    except Exception:
        return {}  # the file is refused when its rows are read
    return {name: feature for name, feature in _EVERY.items() if name in there}


def _unit(name: str, feature: Mapping[str, Any]) -> str | tuple[str, ...]:
    """The unit of a feature's numbers, or one unit for each, if its description gives them."""
    info = feature.get("info") or {}
    unit = (info.get("unit") or info.get("units") or "") if isinstance(info, Mapping) else ""
    if isinstance(unit, list) and all(isinstance(one, str) for one in unit):
        return tuple(unit)
    if not isinstance(unit, str):
        raise ValueError(f"{name}: expected a unit as text, or a list of them, got {unit!r}")
    return unit


def _seconds(name: str, times: np.ndarray, feature: Mapping[str, Any], fps: Any) -> np.ndarray:
    """Time stamps in s, converted from the data set's unit; refused if much farther apart than its frames."""
    unit = units.parse(str(_unit(name, feature)))
    if unit.name not in ("", "s"):
        raise ValueError(f"{name}: expected a unit of time, got {_unit(name, feature)!r}")
    seconds = unit.factor * times.astype(float)
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    if isinstance(fps, int | float) and fps > 0 and step * fps > FARTHEST:
        looks = units.looks_like(step, 1 / fps, ("ms", "us", "ns"))
        raise ValueError(
            f"{name}: expected seconds, {1 / fps:.3g} apart at {fps:g} frames a second, got {step:.6g} apart: they "
            f'look like {looks}; say so in meta/info.json, as "info": {{"unit": "{looks}"}} of this feature'
        )
    return seconds


def _of_frames(times: np.ndarray, numbers: np.ndarray | None, fps: Any) -> np.ndarray:
    """Times of frames from their numbers, if the time stamps are equal to these up to single precision."""
    if numbers is None or not isinstance(fps, int | float) or not fps > 0:
        return times
    exact = numbers[:, 0] / fps
    return exact if np.allclose(times, exact, rtol=2e-7, atol=1e-9) else times


def _own(text: str | None) -> dict[str, Any]:
    """The content of jaxlfi's column of the episodes; empty if there is none."""
    if text is None:
        return {"metadata": {}, "signals": {}}
    try:
        own = json.loads(text)
        version, _, signals = own["version"], dict(own["metadata"]), own["signals"]
        complete = all({"times", "values", "duration"} <= set(signal) for signal in signals.values())
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected JSON of jaxlfi in the column {COLUMN!r} of the episodes, got another") from error
    require_version(f"column {COLUMN!r} of the episodes", COLUMN, COLUMN_VERSION, version)
    if not complete:
        raise ValueError(f"expected JSON of jaxlfi in the column {COLUMN!r} of the episodes, got incomplete signals")
    return own


def _values(name: str, column: Any, feature: Mapping[str, Any]) -> np.ndarray:
    """A column as vectors, shape [F, n]."""
    try:
        rows = np.array(column.to_pylist(), dtype=np.dtype(feature["dtype"]))
        if rows.dtype.kind not in "biuf":
            raise TypeError(f"{rows.dtype} is no type of numbers")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: expected rows of {feature['dtype']} of one size, got others") from error
    return rows.reshape(len(rows), -1)


def _words(name: str, described: Any, count: int) -> tuple[str, ...]:
    """Names of a feature's numbers as LeRobot has them: a list, one within a mapping or a list, or positions by name.

    The latter look like {"motors": [...]}, [[...]] and {"dx": 0, "dy": 1}. Lists of other lengths name axes; these and
    names that are not unique are not used.
    """
    if isinstance(described, Mapping) and all(isinstance(place, int) for place in described.values()):
        described = sorted(described, key=described.__getitem__)
    while isinstance(described, Mapping | list) and len(described) == 1:
        (inner,) = described.values() if isinstance(described, Mapping) else described
        if not isinstance(inner, Mapping | list):
            break
        described = inner
    if isinstance(described, list) and len(set(map(str, described))) == len(described) == count:
        return tuple(map(str, described))
    return tuple(f"{name} {index}" for index in range(count)) if count > 1 else (name,)
