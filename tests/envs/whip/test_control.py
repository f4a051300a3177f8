"""Policies on robots of the whipping task: observations, limits, recordings to infer from, and the command."""

import dataclasses
import json
import subprocess
import sys
from typing import ClassVar

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_whip import EVERYWHERE, Rig, a_policy, found

from jaxlfi.envs.whip import cli, control, recording, rules
from jaxlfi.envs.whip.environment import LIMITS, OBSERVATIONS
from jaxlfi.envs.whip.observer import Observer
from jaxlfi.envs.whip.real2sim import recorded
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.io import files
from jaxlfi.rl.policy import load
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.robot import Observation

CAMERA = {"position": [0.45, -0.8, 0.25], "orientation": [0.5**0.5, 0.5**0.5, 0.0, 0.0], "field_of_view": 40.0}
ALL = np.ones(10, bool)


class Gripper:
    """A robot whose gripper is at its set-point at once; at its fourth command the top cube falls.

    Attributes:
        made: all of them.
    """

    made: ClassVar[list["Gripper"]] = []

    def __init__(self, about='{"camera": "there"}', lost: int = -1, numbers: int = 28):
        self.about = json.loads(about, object_hook=lambda found: {**found, "camera": CAMERA})
        self.simulated_clock, self.observer, self.stops, self.commands = Simulated(), Observer(), 0, []
        self.position, self.lost, self.numbers = np.array([0.4, 0.36]), lost, numbers
        Gripper.made.append(self)

    def observe(self):
        number = len(self.commands)
        if number >= self.lost >= 0:
            return None
        keypoints = EVERYWHERE + np.where(np.arange(10)[:, None] == 9, [0.1 * (number > 3), 0.0], 0.0)
        keypoints[1] += 0.01 * number
        seen = ALL & (np.arange(10) != number)
        values = self.observer.observe(self.position, np.where(seen[:, None], keypoints, np.nan), seen)
        return Observation(values[: self.numbers], number, age=0.02, extras={"seen": seen})

    def act(self, command):
        self.commands.append(command)
        self.position = command.target

    def stop(self):
        self.stops += 1


def run(tmp_path, capsys, *words, robot=f"{__name__}:Gripper", policy=None):
    """Exit status, output, error, and the robot if one was made."""
    Gripper.made.clear()
    path = policy or tmp_path / "policy.npz"
    if not path.exists():
        a_policy(path)
    status = cli.main(["control", str(path), "--robot", robot, "--out", str(tmp_path / "rollout.npz"), *words])
    out, error = capsys.readouterr()
    assert error.count("\n") <= 1
    return status, out, error, Gripper.made[0] if Gripper.made else None


@pytest.fixture
def found_here(monkeypatch):
    """Modules of tests have no place in a package."""
    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or sys.modules[Gripper.__module__])


# -------------------------------------------------------------------------------------------------------- observations


def test_keypoints_that_are_not_seen_stay_where_they_were_and_cubes_that_moved_stay_hit():
    observer = Observer()
    all_but = lambda place, points: (np.where(np.arange(10)[:, None] == place, np.nan, points), np.arange(10) != place)
    first = observer.observe([0.41, 0.35], *all_but(2, EVERYWHERE))
    expected = EVERYWHERE.copy()
    expected[2] = 0.5  # never seen
    np.testing.assert_allclose(first, [0.41, 0.35, *expected.ravel(), *[0] * 6], rtol=1e-6)
    expected[2], expected[3], expected[6] = [0.31, 0.52], [0.4, 0.6], expected[6] + [0.0, -0.061]
    second = observer.observe([0.42, 0.34], *all_but(5, expected))
    np.testing.assert_allclose(second, [0.42, 0.34, *expected.ravel(), 0, 0, 1, 0, 0, 0], rtol=1e-6)
    expected[6] -= [0.0, -0.061]
    expected[9] += [0.059, 0.0]  # not far enough
    third = observer.observe([0.42, 0.34], expected, ALL)
    np.testing.assert_allclose(third[2:], [*expected.ravel(), 0, 0, 1, 0, 0, 0], rtol=1e-6)
    assert third.dtype == np.float32 and third.shape == (OBSERVATIONS.size,)


