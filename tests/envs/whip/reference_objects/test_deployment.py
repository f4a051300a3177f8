"""Policies on the reference objects: what they see, what they earn, at which places, and the command."""

import csv
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_whip import Rig, a_policy, found

from jaxlfi.design import played
from jaxlfi.envs.whip import cli, rules
from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.parameters import HIGHEST, LOWEST
from jaxlfi.envs.whip.recording import trajectory
from jaxlfi.envs.whip.reference_objects import deployment, objects, repetitions, robot
from jaxlfi.envs.whip.reference_objects.scene import PLACE
from jaxlfi.envs.whip.reference_objects.simulation import UnstableError
from jaxlfi.envs.whip.rig import HIT_DISTANCE, START
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.io import files

KEY = jax.random.key(0)
TOWARDS = np.array([0.03, -0.03])


@pytest.fixture(scope="module")
def whole():
    """All 16 steps of a constant action on one object."""
    return deployment.deploy(KEY, objects.load("dlo-3"), lambda observation: TOWARDS, whole=True)


def test_a_padded_centreline_is_the_same_line():
    rng = np.random.default_rng(0)
    for n in (17, 23, 24, 29):
        line = np.cumsum(rng.normal(size=(n, 3)), axis=0)
        padded = robot.padded(line, 29)
        assert padded.shape == (29, 3)
        fractions = jnp.linspace(0, 1, 50)
        np.testing.assert_allclose(along(padded, fractions), along(line, fractions), atol=1e-4)
    for points in (16, 34):
        with pytest.raises(ValueError, match="points: expected 17 to 33"):
            robot.padded(np.zeros((17, 3)), points)


@pytest.mark.slow
def test_an_episode_is_what_its_own_observations_say(whole):
    """Its return by the rules, recomputed from what was observed."""
    flags = whole.observations[1:, -6:].astype(bool)
    rewards = 2.0 * flags[:, 5] - flags[:, :5] @ rules.PENALTIES
    end = np.argmax(flags[:, rules.TOP]) + 1
    assert flags[:, rules.TOP].any() and not whole.outside
    assert whole.steps == end and whole.value == pytest.approx(rewards[:end].sum(), abs=1e-5)
    np.testing.assert_array_equal(whole.hit, flags[end - 1])
    cubes = whole.observations[:, 10:22].reshape(-1, 6, 2)
    moved = np.logical_or.accumulate(np.linalg.norm(cubes - cubes[0], axis=-1) > HIT_DISTANCE, axis=0)
    np.testing.assert_array_equal(flags, moved[1:])
    np.testing.assert_allclose(whole.observations[0, :2], START, atol=2e-3)
    assert whole.observations.shape == (rules.STEPS + 1, 28) and whole.actions.shape == (rules.STEPS, 2)


def test_a_whole_episode_is_a_recording_to_infer_from(whole):
    seen = trajectory(whole.recording)
    assert seen.shape == (16, 30)
    np.testing.assert_allclose(seen[:, :2], whole.observations[:-1, :2], atol=1e-6)
    np.testing.assert_allclose(seen[:, 28:], whole.actions, atol=1e-7)
    np.testing.assert_array_equal(whole.actions[: whole.steps], np.tile(TOWARDS, (whole.steps, 1)))
    np.testing.assert_array_equal(whole.actions[whole.steps :], 0)  # then it is held still
    assert whole.frames.dlo.shape[0] == 161
    np.testing.assert_allclose(whole.frames.gripper[::10], whole.recording.gripper, atol=1e-7)


@pytest.mark.slow
def test_an_episode_ends_at_its_end_and_repeats(whole):
    again = deployment.deploy(KEY, objects.load("dlo-3"), lambda observation: TOWARDS)
    assert again.recording is None and len(again.actions) == again.steps == whole.steps
    np.testing.assert_array_equal(again.observations, whole.observations[: again.steps + 1])
    away = deployment.deploy(KEY, objects.load("dlo-1"), lambda observation: np.array([-0.06, 0.06]))
    assert away.outside and away.value == -1 and not away.hit.any() and not away.clean_hit


