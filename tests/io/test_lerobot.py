"""LeRobot data sets: what is written has the layout of version 3, and what others wrote is read."""

import json
import shutil
import sys

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from same_rollouts import same

from jaxlfi.io import lerobot
from jaxlfi.io.rollout import Rollout, Signal

RANDOM = np.random.default_rng(0)
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


def rollout(frames: int, joints: int = 3, points: int = 5, **metadata) -> Rollout:
    """An episode of jittered frames at 30 Hz, and actions at 4 Hz that outlive them."""
    times = (np.arange(frames) - 1 + 0.2 * np.sin(np.arange(frames))) / 30
    signals = {
        "observation.state": (RANDOM.normal(size=(frames, joints)).astype(np.float32), "rad"),
        "observation.keypoints": (RANDOM.uniform(size=(frames, 2 * points)), "normalised pixels"),
        "observation.seen": (RANDOM.uniform(size=(frames, points)) < 0.7, "boolean"),
        "observation.force": (RANDOM.integers(-5, 5, (frames, 1)), "N"),
    }
    made = {
        name: Signal(times, values, tuple(f"{name[-5:]} {i}" for i in range(values.shape[1])), unit)
        for name, (values, unit) in signals.items()
    }
    commands = RANDOM.normal(size=(9, joints)).astype(np.float32)
    made["action"] = Signal(0.25 * np.arange(9), commands, tuple("abcdefg"[:joints]), "rad", duration=0.25)
    return Rollout(made, metadata, task="turn left" if frames % 2 else "turn right")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("lerobot") / "set"
    several = [rollout(40, by="a"), rollout(31, by="b", camera={"position": [1.5]}), rollout(22)]
    lerobot.write(path, several, "observation.state", 30.0, robot_type="panda")
    return path, several


@pytest.fixture
def copied(written, tmp_path):
    """The same data set, to be damaged."""
    return shutil.copytree(written[0], tmp_path / "copy")


def test_what_is_written_is_read(written):
    path, several = written
    assert lerobot.episodes(path) == [0, 1, 2]
    for number, one in enumerate(several):
        same(lerobot.read(path, number), one)


@pytest.mark.parametrize(("joints", "points"), [(1, 1), (7, 12)])
def test_any_number_of_actions_and_keypoints(tmp_path, joints, points):
    one = rollout(20, joints, points)
    lerobot.write(tmp_path / "set", [one], "observation.keypoints", 29.97)
    same(lerobot.read(tmp_path / "set"), one)
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["fps"] == 29.97


def test_the_layout_is_that_of_version_3(written):
    path, several = written
    files = sorted(file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file())
    assert files == [DATA, EPISODES, "meta/info.json", "meta/stats.json", "meta/tasks.parquet"]
    assert not [file for file in path.parent.iterdir() if file != path]
    info = json.loads((path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30 and isinstance(info["fps"], int)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 93, 2)
    assert info["robot_type"] == "panda" and info["splits"] == {"train": "0:3"}
    described = info["features"]["observation.keypoints"]
    assert (described["dtype"], described["shape"], len(described["names"])) == ("float64", [10], 10)
    table = parquet.read_table(path / DATA)
    assert table.column_names == list(info["features"])
    assert str(table.schema.field("action").type) == "fixed_size_list<element: float>[3]"
    assert str(table.schema.field("observation.force").type) == "int64"
    rows = table.to_pydict()
    assert rows["index"] == list(range(93)) and rows["task_index"] == [0] * 40 + [1] * 31 + [0] * 22
    assert rows["frame_index"] == [*range(40), *range(31), *range(22)]
    assert rows["episode_index"] == [0] * 40 + [1] * 31 + [2] * 22
    np.testing.assert_allclose(rows["timestamp"][40:71], np.arange(31) / 30, rtol=1e-6)
    assert rows["time"][40:71] == several[1].signals["observation.state"].times.tolist()
    assert parquet.ParquetFile(path / DATA).num_row_groups == 3
    episodes = parquet.read_table(path / EPISODES).to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"], row["length"]) for row in episodes] == [
        *[(0, 40, 40), (40, 71, 31), (71, 93, 22)]
    ]
    assert [row["tasks"] for row in episodes] == [["turn right"], ["turn left"], ["turn right"]]


