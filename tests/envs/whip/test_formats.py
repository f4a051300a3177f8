"""Recordings as LeRobot data sets and MCAP files, and back: every array, the description, and what is refused."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import cli, formats, real2sim
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.recording import Recording
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.io import lerobot, mcap
from jaxlfi.io.rollout import Rollout, Signal


def recorded(rate: float = 60.0, interval: float = 0.16, lost=(), **changes) -> Recording:
    """A rollout whose numbers all differ, seen by a camera that begins early, jitters and loses frames."""
    random = np.random.default_rng(0)
    end = 16 * interval + 0.1
    frames = np.delete(np.arange(-2, np.ceil(end * rate)), lost)
    times = (frames + 0.1 * np.sin(frames)) / rate
    keypoints = random.uniform(0.1, 0.9, (times.size, 10, 2)).astype(np.float32)
    seen = random.uniform(size=(times.size, 10)) < 0.8
    keypoints[~seen & (random.uniform(size=seen.shape) < 0.5)] = np.nan
    made = {
        "times": times,
        "gripper": random.uniform(0.3, 0.5, (times.size, 2)).astype(np.float32),
        "keypoints": keypoints,
        "seen": seen,
        "actions": random.uniform(-0.06, 0.06, (16, 2)).astype(np.float32),
        "camera": side_camera(median().replace(camera=np.array([0.01, -0.02, 0.005]))),
        "source": "real",
        "description": "a «rope», 2nd try",
        "frame_rate": rate,
        "control_interval": interval,
        "image_size": 128,
        "colours": {"dlo": "#0000FF"},
        "facts": {"mass (kg)": 0.047, "length (m)": None},
        "provenance": {"by": ["a", "test"]},
    }
    return Recording(**{**made, **changes})


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """NAME.npz of a recording."""
    path = tmp_path_factory.mktemp("original") / "one.npz"
    hits = np.arange(recorded().times.size)[:, None] > np.array([9, 99, 20, 999, 50, 2])
    recordings.write(path, recorded(hits=hits))
    return path


def arrays(path):
    with np.load(path) as file:
        return dict(file)


def same_files(first, second):
    one, other = arrays(first), arrays(second)
    assert set(one) == set(other)
    for name, array in one.items():
        assert other[name].dtype == array.dtype, name
        np.testing.assert_array_equal(other[name], array)
    assert json.loads(first.with_suffix(".json").read_text()) == json.loads(second.with_suffix(".json").read_text())


def run(*words):
    return cli.main([str(word) for word in words])


@pytest.mark.parametrize("through", ["one.mcap", "set"])
def test_a_round_trip_keeps_every_array_and_the_description(tmp_path, original, through):
    assert arrays(original)["times"].dtype == np.float64 and arrays(original)["keypoints"].dtype == np.float32
    assert run("convert", original, tmp_path / "new" / through) == 0
    assert run("convert", tmp_path / "new" / through, tmp_path / "back.npz") == 0
    same_files(original, tmp_path / "back.npz")


def test_from_one_format_to_another_and_through_a_data_set_of_several(tmp_path, original, capsys):
    assert run("convert", original, tmp_path / "one.mcap") == 0
    other = recorded(description="another", hits=np.zeros((recorded().times.size, 6), bool))
    recordings.write(tmp_path / "two.npz", other)
    assert run("convert", tmp_path / "two.npz", tmp_path / "one.mcap", tmp_path / "set") == 0
    assert (
        f"wrote {tmp_path / 'set'}: {other.times.size}, {other.times.size} frames at 60 Hz" in capsys.readouterr().out
    )
    assert run("convert", f"{tmp_path / 'set'}#episode=1", tmp_path / "back.npz") == 0
    same_files(original, tmp_path / "back.npz")
    assert formats.read(f"{tmp_path / 'set'}#episode=0").description == "another"


@pytest.mark.parametrize(
    ("rate", "interval", "lost"), [(6.25, 0.16, ()), (30.0, 0.16, ()), (5.0, 0.11, ()), (60.0, 0.16, range(40, 63))]
)
def test_any_rate_of_frames_keeps_the_actions(tmp_path, rate, interval, lost):
    """Frames at the control rate, above and below it, and a gap of more than a control interval."""
    one = recorded(rate, interval, lost)
    for path in (tmp_path / "set", tmp_path / "one.mcap"):
        formats.write(path, [one])
        back = formats.read(path)
        for name in ("times", "gripper", "keypoints", "seen", "actions"):
            np.testing.assert_array_equal(getattr(back, name), getattr(one, name))
        assert back.hits is None and back.control_interval == interval and back.frame_rate == rate


def test_learners_see_each_action_in_the_frames_of_its_interval(tmp_path):
    one = recorded(30.0)
    formats.write(tmp_path / "set", [one])
    shown = lerobot.read(tmp_path / "set").signals["action"].held(one.times)
    for time, action in zip(one.times, shown, strict=True):
        expected = one.actions[int(time / 0.16)] if 0 <= time < 2.56 else np.zeros(2)
        np.testing.assert_array_equal(action, expected.astype(np.float32))


def with_actions_of_frames(one: Recording) -> Rollout:
    """An action in every row; beside the rows there is the description alone."""
    rollout = formats.as_rollout(one)
    action = rollout.signals["action"]
    rows = Signal(one.times, action.held(one.times), action.names, action.unit)
    return dataclasses.replace(rollout, signals={**rollout.signals, "action": rows})


def test_actions_are_read_off_the_frames_where_they_stand_there(tmp_path):
    one = recorded(30.0)
    lerobot.write(tmp_path / "set", [with_actions_of_frames(one)], "observation.state", 30.0)
    np.testing.assert_array_equal(formats.read(tmp_path / "set").actions, one.actions)
    gap = recorded(30.0, lost=range(20, 27))
    lerobot.write(tmp_path / "gap", [with_actions_of_frames(gap)], "observation.state", 30.0)
    with pytest.raises(ValueError, match=r"gap: action: expected one value from 0.64 to 0.8 s, .*, got none"):
        formats.read(tmp_path / "gap")


# ----------------------------------------------------------------------------------------------------- --object


def test_every_format_is_an_object(tmp_path, original):
    formats.write(tmp_path / "one.mcap", [recordings.read(original)])
    formats.write(tmp_path / "set", [recorded(hits=None)] * 2)
    expected = recordings.trajectory(recordings.read(original))
    for reference in (original, tmp_path / "one.mcap"):
        np.testing.assert_array_equal(recordings.trajectory(real2sim.recorded(str(reference))), expected)
    assert real2sim.recorded(f"{tmp_path / 'set'}#episode=1").description == recorded().description
    with pytest.raises(ValueError, match=r"recording: expected one of 2 episodes, as .*set#episode=0, got .*set"):
        real2sim.recorded(str(tmp_path / "set"))


def test_an_object_that_is_not_there_is_refused():
    for name in ("nowhere.mcap", "nowhere", "nowhere#episode=2", "dlo-0#episode=0"):
        with pytest.raises(
            ValueError, match=r"object: expected one of dlo-0, .* or a folder \(a LeRobot data set\), got"
        ):
            real2sim.recorded(name)


# --------------------------------------------------------------------------------------------------- what is refused


def changed(rollout: Rollout, name: str, **changes) -> Rollout:
    return dataclasses.replace(
        rollout, signals={**rollout.signals, name: dataclasses.replace(rollout.signals[name], **changes)}
    )


def without(rollout: Rollout, name: str) -> Rollout:
    return dataclasses.replace(rollout, signals={k: v for k, v in rollout.signals.items() if k != name})


def described(rollout: Rollout, **changes) -> Rollout:
    return dataclasses.replace(rollout, metadata={**rollout.metadata, **changes})


WRONG = {
    "no keypoints": (
        lambda one: without(one, "observation.keypoints"),
        "got no observation.keypoints among .*; docs/recordings.md says what to rename",
    ),
    "joints": (
        lambda one: changed(one, "observation.state", names=("joint 1", "joint 2")),
        r"observation.state: expected 2 numbers \(gripper x, gripper z\), got 2 numbers \(joint 1, joint 2\)",
    ),
    "six joints": (
        lambda one: changed(one, "action", values=np.zeros((16, 6)), names=tuple("abcdef")),
        r"action: expected 2 numbers \(dx, dz\), got 6 numbers \(a, b, c, ...\)",
    ),
    "fewer actions": (
        lambda one: changed(one, "action", times=np.arange(15.0), values=np.zeros((15, 2))),
        r"actions: expected shape \[16, 2\], got \[15, 2\]",
    ),
    "other clock": (
        lambda one: changed(one, "observation.seen", times=one.signals["observation.seen"].times + 0.01),
        "observation.seen: expected the time stamps of observation.state, got others",
    ),
    "numbers as flags": (
        lambda one: changed(one, "observation.seen", values=one.signals["observation.seen"].values * 1.0),
        "seen: expected an array of bools, got float64",
    ),
    "no description": (
        lambda one: dataclasses.replace(one, metadata={}),
        "schema: expected 'jaxlfi.whip.recording' in the rollout's metadata",
    ),
    "later version": (
        lambda one: described(one, version=2),
        "jaxlfi.whip.recording of version 1, got version 2, which a newer",
    ),
    "large actions": (
        lambda one: changed(one, "action", values=np.full((16, 2), 0.1)),
        "of at most 0.06 m, got one of",
    ),
    "frame rate": (lambda one: described(one, frame_rate=10.0), "frame_rate: expected what the time stamps say"),
    "lost gripper": (
        lambda one: changed(one, "observation.state", values=np.nan * one.signals["observation.state"].values),
        "gripper: expected finite numbers",
    ),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_what_is_no_rollout_of_the_whip_is_refused_in_one_line(tmp_path, change, message):
    rollout = change(formats.as_rollout(recorded(lost=[9])))
    mcap.write(tmp_path / "one.mcap", rollout)
    with pytest.raises(ValueError, match=message) as caught:
        formats.read(tmp_path / "one.mcap")
    assert "\n" not in str(caught.value) and str(tmp_path / "one.mcap") in str(caught.value)


def test_further_signals_are_ignored(tmp_path):
    rollout = formats.as_rollout(recorded())
    force = Signal([0.0, 1.0], [[1.0], [2.0]], ("force",), "N")
    mcap.write(tmp_path / "one.mcap", dataclasses.replace(rollout, signals={**rollout.signals, "force": force}))
    assert formats.read(tmp_path / "one.mcap").description == recorded().description


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{one}", "{folder}/one.csv"], "path: expected NAME.npz, NAME.mcap or a folder (a LeRobot data set), got"),
        (["{one}", "{one}"], "which exists"),
        (["{one}", "{folder}"], "path: expected a new folder, got"),
        (["{one}", "{one}", "{folder}/two.mcap"], "path: expected a folder for 2 recordings, got"),
        (["{one}#episode=0", "{folder}/two.mcap"], "recording: expected #episode=N after the folder of a LeRobot data"),
        (["{one}#episode=last", "{folder}/two.mcap"], "recording: expected a number after #episode=, got 'last'"),
        (
            ["{one}", "{slow}", "{folder}/set"],
            "frame_rate: expected the same of all episodes of a data set, got 30, 60",
        ),
        (["{folder}", "{folder}/two.npz"], "without a readable meta/info.json"),
        (["{folder}/one.bag", "{folder}/two.npz"], "recording: expected NAME.npz, NAME.mcap or a folder"),
    ],
)
def test_bad_input_is_an_error_of_one_line(tmp_path, original, capsys, words, message):
    slow = tmp_path / "slow" / "slow.npz"
    slow.parent.mkdir()
    recordings.write(slow, recorded(30.0))
    folder = tmp_path / "folder"
    folder.mkdir()
    for suffix in (".npz", ".json"):
        shutil.copy(original.with_suffix(suffix), folder)
    words = [word.format(one=folder / "one.npz", slow=slow, folder=folder) for word in words]
    assert run("convert", *words) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxlfi whip: error: ") and message in error and error.count("\n") == 1
    assert sorted(path.name for path in folder.iterdir()) == ["one.json", "one.npz"]
