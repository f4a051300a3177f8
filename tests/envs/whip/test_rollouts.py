"""Several recorded rollouts of one object: simulated, summarised and inferred together."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

import jaxlfi
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import median, randomised
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.real2sim import CHANNELS, DATA, NUISANCES, recorded, task, whip_task
from jaxlfi.envs.whip.trajectory import trajectory
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.registry import TASKS
from jaxlfi.tasks.observation import simulator_shapes
from tests.small import command

NATIVE = NativeEngine()
MASK = DETECTORS["mask"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings of dlo-2: with other actions and a camera of its own (a.npz), and as it was (b.npz)."""
    folder = tmp_path_factory.mktemp("rollouts")
    recording = recorded("dlo-2")
    fields = {name: getattr(recording, name) for name in recording.__dataclass_fields__}
    camera = recording.camera.replace(position=recording.camera.position + jnp.array([0.01, 0.0, 0.02]))
    actions = np.asarray(exploratory_actions(1), float)
    recordings.write(folder / "a.npz", recordings.Recording(**{**fields, "actions": actions, "camera": camera}))
    recordings.write(folder / "b.npz", recording)
    return folder


@pytest.fixture(scope="module")
def pair(folder):
    return task(object=("dlo-2", str(folder / "a.npz")), engine="native", pooling="all")


def test_a_simulation_is_those_of_the_single_rollouts_with_keys_of_their_own(pair, folder, key):
    theta = jnp.array([250.0, 6e3])
    found, valid = jax.jit(pair.simulate)(jax.random.clone(key), theta)
    single = jax.jit(lambda key, camera, actions: trajectory(key, NATIVE, MASK, camera, median(0.25, 6e3), actions))
    expected = []
    for i, name in enumerate(("dlo-2", str(folder / "a.npz"))):
        recording = recorded(name)
        _, key_keypoints = jax.random.split(jax.random.fold_in(key, i))
        rows, _ = single(key_keypoints, recording.camera, jnp.asarray(recording.actions, jnp.float32))
        expected.append(rows)
    assert found.shape == (32, 30) and bool(valid)
    np.testing.assert_allclose(found, np.concatenate(expected), atol=2e-5)
    first, second = np.split(np.asarray(found), 2)
    np.testing.assert_allclose(first[:, 28:], exploratory_actions(), atol=1e-7)
    np.testing.assert_allclose(second[:, 28:], exploratory_actions(1), atol=1e-7)
    # Errors are drawn anew, so that the grip at rest is measured at another place.
    assert np.abs(first[0, :2] - second[0, :2]).min() > 0
    # The second camera stands 2 cm higher, of 0.6 m that it sees: what hangs still is 1/30 lower in the image.
    shift = second[0, 10:22].reshape(6, 2) - first[0, 10:22].reshape(6, 2)
    np.testing.assert_allclose(shift.mean(axis=0), [-1 / 60, 1 / 30], atol=0.01)


@pytest.mark.slow
def test_eager_is_jit_and_a_batch_is_its_simulations(pair, key):
    theta = jnp.array([[230.0, 8e3], [280.0, 3e4]])
    keys = jax.random.split(key, 2)
    batch, _ = jax.jit(jax.vmap(pair.simulate))(jax.random.clone(keys), theta)
    eager, _ = pair.simulate(keys[1], theta[1])
    np.testing.assert_allclose(batch[1], eager, atol=2e-5)