def test_rows_hold_the_action_in_force(written):
    path, several = written
    rows = parquet.read_table(path / DATA).slice(40, 31).to_pydict()
    actions = several[1].signals["action"].values
    for time, action in zip(rows["time"], rows["action"], strict=True):
        expected = actions[int(time // 0.25)] if time >= 0 else np.zeros(3)
        np.testing.assert_array_equal(np.float32(action), expected)


def test_statistics_are_those_of_the_rows(written):
    path, several = written
    stats = json.loads((path / "meta/stats.json").read_text())
    rows = np.concatenate([one.signals["observation.state"].values for one in several])
    found = stats["observation.state"]
    np.testing.assert_allclose(found["mean"], rows.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(found["std"], rows.std(axis=0), rtol=1e-4)
    np.testing.assert_allclose(found["q90"], np.quantile(rows, 0.9, axis=0), rtol=1e-4)
    assert found["count"] == [93] and found["min"] == rows.min(axis=0).tolist()
    second = parquet.read_table(path / EPISODES).to_pylist()[1]["stats/observation.state/max"]
    assert second == several[1].signals["observation.state"].values.max(axis=0).tolist()


def test_statistics_leave_out_what_is_not_finite(tmp_path):
    values = np.array([[1.0, np.nan], [3.0, np.nan], [np.nan, np.inf]])
    one = Rollout({"observation.state": Signal([0.0, 0.1, 0.2], values, ("a", "b"))})
    lerobot.write(tmp_path / "set", [one], "observation.state", 10.0)
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())["observation.state"]
    assert (stats["mean"], stats["max"]) == ([2.0, 0.0], [3.0, 0.0])
    np.testing.assert_array_equal(lerobot.read(tmp_path / "set").signals["observation.state"].values, values)


def test_words_of_tasks_are_the_index_of_a_data_frame(written):
    """LeRobot reads them by pandas, for which a column is the index only if the file says so."""
    table = parquet.read_table(written[0] / "meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0, 1], "task": ["turn right", "turn left"]}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


# ------------------------------------------------------------------------------------------ what others have written


def foreign(path, **info):
    """A data set as LeRobot 0.4 writes it: two episodes in two files, an image and a matrix among its features."""
    scalar = lambda dtype: {"dtype": dtype, "shape": [1], "names": None}
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["shoulder", "elbow"]}},
        "observation.image": {"dtype": "image", "shape": [2, 2, 3], "names": ["height", "width", "channel"]},
        "observation.pose": {"dtype": "float64", "shape": [2, 2], "names": None},
        "action": {"dtype": "float32", "shape": [1], "names": ["grip"]},
        "next.done": scalar("bool"),
        "timestamp": scalar("float32"),
        **{name: scalar("int64") for name in lerobot.COUNTED},
    }
    described = {"codebase_version": "v3.0", "fps": 10, "features": features, "total_episodes": 2, **info}
    described.setdefault("data_path", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
    (path / "meta/episodes/chunk-000").mkdir(parents=True)
    (path / "meta/info.json").write_text(json.dumps(described))
    rows = []
    for number, length in enumerate((4, 3)):
        frames = np.arange(length)
        table = pyarrow.table(
            {
                "observation.state": pyarrow.array(
                    [[float(i), float(-number)] for i in frames], pyarrow.list_(pyarrow.float32(), 2)
                ),
                "observation.image": [{"bytes": b"png", "path": None}] * length,
                "observation.pose": [[[1.0, 2.0], [3.0, float(i)]] for i in frames],
                "action": pyarrow.array(10.0 * frames, pyarrow.float32()),
                "next.done": frames == length - 1,
                "timestamp": pyarrow.array(frames / 10, pyarrow.float32()),
                "frame_index": frames,
                "episode_index": np.full(length, number),
                "index": frames + 4 * number,
                "task_index": np.zeros(length, int),
            }
        )
        file = path / f"data/chunk-00{number}/file-00{number}.parquet"
        file.parent.mkdir(parents=True)
        parquet.write_table(table, file)
        where = {"data/chunk_index": number, "data/file_index": number}
        rows.append({"episode_index": number, "tasks": ["grasp"], "length": length, **where})
    parquet.write_table(pyarrow.Table.from_pylist(rows), path / EPISODES)
    return path


def test_what_lerobot_wrote_is_read(tmp_path):
    read = lerobot.read(foreign(tmp_path / "set"), 1)
    assert read.task == "grasp" and read.metadata == {}
    assert set(read.signals) == {"observation.state", "observation.pose", "action", "next.done"}
    state, pose = read.signals["observation.state"], read.signals["observation.pose"]
    assert state.names == ("shoulder", "elbow") and state.values.dtype == np.float32
    np.testing.assert_array_equal(state.values, [[0, -1], [1, -1], [2, -1]])
    np.testing.assert_allclose(state.times, [0.0, 0.1, 0.2], atol=1e-7)
    np.testing.assert_array_equal(pose.values, [[1, 2, 3, 0], [1, 2, 3, 1], [1, 2, 3, 2]])
    assert pose.names[3] == "observation.pose 3"
    assert read.signals["action"].values.tolist() == [[0.0], [10.0], [20.0]]
    assert read.signals["next.done"].values.ravel().tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("version", "message"),
    [("v2.1", "convert it with LeRobot's convert_dataset_v21_to_v30"), ("v4.0", "a newer jaxlfi may read it")],
)
def test_other_versions_are_refused(tmp_path, version, message):
    with pytest.raises(ValueError, match=f"expected a LeRobot data set of v3.0, got {version}: {message}"):
        lerobot.read(foreign(tmp_path / "set", codebase_version=version), 0)


