"""Recordings in the wild: data sets in LeRobot's layout, tables with times, and rows out of order."""

import json

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow", reason="LeRobot data sets are Parquet files; pyarrow is of the extra robotics")

import lerobot_layout

from jaxlfi.envs.mujoco import columns
from jaxlfi.envs.mujoco.log_files import recorded
from jaxlfi.envs.mujoco.logs import read, read_all

JOINTS = ["shoulder_pan.pos", "elbow_flex.pos", "gripper.pos"]
RANDOM = np.random.default_rng(0)


def episode(number, frames):
    """State and action of one name, positions of two bodies with the same axes, and what learners add."""
    state = (np.arange(frames)[:, None] * [1.0, -2.0, 3.0] + 100 * number).astype(np.float32)
    return {
        "observation.state": state,
        "action": state + 0.5,
        "cube.position": np.tile([0.25, -0.5, 1.0], (frames, 1)).astype(np.float32),
        "bin.position": np.tile([2.0, 3.0, -4.0], (frames, 1)).astype(np.float32),
        "next.reward": np.linspace(0, 1, frames).astype(np.float32),
        "next.done": np.arange(frames) == frames - 1,
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    episodes = [episode(number, frames) for number, frames in enumerate((5, 7, 4))]
    axes = ["x", "y", "z"]
    names = {"observation.state": JOINTS, "action": JOINTS, "cube.position": axes, "bin.position": axes}
    path = tmp_path_factory.mktemp("lerobot") / "pick"
    units = {"observation.state": "deg", "action": ["deg", "deg", "%"]}
    return lerobot_layout.write(path, episodes, names, units, files=[0, 0, 1])


def test_state_and_action_of_one_name_are_two_signals(folder):
    log = read(f"{folder}#episode=1")
    expected = episode(1, 7)
    found = {name: np.rad2deg(log.signals[f"observation.state/{name}"]) for name in JOINTS}
    np.testing.assert_allclose(np.stack(list(found.values()), axis=1), expected["observation.state"], rtol=1e-6)
    np.testing.assert_allclose(log.signals["action/gripper.pos"], 0.01 * expected["action"][:, 2], rtol=1e-6)
    assert log.signals["cube.position/y"][0] == -0.5 and log.signals["bin.position/y"][0] == 3.0
    np.testing.assert_allclose(log.times, np.arange(7) / 30, atol=1e-15)  # not as single precision rounds them
    assert "next.reward" in log.signals and not any("image" in name or "index" in name for name in log.signals)


def test_episodes_by_number_and_by_range(folder):
    several = read_all(f"{folder}#episodes=1-2")
    assert [len(log.times) for log in several] == [7, 4]
    assert [log.name for log in several] == [f"{folder}#episode=1", f"{folder}#episode=2"]
    assert [np.rad2deg(log.signals["observation.state/gripper.pos"][0]) for log in several] == pytest.approx([100, 200])
    assert len(read_all(f"{folder}#episodes=2")) == 1
    with pytest.raises(ValueError, match=r"expected one recording, got 2 episodes of "):
        read(f"{folder}#episodes=0-1")


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("", r"one of its 3 episodes, got none: name it as pick#episode=0, or several as pick#episodes=0-2$"),
        ("#episode=3", "expected an episode from 0 to 2, got 3"),
        ("#episodes=1-4", "expected an episode from 0 to 2, got 3"),
        ("#episodes=2-1", "expected the first and the last number after #episodes=, as 0-9, got '2-1'"),
        ("#episodes=a", "expected the first and the last number after #episodes=, as 0-9, got 'a'"),
        ("#episode=one", "expected a number after #episode=, got 'one'"),
    ],
)
def test_episodes_that_are_not_there_are_one_line(folder, reference, expected):
    with pytest.raises(ValueError, match=expected) as caught:
        read_all(f"{folder}{reference}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "b", "c"], ["a", "b", "c"]),
        ({"motors": ["a", "b", "c"]}, ["a", "b", "c"]),
        ([["a", "b", "c"]], ["a", "b", "c"]),
        ({"a": 1, "b": 0, "c": 2}, ["b", "a", "c"]),
        (["state"], None),
        (["a", "a", "b"], None),
        (None, None),
    ],
)
def test_names_in_each_form_that_is_found_in_data_sets(tmp_path, names, expected):
    one = {"observation.state": np.ones((4, 3), np.float32) * [1, 2, 3]}
    lerobot_layout.write(tmp_path / "set", [one], {"observation.state": names}, listed=False)
    log = read(tmp_path / "set")
    assert list(log.signals) == (expected or [f"observation.state {i}" for i in range(3)])
    assert [values[0] for values in log.signals.values()] == [1, 2, 3]
    np.testing.assert_allclose(log.times, np.arange(4) / 30, atol=1e-15)