def test_a_simulation_that_becomes_unstable_ends_the_episode_as_far_as_it_came(monkeypatch):
    """In the fourth step; before or after the episode is over."""

    class Fragile(Rig):
        def step(self, action):
            calls.append(action)
            if len(calls) == 4:
                raise UnstableError("dlo-1: became unstable")
            return super().step(action)

    monkeypatch.setattr(robot, "ReferenceRig", Fragile)
    monkeypatch.setattr(robot, "_found", found)
    for action, outside, steps in (((0.01, 0.0), False, 4), ((-0.06, 0.06), True, 3)):
        calls = []
        ended = deployment.deploy(KEY, objects.load("dlo-1"), lambda observation, a=action: np.array(a), whole=True)
        assert (ended.failed, ended.outside, ended.steps) == (not outside, outside, steps)
        assert ended.value == (-1 if outside else 0) and ended.recording is None and ended.frames is None
        assert len(ended.observations) == 4
        expected = np.tile(action, (4, 1)) * np.array([[1], [1], [1], [not outside]])  # the last was too much
        np.testing.assert_array_equal(ended.actions, expected)


def test_actions_that_are_too_large_are_refused():
    """The loop would shorten them; here they are a mistake."""
    with pytest.raises(ValueError, match=r"action: expected dx, dz of at most 0\.06 m"):
        deployment.deploy(KEY, objects.load("dlo-1"), lambda observation: np.array([0.07, 0.0]))


def test_places_are_displaced_as_in_training(key):
    scenes, cameras = deployment.places(key, 200)
    stacks = np.array([scene.stack for scene in scenes])
    views = np.array([camera.position for camera in cameras]) - np.asarray(side_camera(PLACE).position)
    for values, low, high in ((stacks, LOWEST.stack, HIGHEST.stack), (views, LOWEST.camera, HIGHEST.camera)):
        np.testing.assert_allclose(values[0], 0, atol=1e-7)
        assert (values >= np.array(low) - 1e-6).all() and (values <= np.array(high) + 1e-6).all()
        np.testing.assert_allclose(values.std(axis=0), (np.array(high) - low) / 12**0.5, rtol=0.15)


