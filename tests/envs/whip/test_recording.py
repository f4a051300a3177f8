"""Recorded rollouts: what is written is read, resampled as motion says, and refused where it does not fit."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.recording import ORDER, Recording, filled, hit_flags, read, resample, trajectory, write
from jaxlfi.envs.whip.rules import ACTION_LIMIT, WORKSPACE
from jaxlfi.envs.whip.vision.camera import side_camera

DATA = Path(recordings.__file__).parent / "data"
STARTS = np.random.default_rng(0).uniform(0.3, 0.6, (10, 2))
RATES = np.random.default_rng(1).uniform(-0.02, 0.02, (10, 2))
"""Each keypoint goes in a straight line of its own."""
GRIPPER = lambda times: np.stack([0.40 - 0.03 * times, 0.36 + 0.01 * times], axis=-1)


def jittered(rate: float = 60.0, seconds: float = 2.7) -> np.ndarray:
    """Time stamps of a real camera: from before the first action on, not quite regular, two frames lost."""
    stamps = np.arange(-3, seconds * rate) / rate + 0.1 / rate * np.sin(np.arange(-3, seconds * rate))
    return np.delete(stamps, [40, 41])


def recorded(**changes) -> Recording:
    times = changes.get("times", jittered())
    made = {
        "times": times,
        "gripper": GRIPPER(times),
        "keypoints": STARTS + RATES * times[:, None, None],
        "seen": np.ones((times.size, 10), bool),
        "actions": np.random.default_rng(2).uniform(-0.06, 0.06, (16, 2)),
        "camera": side_camera(median().replace(camera=np.array([0.01, -0.02, 0.005]))),
        "source": "real",
        "description": "straight lines",
        "frame_rate": 60.0,
        "colours": {"dlo": "#0000FF"},
        "facts": {"mass (kg)": 0.047},
        "provenance": {"by": "a test"},
    }
    return Recording(**{**made, **changes})


def changed(name: str, index, value) -> dict:
    """One number of one array of a recording, another."""
    array = np.array(getattr(recorded(), name))
    array[index] = value
    return {name: array}


# ----------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("hits", [None, np.arange(jittered().size)[:, None] > np.array([9, 99, 20, 999, 50, 2])])
def test_what_is_written_is_read(tmp_path, hits):
    recording = recorded(hits=hits, image_size=128, source="simulated")
    write(tmp_path / "one.npz", recording)
    back = read(tmp_path / "one.npz")
    np.testing.assert_array_equal(back.times, recording.times)
    for name in ("gripper", "keypoints", "actions"):
        np.testing.assert_array_equal(getattr(back, name), getattr(recording, name).astype(np.float32))
    np.testing.assert_array_equal(back.seen, recording.seen)
    assert (back.hits is None) if hits is None else (back.hits == hits).all()
    for name in ("source", "description", "frame_rate", "control_interval", "image_size", "colours", "facts"):
        assert getattr(back, name) == getattr(recording, name)
    assert back.provenance == {"by": "a test"}
    for name in ("position", "orientation", "field_of_view"):
        np.testing.assert_array_equal(getattr(back.camera, name), getattr(recording.camera, name))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.json", "one.npz"]


@pytest.mark.parametrize("there", ["one.npz", "one.json"])
def test_nothing_is_overwritten(tmp_path, there):
    (tmp_path / there).write_text("precious")
    with pytest.raises(ValueError, match=r"path: expected a new recording, got .*, which exists"):
        write(tmp_path / "one.npz", recorded())
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "precious")]


def test_other_names_are_refused(tmp_path):
    for refused in (lambda path: write(path, recorded()), read):
        with pytest.raises(ValueError, match=r"path: expected a recording's .npz file, got"):
            refused(tmp_path / "one.json")


def described(path, **changes):
    """Change a description on the disk; None takes an entry away."""
    described = {**json.loads(path.with_suffix(".json").read_text()), **changes}
    path.with_suffix(".json").write_text(json.dumps({k: v for k, v in described.items() if v is not None}))


def with_array(path, name, value):
    arrays = {**np.load(path), name: value}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


UNITS = {name: unit for name, unit in recordings.UNITS.items() if name != "hits"}
CAMERA = {"position": [0, -1, 0], "orientation": [1, 0, 0, 0], "field_of_view": 40.0, "image_size": 256}
SPOILED = {
    "no description": (
        lambda path: path.with_suffix(".json").unlink(),
        "a recording is two files: expected a description in one.json beside the .npz, got none",
    ),
    "endless number": (
        lambda path: path.with_suffix(".json").write_text('{"schema": 1' + "0" * 5000 + "}"),
        "expected a description in",
    ),
    "damaged description": (lambda path: path.with_suffix(".json").write_text('{"schema'), "expected a description in"),
    "damaged arrays": (lambda path: path.write_bytes(path.read_bytes()[:-700]), "expected a complete .npz file"),
    "no arrays": (lambda path: path.unlink(), "expected a complete .npz file"),
    "pickles": (lambda path: with_array(path, "seen", np.array([{}])), "expected a complete .npz file"),
    "foreign": (lambda path: described(path, schema="lerobot"), "schema: expected 'jaxlfi.whip.recording'"),
    "a list": (lambda path: path.with_suffix(".json").write_text("[]"), "schema: expected"),
    "later version": (
        lambda path: described(path, version=2),
        "jaxlfi.whip.recording of version 1, got version 2, which a newer",
    ),
    "missing key": (lambda path: described(path, control_interval=None), "control_interval: expected in one.json"),
    "text for a number": (lambda path: described(path, frame_rate="60"), "frame_rate: expected a float, got '60'"),
    "millimetres": (lambda path: described(path, units={**UNITS, "gripper": "mm"}), "units: expected .*'gripper': 'm'"),
    "other order": (lambda path: described(path, keypoints=[*ORDER[4:], *ORDER[:4]]), "keypoints: expected the order"),
    "no camera orientation": (
        lambda path: described(path, camera={"position": [0, 0, 0]}),
        "camera: expected .*orientation",
    ),
    "worded camera": (
        lambda path: described(path, camera={**CAMERA, "orientation": "up"}),
        "camera: expected an array of",
    ),
    "missing array": (lambda path: with_array(path, "seen", None), "arrays: expected .*got no seen"),
    "numbers as flags": (lambda path: with_array(path, "seen", np.ones((163, 10))), "seen: expected an array of bools"),
}


def test_other_arrays_are_ignored(tmp_path):
    write(tmp_path / "one.npz", recorded(), {"forces": np.ones(3), "gripper": np.zeros(1)})
    assert "forces" in np.load(tmp_path / "one.npz")
    np.testing.assert_array_equal(read(tmp_path / "one.npz").gripper, recorded().gripper.astype(np.float32))


@pytest.mark.parametrize("spoil, message", SPOILED.values(), ids=SPOILED)
def test_files_that_do_not_fit_are_refused_in_one_line(tmp_path, spoil, message):
    path = tmp_path / "one.npz"
    write(path, recorded())
    read(path)
    spoil(path)
    with pytest.raises(ValueError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value) and "one" in str(caught.value)


# --------------------------------------------------------------------------------------------------- contents


UNNORMALISED = side_camera(median()).replace(orientation=np.array([1.0, 1.0, 0.0, 0.0]))
WIDE = side_camera(median()).replace(field_of_view=200.0)
REFUSED = [
    ({"source": "imagined"}, "source: expected one of"),
    ({"frame_rate": 30.0}, "frame_rate: expected what the time stamps say, 60.1 Hz, got 30"),
    ({"frame_rate": -60.0}, "frame_rate: expected a positive number"),
    ({"control_interval": 0.5}, "times: expected frames from 0 to 8 s, got -0.05"),
    ({"times": jittered() + 0.2}, "times: expected frames from 0"),
    ({"times": jittered(seconds=2.4)}, "times: expected frames from 0 to 2.56 s"),
    (changed("times", 7, 0.0), "times: expected at least two increasing"),
    (changed("times", 7, np.nan), "times: expected at least two increasing"),
    ({"gripper": GRIPPER(jittered())[1:]}, r"gripper: expected shape \[163, 2\], got \[162, 2\]"),
    ({"keypoints": np.zeros((163, 9, 2))}, r"keypoints: expected shape \[163, 10, 2\]"),
    ({"hits": np.zeros((163, 5), bool)}, r"hits: expected shape \[163, 6\]"),
    ({"actions": np.zeros((17, 2))}, r"actions: expected shape \[16, 2\], got \[17, 2\]"),
    (changed("gripper", (5, 1), np.inf), "gripper: expected finite numbers"),
    (changed("keypoints", (5, 3, 0), np.nan), "keypoints: expected finite numbers where they are seen"),
    (changed("keypoints", (5, 3, 0), 131.0), "keypoints: expected normalised pixels, from 0 to 1"),
    (changed("seen", (slice(None), 9), False), r"seen: expected every keypoint .* got never \['yellow'\]"),
    (changed("actions", (3, 1), -0.0601), "actions: expected displacements of at most 0.06 m, got one of 0.0601"),
    (changed("actions", (3, 1), np.nan), "actions: expected finite numbers"),
    ({"hits": np.arange(163)[:, None] == np.arange(6)}, "hits: expected that a cube that has been hit stays hit"),
    ({"hits": np.array(["no"] * 6)}, "hits: expected an array of bools"),
    ({"camera": UNNORMALISED}, "camera: expected a unit quaternion"),
    ({"camera": WIDE}, "camera: expected a field of view between 0 and 180"),
    ({"image_size": 0}, "image_size: expected a positive number"),
]


@pytest.mark.parametrize("changes, message", REFUSED, ids=[message for _, message in REFUSED])
def test_contents_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        recorded(**changes)


def test_what_is_not_seen_may_be_anything():
    recording = recorded(**changed("seen", (5, 3), False), **changed("keypoints", (5, 3), np.nan))
    assert np.isfinite(trajectory(recording)).all()


# ------------------------------------------------------------------------------------------------- resampling


def expected_states(times: np.ndarray) -> np.ndarray:
    """Gripper and keypoints of the straight lines, shape [T, 22]."""
    lines = STARTS + RATES * times[:, None, None]
    return np.concatenate([GRIPPER(times), lines.reshape(-1, 20)], axis=1)


@pytest.mark.parametrize("control_interval", [0.16, 0.11])
def test_straight_motion_is_resampled_exactly(control_interval):
    recording = recorded(control_interval=control_interval)
    states = resample(recording)
    np.testing.assert_allclose(states[:, :22], expected_states(np.arange(17) * control_interval), atol=1e-6)
    np.testing.assert_array_equal(states[:, 22:], 0)
    assert states.dtype == np.float32


def test_one_frame_a_control_step_is_taken_as_it_is():
    times = np.arange(17) * 0.16
    noise = np.random.default_rng(3).normal(size=(17, 10, 2))
    keypoints = 0.45 + 0.01 * noise
    recording = recorded(times=times, frame_rate=6.25, keypoints=keypoints)
    np.testing.assert_array_equal(resample(recording)[:, 2:22], keypoints.reshape(17, 20).astype(np.float32))


def test_a_trajectory_is_the_state_before_each_action_and_the_action():
    recording = recorded()
    x = trajectory(recording)
    np.testing.assert_array_equal(x[:, :28], resample(recording)[:16])
    np.testing.assert_array_equal(x[:, 28:], recording.actions.astype(np.float32))


def test_gaps_are_bridged_and_ends_are_held():
    """In the middle of a straight motion nothing is lost; before and after it the nearest seen place is held."""
    seen = np.ones((163, 10), bool)
    seen[50:60, 2], seen[:20, 5], seen[100:, 7] = False, False, False
    keypoints = np.where(seen[..., None], recorded().keypoints, 9.0)
    out = filled(recorded(seen=seen, keypoints=keypoints))
    clean = recorded().keypoints
    np.testing.assert_allclose(out[:, 2], clean[:, 2], atol=1e-12)
    np.testing.assert_array_equal(out[:20, 5], np.broadcast_to(clean[20, 5], (20, 2)))
    np.testing.assert_array_equal(out[100:, 7], np.broadcast_to(clean[99, 7], (63, 2)))
    np.testing.assert_array_equal(out[seen], clean[seen])


def knocked(distance: float) -> np.ndarray:
    """Keypoints at rest but for the orange cube, which is displaced obliquely in frames 30 to 39 and then back."""
    keypoints = np.broadcast_to(STARTS, (163, 10, 2)).copy()
    keypoints[30:40, 7] += distance * np.array([0.6, -0.8])
    return keypoints


def test_hits_are_recomputed_by_distance_and_stay():
    flags = hit_flags(recorded(keypoints=knocked(0.061)))
    expected = np.zeros((163, 6), bool)
    expected[30:, 3] = True
    np.testing.assert_array_equal(flags, expected)
    assert not hit_flags(recorded(keypoints=knocked(0.059))).any()


def test_a_flag_is_that_of_the_last_frame_before_an_action():
    times = jittered()
    states = resample(recorded(keypoints=knocked(0.2)))
    np.testing.assert_array_equal(states[:, 25], np.arange(17) * 0.16 >= times[30])
    assert states[:, [22, 23, 24, 26, 27]].sum() == 0


def test_recorded_hits_come_before_recomputed_ones():
    hits = np.zeros((163, 6), bool)
    hits[80:, 1] = True
    states = resample(recorded(keypoints=knocked(0.2), hits=hits))
    np.testing.assert_array_equal(states[:, 23], np.arange(17) * 0.16 >= jittered()[80])
    assert states[:, 25].sum() == 0


def test_a_recording_does_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        recorded().source = "real"
    with pytest.raises(ValueError, match="read-only"):
        recorded().keypoints[0] = 0


# ----------------------------------------------------------------------------------- what comes with the project


def test_the_exploratory_actions_keep_within_the_workspace():
    actions = np.asarray(exploratory_actions())
    places = np.array([0.40, 0.36]) + np.cumsum(actions, axis=0)
    assert actions.shape == (16, 2) and np.abs(actions).max() <= ACTION_LIMIT + 1e-9
    assert (places >= WORKSPACE[0] + 0.01).all() and (places <= WORKSPACE[1] - 0.01).all()
    assert np.ptp(places[:, 0]) > 0.1


@pytest.mark.parametrize("number", range(4))
def test_reference_objects_come_recorded(number):
    path = DATA / f"dlo-{number}.npz"
    recording = read(path)
    assert recording.source == "simulated" and "real" not in path.with_suffix(".json").read_text().lower()
    assert path.stat().st_size < 100_000
    np.testing.assert_allclose(recording.actions, exploratory_actions(), atol=1e-7)
    assert recording.times.size == 161 and recording.seen.mean() > 0.98 and not recording.hits.any()
    assert np.isfinite(trajectory(recording)).all()
    assert recording.facts["length (m)"] == [0.200, 0.200, 0.270, 0.290][number]