def test_clouds_of_points_are_no_signals(tmp_path):
    one = {"observation.state": np.zeros((3, 2)), "observation.points": np.zeros((3, 100, 3))}
    lerobot_layout.write(tmp_path / "set", [one], {})
    assert list(read(tmp_path / "set").signals) == ["observation.state 0", "observation.state 1"]
    lerobot_layout.write(tmp_path / "other", [{"observation.points": np.zeros((3, 100, 3))}], {})
    with pytest.raises(ValueError, match=r"expected topics of at most 256 numbers, got observation.points"):
        read(tmp_path / "other")


def test_time_stamps_in_disorder_are_refused_with_their_frames(tmp_path):
    one = {"time": np.array([0.0, 0.1, 0.3, 0.2, 0.4]), "observation.state": np.arange(5.0)}
    lerobot_layout.write(tmp_path / "set", [one], {})
    with pytest.raises(ValueError, match=r"set: time: expected times in order, got 0.2 in frame 4 after 0.3$"):
        read(tmp_path / "set")
    (raw,) = recorded(tmp_path / "set")
    assert raw.signals["observation.state"].tolist() == [0, 1, 3, 2, 4]
    (tmp_path / "set/data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(ValueError, match=r"expected a complete Parquet file file-000.parquet"):
        read(tmp_path / "set")


def test_a_data_set_of_pictures_alone_has_no_signals(tmp_path):
    path = lerobot_layout.write(tmp_path / "set", [{"action": np.zeros((3, 2))}], {})
    info = json.loads((path / "meta/info.json").read_text())
    del info["features"]["action"]
    (path / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"expected features that are numbers, got observation.images.front"):
        read(path)


def test_columns_of_a_data_set_are_controls_and_sensors(folder):
    """Without renaming, where actuators and sensors are called as the data set's motors are."""
    log = columns.arranged(read(f"{folder}#episode=0"), ["elbow_flex.pos", ""], ["elbow_flex.pos", "gripper.pos"])
    np.testing.assert_allclose(np.rad2deg(log.signals["actuator/elbow_flex.pos"][:2]), [0.5, -1.5], atol=1e-5)
    np.testing.assert_allclose(np.rad2deg(log.signals["elbow_flex.pos"][:2]), [0.0, -2.0], atol=1e-5)
    assert "gripper.pos" in log.signals and "observation.state/shoulder_pan.pos" in log.signals


def test_times_in_another_column_and_rows_that_are_numbered(tmp_path):
    (tmp_path / "a.csv").write_text(",angle [deg],Time [ms]\n0,90,0\n1,180,20\n2,270,40\n")
    log = read(tmp_path / "a.csv")
    np.testing.assert_allclose(log.times, [0, 0.02, 0.04])
    assert list(log.signals) == ["angle"]
    np.testing.assert_allclose(log.signals["angle"], [np.pi / 2, np.pi, 1.5 * np.pi])


@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_a_recording_in_disorder_is_put_in_order_for_those_who_look_at_it(tmp_path, kind):
    times, values = [0.0, 2.0, 1.0, 1.0, 3.0, 5.0], np.arange(6.0)
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        path.write_text("time [s],angle\n" + "".join(f"{t},{v}\n" for t, v in zip(times, values, strict=True)))
    else:
        np.savez(path, times=times, angle=values)
    with pytest.raises(ValueError, match=r"got 1 in row 3 after 2; row 4 repeats a time and row 3 goes back$"):
        read(path)
    (raw,) = recorded(path)
    mended = raw.in_order()
    assert mended.times.tolist() == [0, 1, 2, 3, 5] and mended.signals["angle"].tolist() == [0, 2, 1, 4, 5]
    assert mended.faults == (
        "expected at least two increasing times, got 1 in row 3 after 2; row 4 repeats a time and row 3 goes back",
    )