def test_the_observation_and_its_summary_are_those_of_the_rollouts(pair, folder):
    names = ("dlo-2", str(folder / "a.npz"))
    each = [recordings.trajectory(recorded(name)) for name in names]
    np.testing.assert_array_equal(pair.observation, np.concatenate(each))
    assert simulator_shapes(pair).trajectory == pair.observation.shape == (32, 30)
    assert pair.name == "whip x 2" and pair.channels == CHANNELS
    assert pair.record_label == "control step of 2 rollouts, one after another"
    single = task(object="dlo-2", engine="native")
    apart = np.stack([single.summary(jnp.asarray(one)) for one in each])
    mean = task(object=names, engine="native")
    moments = task(object=names, engine="native", pooling="moments")
    for made, expected in (
        (pair, apart.ravel()),
        (mean, apart.mean(axis=0)),
        (moments, np.concatenate([apart.mean(axis=0), apart.std(axis=0, ddof=1)])),
    ):
        np.testing.assert_allclose(made.summary(jnp.asarray(made.observation)), expected, rtol=1e-5, atol=1e-5)
        assert len(made.named_summaries(expected.size)) == expected.size
    assert pair.summary_names[112] == f"{single.summary_names[0]} of rollout 2"
    assert mean.summary_names[0] == f"mean of {single.summary_names[0]}"
    assert pair.settings == single.settings  # rollouts in a fixed order: no network of exchangeable trials


def test_one_recording_is_what_it_was():
    several, one = task(object=("dlo-2",), engine="native", pooling="all"), task(object="dlo-2", engine="native")
    assert several.name == one.name == "whip" and several.record_label == one.record_label
    np.testing.assert_array_equal(several.observation, one.observation)
    assert several.summary_names == one.summary_names and several.summary.func is one.summary.func


def test_a_failure_of_one_rollout_is_one_of_all(key):
    shaky = NativeEngine(Scene(chain=Chain(elements=16, retardation=0.0, viscosity=0.0), timestep=0.005))
    stiff, still, wild = jnp.array([100.0, 5e5]), jnp.zeros((3, 2)), jnp.array([[0.06, 0.0], [-0.06, 0.0], [0.06, 0.0]])

    @jax.jit
    def valid(key, actions):
        return whip_task(shaky, DETECTORS["clean"], NUISANCES["fixed"], actions).simulate(key, stiff)[1]

    cases = ((still, still), (still, wild), (wild, still))
    found = [bool(valid(jax.random.clone(key), jnp.stack(case))) for case in cases]
    assert found == [True, False, False]


@pytest.mark.slow
def test_rollouts_share_the_object_but_not_the_place_of_the_stack(key):
    clean = DETECTORS["clean"]
    made = whip_task(NATIVE, clean, NUISANCES["random"], jnp.stack([exploratory_actions()] * 2))
    found, _ = jax.jit(made.simulate)(jax.random.clone(key), jnp.array([250.0, 5e3]))
    first, second = np.split(np.asarray(found), 2)
    np.testing.assert_allclose(first[:, :10], second[:, :10], atol=1e-5)  # the same DLO and camera
    assert np.abs(first[0, 10:22:2] - second[0, 10:22:2]).min() > 1e-4  # another place along x
    keys = [jax.random.split(jax.random.fold_in(key, i))[0] for i in range(2)]
    stacks = [float(randomised(one, 0.25, 5e3).stack[0]) for one in keys]
    shift = np.mean(second[0, 10:22:2] - first[0, 10:22:2]) * 0.6  # of the image's width, in m at the stack
    np.testing.assert_allclose(shift, stacks[1] - stacks[0], rtol=0.1, atol=5e-4)


def test_other_exploratory_actions_are_the_same_steps_in_another_order():
    ordered = lambda actions: np.sort(np.asarray(actions)[:, 0])
    first = exploratory_actions()
    for seed in range(1, 9):
        actions = exploratory_actions(seed)
        np.testing.assert_array_equal(ordered(actions), ordered(first))
        assert not np.array_equal(actions, first)
        path = np.array([0.40, 0.36]) + np.cumsum(actions, axis=0)
        assert np.all(path > rules.WORKSPACE[0] + 0.0099) and np.all(path < rules.WORKSPACE[1] - 0.0099)
    np.testing.assert_array_equal(exploratory_actions(3), exploratory_actions(3))


