"""LeRobot data sets of version 3 as LeRobot itself lays them out, written without our own writer.

As in LeRobot's recorder, features of the robot come before those that every data set has; the numbers of a feature are
fixed-size lists, and single numbers are plain; each episode is a row group of a file that several share; the rows of
episodes also say where videos and statistics are; time stamps are frame / fps in single precision.
"""

import json

import numpy as np
import pyarrow
from pyarrow import parquet

EVERY = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CAMERA = {
    "dtype": "video",
    "shape": [480, 640, 3],
    "names": ["height", "width", "channels"],
    "info": {"video.fps": 30, "video.codec": "av1", "video.is_depth_map": False, "has_audio": False},
}


def feature(values, names=None, unit=None):
    """A feature as info.json describes it."""
    described = {"dtype": values.dtype.name, "shape": list(values.shape[1:]) or [1], "names": names}
    return described | ({"info": {"unit": unit}} if unit else {})


def write(path, episodes, names, units=None, fps=30, files=None, listed=True):
    """Write a data set.

    Args:
        path: a new folder.
        episodes: for each, arrays [F] or [F, n] by the names of features.
        names: names of the numbers of features, in any of LeRobot's forms.
        units: units of the features that have some.
        fps: frames per second.
        files: index of each episode's file; by default the first.
        listed: whether info.json also lists the features that every data set has.
    """
    files = files or [0] * len(episodes)
    own = {name: feature(values, names.get(name), (units or {}).get(name)) for name, values in episodes[0].items()}
    own["observation.images.front"] = CAMERA
    described = own | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in EVERY.items() if listed}
    rows, tables, total = [], {}, 0
    for number, (episode, file) in enumerate(zip(episodes, files, strict=True)):
        count = len(next(iter(episode.values())))
        frames = np.arange(count)
        columns = {name: column(values) for name, values in episode.items()}
        counted = {"frame_index": frames, "episode_index": np.full(count, number), "index": total + frames}
        columns |= {"timestamp": pyarrow.array((frames / fps).astype(np.float32))} | counted
        columns["task_index"] = np.zeros(count, int)
        tables.setdefault(file, []).append(pyarrow.table(columns))
        stats = {
            f"stats/{name}/{word}": np.atleast_1d(getattr(np, word)(values, axis=0)).tolist()
            for name, values in episode.items()
            for word in ("min", "max", "mean", "std")
        }
        camera = {
            "chunk_index": 0,
            "file_index": 0,
            "from_timestamp": total / fps,
            "to_timestamp": (total + count) / fps,
        }
        rows.append(
            {"episode_index": number, "tasks": ["pick up the cube"], "length": count}
            | {"data/chunk_index": 0, "data/file_index": file}
            | {"dataset_from_index": total, "dataset_to_index": total + count}
            | {f"videos/observation.images.front/{word}": value for word, value in camera.items()}
            | stats
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        )
        total += count
    for file, several in tables.items():
        place = path / DATA.format(chunk_index=0, file_index=file)
        place.parent.mkdir(parents=True, exist_ok=True)
        with parquet.ParquetWriter(place, several[0].schema, compression="snappy", use_dictionary=True) as writer:
            for table in several:
                writer.write_table(table)
    place = path / "meta/episodes/chunk-000/file-000.parquet"
    place.parent.mkdir(parents=True)
    parquet.write_table(pyarrow.Table.from_pylist(rows), place, compression="snappy")
    info = {
        **{"codebase_version": "v3.0", "robot_type": "so101_follower", "total_episodes": len(episodes)},
        **{"total_frames": total, "total_tasks": 1, "chunks_size": 1000, "data_files_size_in_mb": 100},
        **{"video_files_size_in_mb": 200, "fps": fps, "splits": {"train": f"0:{len(episodes)}"}, "data_path": DATA},
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": described,
    }
    (path / "meta/info.json").write_text(json.dumps(info, indent=4))
    return path


def column(values):
    """A column: one number per row as it is, several as a fixed-size list, a matrix as lists of lists."""
    if values.ndim == 1:
        return pyarrow.array(values)
    if values.ndim == 2:
        return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.ravel()), values.shape[1])
    return pyarrow.array(values.tolist())