def test_words_for_policies(tmp_path):
    constant = repetitions.acting("constant:0.03,-0.03")()
    np.testing.assert_array_equal(constant(None), TOWARDS)
    np.testing.assert_allclose(repetitions.acting(str(a_policy(tmp_path / "policy.npz")))()(np.zeros(28)), TOWARDS)
    files.write_arrays(tmp_path / "plan.npz", {"actions": np.arange(32.0).reshape(16, 2) / 500})
    begin = repetitions.acting(str(tmp_path / "plan.npz"))
    for _ in range(2):  # every episode begins with the first action
        act = begin()
        np.testing.assert_allclose([act(None) for _ in range(16)][3], [0.012, 0.014])
    for name, actions in (
        ("nan", np.full((16, 2), np.nan)),
        ("short", np.zeros((15, 2))),
        ("words", [["a", "b"]] * 16),
    ):
        files.write_arrays(tmp_path / f"{name}.npz", {"actions": actions})
    for word, expected in (
        ("constant:0.1,0", "policy: expected constant:DX,DZ of at most 0.06 m"),
        ("constant:a", "policy: expected constant:DX,DZ"),
        (str(tmp_path / "none.npz"), "expected a complete"),
        (str(tmp_path / "nan.npz"), "policy: expected finite actions in .*nan.npz, got some that are not"),
        (
            str(tmp_path / "short.npz"),
            r"policy: expected an array actions of shape \[16, 2\] in .*, got float64 of shape",
        ),
        (str(tmp_path / "words.npz"), r"policy: expected an array actions of shape \[16, 2\] in .*, got <U"),
        (str(a_policy(tmp_path / "other.npz", "line")), "policy: expected environment 'whip', got one of 'line'"),
    ):
        with pytest.raises(ValueError, match=expected):
            repetitions.acting(word)


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_what_a_design_says_is_played_in_any_format(kind, tmp_path):
    rows = np.column_stack([0.16 * np.arange(16), np.arange(32.0).reshape(16, 2) / 1000])
    headings = ["time [s]", "dx [m]", "dz [m]"]
    written = played.write(tmp_path / "experiment_1", headings, rows)
    assert [path.name for path in written] == ["experiment_1.csv", "experiment_1.mcap"]
    act = repetitions.acting(str(tmp_path / f"experiment_1.{kind}"))()
    np.testing.assert_allclose([act(None) for _ in range(16)], rows[:, 1:], atol=1e-9)
    np.testing.assert_allclose(repetitions.actions_of(tmp_path / f"experiment_1.{kind}"), rows[:, 1:], atol=1e-9)
    played.write(tmp_path / "slow", headings, rows * [2.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"policy: expected 16 actions in .*slow.*, 0.16 s apart, got others"):
        repetitions.acting(str(tmp_path / f"slow.{kind}"))
    played.write(tmp_path / "other", ["time [s]", "dx [m]", "dy [m]"], rows)
    with pytest.raises(ValueError, match=r"policy: expected signals dx and dz in .*other.*, got no dz"):
        repetitions.acting(str(tmp_path / f"other.{kind}"))


def test_the_command_writes_every_episode_and_their_means(tmp_path, monkeypatch, capsys):
    """With episodes in place of the simulated ones, whose numbers are known."""
    met, values = [], itertools.cycle([2.0, 1.0, -1.0])

    def episode(key, dlo, act, place, camera, perception):
        met.append((dlo.name, tuple(place.stack), jax.random.key_data(key).tolist()))
        value = next(values)
        hit = np.arange(6) >= (5 if value == 2 else 4 if value == 1 else 6)
        left = Aftermath(hit | (np.arange(6) == 3) * hit[5], np.array(False))  # what is hit falls, and the orange cube
        return deployment.Deployed(value, hit, value == -1, False, 7, np.zeros((8, 28)), np.zeros((7, 2)), left)

    monkeypatch.setattr(repetitions, "deploy", episode)
    monkeypatch.setattr(repetitions, "processors", lambda: 1)
    policies = ["constant:0.03,-0.03", str(a_policy(tmp_path / "policy.npz"))]
    out = tmp_path / "out"
    words = ["deploy", *policies, "--object", "dlo-0", "dlo-2", "--repetitions", "3", "--out", str(out)]
    with jax.debug_key_reuse(False):  # all policies meet the same places and noise
        assert cli.main(words) == 0
    with (out / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["policy"], row["object"], row["place"]) for row in rows] == [
        (policy, dlo, str(place)) for policy in policies for dlo in ("dlo-0", "dlo-2") for place in range(3)
    ]
    assert [row["clean_hit"] for row in rows[:3]] == ["True", "False", "False"]
    assert [(row["settled_hit"], row["settled_clean"], row["displaced"]) for row in rows[:3]] == [
        ("True", "False", "2"), ("True", "False", "3"), ("False", "False", "0"),
    ]  # fmt: skip
    assert met[:3] == [("dlo-0", *rest) for _, *rest in met[3:6]]  # the same places and noise
    with (out / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    for line in table:
        names = ("return", "worst", "hit", "clean_hit", "outside", "settled_hit", "settled_clean")
        numbers = [float(line[name]) for name in names]
        np.testing.assert_allclose(numbers, [2 / 3, -1, 2 / 3, 1 / 3, 1 / 3, 2 / 3, 0])
        assert float(line["error"]) == pytest.approx(np.std([2, 1, -1], ddof=1) / 3**0.5)
    assert cli.main(words) == 2
    assert "out: expected a new or empty folder" in capsys.readouterr().err
    for change, expected in ((["--object", "dlo-9"], "dlo-9"), (["--repetitions", "0"], "repetitions: expected")):
        assert cli.main([*words[:-1], str(tmp_path / "new"), *change]) == 2
        assert expected in capsys.readouterr().err
        assert not (tmp_path / "new").exists()