def test_a_cube_that_is_found_late_has_not_been_hit():
    observer, late = Observer(), np.arange(10) != 9
    assert not observer.observe([0.4, 0.3], np.where(late[:, None], EVERYWHERE, np.nan), late)[22:].any()
    there = np.where(late[:, None], EVERYWHERE, [0.75, 0.8])
    assert not observer.observe([0.4, 0.3], there, ALL)[22:].any()
    there[9] -= 0.05
    assert observer.observe([0.4, 0.3], there, ALL)[22:].tolist() == [0, 0, 0, 0, 0, 1]


def test_an_observer_needs_no_jax():
    program = (
        "import sys; sys.modules['jax'] = sys.modules['mujoco'] = sys.modules['jaxtyping'] = None\n"
        "import numpy as np; from jaxlfi.envs.whip.observer import Observer\n"
        "print(Observer().observe([0.4, 0.3], np.full((10, 2), 0.25), np.ones(10, bool)).sum())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(0.7 + 20 * 0.25)


def test_an_episode_is_over_by_the_rules():
    nothing = np.array([0.4, 0.3, *[0.5] * 20, *[0] * 6], np.float32)
    change = lambda place, value: np.where(np.arange(28) == place, value, nothing)
    assert not control.is_over(nothing)
    for place, value in ((0, 0.27), (0, 0.61), (1, 0.09), (1, 0.51), (27, 1.0)):
        assert control.is_over(change(place, value)), (place, value)
    for place in range(22, 27):
        assert not control.is_over(change(place, 1.0))
    for gripper in ([0.275, 0.1], [0.6, 0.5], [0.2749, 0.3], [0.4, 0.5001]):
        seen = np.array([*gripper, *nothing[2:]], np.float32)
        assert control.is_over(seen) == bool(rules.outside(seen[:2]))


# ---------------------------------------------------------------------------------------------------------- the command


def test_a_rollout_on_a_robot_is_a_recording_to_infer_from(tmp_path, capsys, found_here):
    status, out, _, robot = run(tmp_path, capsys)
    assert status == 0 and robot.stops == 1 and len(robot.commands) == 16
    assert out == (
        "16 steps at 6.25 Hz, over after 4, 0 without a usable observation, 0 deadlines missed, hit yellow, "
        f"wrote {tmp_path / 'rollout.npz'}\n"
    )
    made = recorded(str(tmp_path / "rollout.npz"))
    actions = np.where(np.arange(16)[:, None] < 4, [0.03, -0.03], 0.0)  # and then it is held still
    np.testing.assert_allclose(made.actions, actions, atol=1e-7)
    np.testing.assert_allclose(made.times, 0.16 * np.arange(17) - 0.02, atol=1e-9)
    np.testing.assert_allclose(made.gripper[1:] - [0.4, 0.36], np.cumsum(actions, axis=0), atol=1e-6)
    moved = 0.01 * np.array([0, 0, *range(2, 17)])  # the second was not seen in the second frame
    np.testing.assert_allclose(made.keypoints[:, 1, 0], EVERYWHERE[1, 0] + moved, atol=1e-6)
    assert (~made.seen).sum() == 10 and not made.seen[3, 3] and made.hits[4:, 5].all() and made.hits.sum() == 13
    assert made.source == "real" and made.frame_rate == 6.25
    np.testing.assert_allclose(made.camera.position, CAMERA["position"])
    seen = recording.trajectory(made)
    np.testing.assert_allclose(seen[:, 28:], actions, atol=1e-7)
    more = files.read_arrays(tmp_path / "rollout.npz")
    np.testing.assert_allclose(more["log/targets"][3], [0.52, 0.24], atol=1e-6)


def test_limits_rate_and_patience_are_those_of_the_arguments(tmp_path, capsys, found_here):
    words = ["--max-speed", "0.1", "--workspace", "0.3", "0.41", "0.2", "0.5"]
    status, _, _, robot = run(tmp_path, capsys, *words)
    assert status == 0
    # 1.6 cm by the speed, and only 1 cm along x is left of the workspace.
    np.testing.assert_allclose(robot.commands[0].displacement, [0.01, -0.016 / 2**0.5], atol=1e-7)
    (tmp_path / "rollout.npz").unlink(), (tmp_path / "rollout.json").unlink()
    status, out, error, robot = run(tmp_path, capsys, "--holds", "1", robot=f"{__name__}:Gripper,lost=5")
    assert status == 2 and robot.stops == 1 and len(robot.commands) == 6
    assert "cannot be inferred from" in out and "expected 16 control steps, got 6: 2 observations in a row" in out
    assert "robot: stopped after 6 of 16 steps: 2 observations in a row could not be used" in error
    assert files.read_arrays(tmp_path / "rollout.npz")["log/held"].tolist() == [False] * 5 + [True]
    (tmp_path / "rollout.npz").unlink()
    status, out, _, robot = run(tmp_path, capsys, "--rate", "12.5")
    assert status == 0 and "16 steps at 12.5 Hz" in out
    assert "expected control steps of 0.16 s, as simulations have, got 0.08 s" in out


def test_the_limits_of_a_policy_are_its_own(tmp_path, capsys, found_here):
    plain = load(a_policy(tmp_path / "plain.npz"))
    facts = {"control_interval": 0.16, "steps": 16, "moved": ["gripper x", "gripper z"], "detector": {"name": "mask"}}
    limits = {**dataclasses.asdict(LIMITS), "step": [0.02, 0.01]}
    schema = {**plain.schema, "deployment": {**facts, "limits": limits}}
    path = dataclasses.replace(plain, schema=schema).save(tmp_path / "careful.npz")
    _, _, _, robot = run(tmp_path, capsys, policy=path)
    np.testing.assert_allclose(robot.commands[0].displacement, [0.02, -0.01])


def test_a_camera_that_a_robot_does_not_tell_is_the_nominal_one_and_that_is_noted(tmp_path, capsys, found_here):
    fields = control.described({"source": "simulated", "provenance": {"lab": "ours"}})
    assert fields["provenance"] == {"lab": "ours", "camera": "nominal: the robot did not say"}
    assert isinstance(fields["camera"], Camera) and fields["source"] == "simulated"
    for about, expected in (
        ({"colour": "red"}, "expected camera, .* as information about itself, got colour"),
        (None, "expected a mapping as information about itself, got None"),
        ({"facts": 3}, "expected dict as its facts, which JSON can hold, got 3"),
        ({"image_size": "256"}, "expected int as its image_size, which JSON can hold, got '256'"),
        ({"provenance": {"lab": object()}}, "expected dict as its provenance, which JSON can hold"),
        ({"camera": "there"}, "expected a camera's .*field_of_view, got 'there'"),
        ({"camera": {**CAMERA, "position": [1.0]}}, r"expected a camera's .* of shapes \[3\], \[4\], \[\]"),
    ):
        with pytest.raises(ValueError, match=f"robot: {expected}"):
            control.described(about)
    status, _, error, robot = run(tmp_path, capsys, robot=f'{__name__}:Gripper,about={{"colour": "red"}}')
    assert status == 2 and "got colour" in error and robot.stops == 1 and not robot.commands


def test_what_happened_before_a_robot_failed_is_kept(tmp_path, capsys, found_here, monkeypatch):
    act = Gripper.act

    def failing(self, command):
        if command.slot == 5:
            raise OSError("cable")
        act(self, command)

    monkeypatch.setattr(Gripper, "act", failing)
    status, out, error, robot = run(tmp_path, capsys)
    assert status == 2 and "cable" in error and robot.stops == 1
    assert "expected 16 control steps, got 5" in out and "hit yellow" in out
    assert files.read_arrays(tmp_path / "rollout.npz")["log/targets"].shape == (5, 2)


def test_bad_input_moves_no_robot(tmp_path, capsys, found_here):
    other = a_policy(tmp_path / "other.npz", "line")
    for words, named, expected in (
        (["--rate", "0"], {}, "rate: expected a positive number, got 0.0"),
        (["--rate", "-1"], {}, "rate: expected a positive number, got -1.0"),
        (["--holds", "-1"], {}, "holds: expected at least 0"),
        (["--max-step", "0.07"], {}, "step: expected more than 0 and at most the policy's (0.06, 0.06), got 0.07"),
        (["--max-speed", "0"], {}, "speed: expected more than 0"),
        (["--workspace", "0.2", "0.6", "0.1", "0.5"], {}, "low: expected limits within the policy's [0.275, 0.1]"),
        ([], {"policy": other}, "policy: expected environment 'whip', got one of 'line'"),
        ([], {"robot": "dlo-9"}, "expected one of dlo-0, dlo-1, dlo-2, dlo-3, got 'dlo-9'"),
        ([], {"robot": "math:pi"}, "robot: expected 'math:pi' to have observe, act and stop, got float"),
        ([], {"robot": "nowhere:Robot"}, "robot: cannot load 'nowhere:Robot'"),
        ([], {"robot": "socket://10.1.2.3:80"}, "robot: expected this host, such as 127.0.0.1, got '10.1.2.3'"),
        ([], {"robot": "socket://127.0.0.1"}, "robot: expected socket://HOST:PORT"),
        (["--out", str(tmp_path / "rollout.csv")], {}, "out: expected a new .npz file"),
    ):
        status, _, error, robot = run(tmp_path, capsys, *words, **named)
        assert status == 2 and expected in error and robot is None, error
    status, _, error, robot = run(tmp_path, capsys, robot=f"{__name__}:Gripper,numbers=27")
    assert status == 2 and "robot: expected observations of 28 numbers, got shape [27]" in error
    assert robot.stops == 1 and not robot.commands
    assert not (tmp_path / "rollout.npz").exists()


def test_a_reference_object_is_a_robot_whose_observations_are_those_of_its_deployment(tmp_path, capsys, monkeypatch):
    """With a rig in place of the simulation, whose gripper is where it was told to be."""
    from jaxlfi.envs.whip.reference_objects import robot as reference

    monkeypatch.setattr(reference, "ReferenceRig", Rig)
    monkeypatch.setattr(reference, "_found", found)
    status, out, _, _ = run(tmp_path, capsys, robot="dlo-2")
    assert status == 0 and "0 deadlines missed" in out
    seen = recorded(str(tmp_path / "rollout.npz"))
    np.testing.assert_allclose(seen.gripper[:3], [[0.4, 0.36], [0.43, 0.33], [0.46, 0.30]], atol=1e-6)
    assert seen.gripper[-1].tolist() == pytest.approx([0.6, 0.1])  # the corner of the workspace, and no further
    assert seen.description.startswith("dlo-2") and seen.source == "simulated"


def test_a_simulation_that_becomes_unstable_is_one_line(tmp_path, capsys, monkeypatch):
    from jaxlfi.envs.whip.reference_objects import robot as reference
    from jaxlfi.envs.whip.reference_objects.simulation import UnstableError

    class Fragile(Rig):
        def step(self, action):
            raise UnstableError("dlo-2: became unstable")

    monkeypatch.setattr(reference, "ReferenceRig", Fragile)
    monkeypatch.setattr(reference, "_found", found)
    status, _, error, _ = run(tmp_path, capsys, robot="dlo-2")
    assert status == 2 and error == "jaxlfi whip: error: robot: dlo-2: became unstable\n"