def test_no_dlo_of_the_initial_support_reaches_the_cubes_or_leaves_the_image():
    actions = jnp.stack([exploratory_actions(seed) for seed in range(4)])
    made = whip_task(NATIVE, DETECTORS["clean"], NUISANCES["fixed"], actions)
    corners = jnp.array([[305.0, 1e3], [305.0, 1.5e4], [305.0, 5e4], [195.0, 1e3], [195.0, 5e4]])
    found, valid = jax.jit(jax.vmap(lambda theta: made.simulate(jax.random.key(0), theta)))(corners)
    keypoints = np.asarray(found).reshape(5, 4, 16, 30)[..., 2:22].reshape(5, 4, 16, 10, 2)
    assert np.all(valid) and keypoints.min() > 0 and keypoints.max() < 1
    cubes = keypoints[..., 4:, :]
    np.testing.assert_allclose(cubes, np.broadcast_to(cubes[:1, :1, :1], cubes.shape), atol=1e-5)


def test_what_is_refused(folder, tmp_path):
    a, b = str(folder / "a.npz"), str(folder / "b.npz")
    short = tmp_path / "short.npz"
    arrays = dict(np.load(DATA / "dlo-2.npz"))
    np.savez(short, **{**arrays, "actions": arrays["actions"][:12]})
    short.with_suffix(".json").write_bytes((DATA / "dlo-2.json").read_bytes())
    other = tmp_path / "other.npz"
    other.write_bytes((DATA / "dlo-2.npz").read_bytes())
    described = json.loads((DATA / "dlo-2.json").read_text())
    other.with_suffix(".json").write_text(json.dumps({**described, "schema": "another"}))
    slow = tmp_path / "slow.npz"
    np.savez(slow, **{**arrays, "times": arrays["times"] * 1.25})
    described |= {"control_interval": 0.2, "frame_rate": 50.0}
    slow.with_suffix(".json").write_text(json.dumps(described))
    for given, said in (
        (("dlo-2", "dlo-9"), "object: expected one of dlo-0, .* got 'dlo-9'"),
        (("dlo-2", str(short)), r"short: actions: expected shape \[16, 2\], got \[12, 2\]"),
        (("dlo-2", str(other)), "other: schema: expected 'jaxlfi.whip.recording'"),
        (("dlo-2", str(slow)), r"object: expected recordings of one control interval, got 0\.16, 0\.2 s"),
        ((a, b, a), "object: expected different recordings, got "),
        ((), "object: expected at least one, got none"),
    ):
        with pytest.raises(ValueError, match=said):
            task(object=given, engine="native")
    with pytest.raises(ValueError, match=r"pooling: expected one of \['all', 'mean', 'moments'\], got 'median'"):
        task(object=("dlo-2", a), pooling="median")
    with pytest.raises(ValueError, match=r"actions: expected shape \[T, 2\], or \[n, T, 2\] of rollouts, got \[16\]"):
        whip_task(NATIVE, MASK, NUISANCES["fixed"], jnp.zeros(16))


@pytest.mark.slow
def test_a_run_of_two_recordings_is_loaded_again_by_its_reference(folder, tmp_path, capsys):
    flags = "--rounds 1 --simulations-per-round 6 --simulation-budget 7 --steps 20 --ensemble-size 1".split()
    flags += "--hidden 8 --seeds 1 --validation 0 --patience 0 --prune 0".split()
    a, out = str(folder / "a.npz"), tmp_path / "run"
    assert command("infer", "whip,engine=native", *flags, "--object", "dlo-2", a, "--out", out) == 0
    reference = json.loads((out / "config.json").read_text())["task"]
    assert reference == f"whip,engine=native,object=dlo-2;{a}"
    run = jaxlfi.load(out)
    assert run.task.name == "whip x 2" and run.observed.shape == (32, 30) and run.x.shape == (112,)
    np.testing.assert_array_equal(run.task.observation, TASKS.load(reference).observation)
    assert (out / "report.html").exists() and list((out / "figures").glob("*.png"))
    assert command("resume", out) == 0
    capsys.readouterr()
    assert command("infer", "whip,engine=native", *flags, "--object", "dlo-2", "dlo-9", "--out", tmp_path / "no") == 2
    assert "object: expected one of dlo-0" in capsys.readouterr().err and not (tmp_path / "no").exists()