def truncate(file):
    file.write_bytes(file.read_bytes()[:-200])


def flip(file):
    """Another number among the rows of the second episode."""
    content = bytearray(file.read_bytes())
    group = parquet.ParquetFile(file).metadata.row_group(1)
    content[group.column(0).data_page_offset + 60] ^= 0xFF
    file.write_bytes(content)


def without(path, column):
    table = parquet.read_table(path / DATA)
    parquet.write_table(table.drop_columns(column), path / DATA)


def changed(path, column, change):
    """Change what the column of the episodes says."""
    table = parquet.read_table(path / EPISODES)
    rows = [{**row, column: change(row[column])} for row in table.to_pylist()]
    parquet.write_table(pyarrow.Table.from_pylist(rows), path / EPISODES)


def other_rows(path):
    table = parquet.read_table(path / DATA)
    place = table.column_names.index("action")
    zero = pyarrow.array([[0.0] * 3] * table.num_rows, table.schema.field("action").type)
    parquet.write_table(table.set_column(place, "action", zero), path / DATA)


def told(path, **changes):
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps({**info, **changes}))


SPOILED = {
    "no info": (lambda path: (path / "meta/info.json").unlink(), "without a readable meta/info.json"),
    "damaged info": (lambda path: (path / "meta/info.json").write_text("{"), "without a readable meta/info.json"),
    "a list": (lambda path: (path / "meta/info.json").write_text("[]"), "without a readable meta/info.json"),
    "other template": (lambda path: told(path, data_path="{video_key}.mp4"), "without a readable meta/info.json"),
    "worded features": (lambda path: told(path, features={"action": "float"}), "without a readable meta/info.json"),
    "no rows": (lambda path: (path / DATA).unlink(), r"expected a complete Parquet file file-000.parquet"),
    "truncated rows": (lambda path: truncate(path / DATA), "expected a complete Parquet file file-000.parquet"),
    "damaged rows": (lambda path: flip(path / DATA), "expected a complete Parquet file file-000.parquet"),
    "truncated episodes": (lambda path: truncate(path / EPISODES), "expected a complete Parquet file file-000.parquet"),
    "no episodes": (lambda path: (path / EPISODES).unlink(), "expected episodes in meta/episodes"),
    "missing column": (lambda path: without(path, "action"), "expected a complete Parquet file file-000.parquet"),
    "fewer rows": (
        lambda path: changed(path, "length", lambda n: n + 1),
        "expected 32 frames of episode 1 in .*, got 31",
    ),
    "another's column": (
        lambda path: changed(path, "jaxlfi", lambda _: "[1]"),
        "expected JSON of jaxlfi in the column",
    ),
    "later column": (
        lambda path: changed(path, "jaxlfi", lambda text: text.replace('"version": 1', '"version": 2')),
        "column 'jaxlfi' of the episodes: expected jaxlfi of version 1, got version 2",
    ),
    "rows that were edited": (
        other_rows,
        "action: expected what the column 'jaxlfi' of episode 1 says of it, got other",
    ),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_what_is_damaged_is_refused_in_one_line(copied, spoil, message):
    spoil(copied)
    with pytest.raises(ValueError, match=message) as caught:
        lerobot.read(copied, 1)
    assert "\n" not in str(caught.value) and str(copied) in str(caught.value)


def test_an_episode_has_to_be_chosen_among_several(written):
    with pytest.raises(ValueError, match="expected the number of one of its 3 episodes, got none"):
        lerobot.read(written[0])
    with pytest.raises(ValueError, match="expected an episode from 0 to 2, got 3"):
        lerobot.read(written[0], 3)


def test_what_does_not_belong_together_is_not_written(tmp_path):
    one = rollout(20)
    fewer = Rollout({name: signal for name, signal in one.signals.items() if name != "observation.force"})
    taken = Rollout({**one.signals, "timestamp": one.signals["observation.force"]})
    for rollouts, clock, message in (
        ([], "action", "rollouts: expected at least one"),
        ([one], "observation.images", "clock: expected one of observation.state"),
        ([one, fewer], "observation.state", "got different observation.force"),
        ([one, rollout(20, joints=4)], "observation.state", "got different action, observation.state"),
        ([taken], "observation.state", "expected other names than the data set's own, got timestamp"),
    ):
        with pytest.raises(ValueError, match=message):
            lerobot.write(tmp_path / "set", rollouts, clock, 30.0)
    with pytest.raises(ValueError, match=r"path: expected a new folder, got .*, which exists"):
        lerobot.write(tmp_path, [one], "observation.state", 30.0)
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_of_what_could_not_be_written(tmp_path):
    one = rollout(20, unspeakable=float("nan"))
    with pytest.raises(ValueError, match="JSON"):
        lerobot.write(tmp_path / "set", [one], "observation.state", 30.0)
    assert not list(tmp_path.iterdir())


def test_without_pyarrow_it_says_what_to_install(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxlfi\[robotics\]'"):
        lerobot.read(written[0], 0)
