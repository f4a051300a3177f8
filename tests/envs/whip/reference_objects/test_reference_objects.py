"""The FEM reference objects against beam theory, statics and their own recordings."""

import ast
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.physics import scene as simulated
from jaxlfi.envs.whip.recording import read
from jaxlfi.envs.whip.reference_objects import objects, scene
from jaxlfi.envs.whip.reference_objects.calibration import at_rest, calibrate
from jaxlfi.envs.whip.reference_objects.elastica import heavy_cantilever, number_of_sag
from jaxlfi.envs.whip.reference_objects.objects import TABLE, load
from jaxlfi.envs.whip.reference_objects.observation import found
from jaxlfi.envs.whip.reference_objects.scene import cantilever_model, cells, centreline
from jaxlfi.envs.whip.reference_objects.simulation import FRAME_INTERVAL, ReferenceRig, UnstableError
from jaxlfi.envs.whip.rig import GRAVITY, SECTION, START
from jaxlfi.envs.whip.vision.camera import project
from jaxlfi.envs.whip.vision.keypoints import ON_DLO, along
from jaxlfi.envs.whip.vision.masks import EVEN


@pytest.fixture(scope="module")
def rig() -> ReferenceRig:
    return ReferenceRig(load("dlo-1"))


# ------------------------------------------------------------------------------------------------- the elastica


def shot(number: float) -> tuple[float, float]:
    """Reach and sag by shooting: guess the curvature at the clamp until there is none at the tip."""

    def integrate(curvature, ends=None):
        derivative = lambda s, y: [y[1], -number * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]
        return solve_ivp(derivative, (0, 1), [0, curvature, 0, 0], rtol=1e-10, atol=1e-12).y[:, -1]

    last = integrate(brentq(lambda curvature: integrate(curvature)[1], 0, 0.6 * number))
    return last[2], last[3]


@pytest.mark.parametrize("number", [0.7, 5.0, 20.0])
def test_the_elastica_is_that_of_shooting(number):
    np.testing.assert_allclose(heavy_cantilever(number), shot(number), rtol=1e-5)


def test_a_small_sag_is_that_of_linear_beams():
    """w L^4 / (8 E I), less than 1 % off at a sag of 1 %."""
    assert heavy_cantilever(0.1)[1] == pytest.approx(0.1 / 8, rel=0.01)


def test_the_number_of_a_sag():
    assert number_of_sag(heavy_cantilever(7.0)[1]) == pytest.approx(7.0, rel=1e-4)
    for sag in (0.001, 0.99, np.nan):
        with pytest.raises(ValueError, match="sag: expected a fraction of the length from"):
            number_of_sag(sag)


# ------------------------------------------------------------------------------------------------ the soft body


def test_objects_are_those_of_the_table():
    dlos = [load(f"dlo-{i}") for i in range(4)]
    assert [dlo.length for dlo in dlos] == [0.200, 0.200, 0.270, 0.290]
    assert [dlo.mass for dlo in dlos] == [0.04747, 0.04294, 0.05780, 0.06394]
    medium, extra, soft, other = (dlo.effective_young for dlo in dlos)
    assert medium > soft > extra == other
    assert dlos[0].light_young > 5e4 and all(1e3 < dlo.light_young < 5e4 for dlo in dlos[1:])
    with pytest.raises(ValueError, match=r"name: expected one of dlo-0, .*, got 'dlo-4'"):
        load("dlo-4")
    for dlo in TABLE:
        assert dataclasses.replace(load(dlo.name), young=dlo.young) == dlo


def test_an_object_has_its_calibrated_modulus():
    dlo = load("dlo-1")
    assert calibrate(dlo).effective_young == pytest.approx(dlo.effective_young, rel=5e-3)


def test_an_object_sags_in_the_shape_of_the_elastica():
    """All along, and with both ends: what the calibration by the tip alone could not see."""
    dlo, number = load("dlo-2"), 12.0
    weight = dlo.density * SECTION**2 * dlo.length**3 / (SECTION**4 / 12)
    line = at_rest(dlo, (number * dlo.effective_young / weight, 0.0, 0.0)) / dlo.length
    slope = lambda s, y: [y[1], -number * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]
    clamped = brentq(lambda c: solve_ivp(slope, (0, 1), [0, c, 0, 0], rtol=1e-9).y[1, -1], 0, 0.6 * number)
    arc = np.linspace(0, 1, cells(dlo) + 1)
    beam = solve_ivp(slope, (0, 1), [0, clamped, 0, 0], rtol=1e-9, t_eval=arc).y[2:]
    np.testing.assert_allclose([-line[:, 2], line[:, 0]], beam, atol=0.012)
    np.testing.assert_allclose(line[:, 1], 0, atol=1e-6)


def test_an_object_swings_at_the_frequency_of_a_beam():
    """1.8751^2 / (2 pi) sqrt(E I / (rho A L^4)), without gravity: the mass is where it should be, too."""
    dlo = dataclasses.replace(load("dlo-0"), damping=1e-6)
    model = cantilever_model(dlo, (2.0, 0.0, 0.0), timestep=0.001)
    data, places = mujoco.MjData(model), []
    mujoco.mj_step(model, data, nstep=60)
    model.opt.gravity[:] = 0
    for _ in range(700):
        mujoco.mj_step(model, data)
        places.append(centreline(dlo, data)[-1, 0])
    crossings = np.flatnonzero(np.diff(np.sign(places)))
    measured = 1 / (2 * np.diff(crossings).mean() * model.opt.timestep)
    bending = dlo.effective_young * SECTION**2 / 12 / dlo.density
    assert measured == pytest.approx(1.8751**2 / (2 * np.pi) * np.sqrt(bending) / dlo.length**2, rel=0.03)


def test_the_gripper_bears_the_weight_once_and_the_object_is_stretched_by_it(rig):
    """All mass hangs except the held nodes; a bar of that cross-section stretches by m g l / (2 E A)."""
    frame, dlo = rig.reset(), rig.dlo
    hanging = dlo.mass * (1 - 1 / (2 * cells(dlo)))
    assert (START[1] - frame.gripper[1]) * 900 == pytest.approx(hanging * GRAVITY, rel=1e-3)
    section = (SECTION - 2 * scene.SKIN) ** 2
    stretch = dlo.mass * GRAVITY * dlo.length / (2 * dlo.young * section)
    assert frame.dlo[0, 2] - frame.dlo[-1, 2] - dlo.length == pytest.approx(stretch, rel=0.06)


# ---------------------------------------------------------------------------------------------------- episodes


def test_an_episode_begins_at_rest(rig):
    frame = rig.reset()
    np.testing.assert_allclose(frame.gripper, START, atol=1e-3)
    np.testing.assert_allclose(frame.dlo[0, [0, 2]], frame.gripper, atol=1e-9)
    np.testing.assert_allclose(frame.dlo[:, :2], [[0.40, 0.0]] * 17, atol=1e-5)
    side = float(rig.place.cube_side)
    np.testing.assert_allclose(frame.cubes, [[0.60, 0, side * (i + 0.5)] for i in range(6)], atol=5e-4)
    np.testing.assert_allclose(frame.orientations, [[1, 0, 0, 0]] * 6, atol=1e-5)
    after = rig.step([0.0, 0.0])
    assert np.abs(after.dlo - frame.dlo).max() < 1e-4 and np.abs(after.cubes - frame.cubes).max() < 1e-5


def test_the_scene_is_where_the_simulated_one_is():
    """Written twice, as the two share no physics."""
    other = simulated.compile_model(simulated.Scene(), scene.PLACE)
    own = scene.whip_model(load("dlo-1"), scene.PLACE.replace(stack=(0.02, -0.005), cube_side=0.02))
    cube = own.body("yellow")
    np.testing.assert_allclose(cube.pos, [0.62, -0.005, 0.11], atol=1e-9)
    assert cube.mass == pytest.approx(1.54e-3 * (20 / 25) ** 3)
    yellow = other.body(simulated.cube_names()[-1])
    assert scene.whip_model(load("dlo-1")).body("yellow").mass == pytest.approx(yellow.mass, rel=1e-5)
    np.testing.assert_allclose(own.actuator_gainprm[:, 0], other.actuator_gainprm[:, 0])
    np.testing.assert_allclose(own.actuator_biasprm[:, :3], other.actuator_biasprm[:, :3])
    assert own.body("gripper").mass == other.body("gripper").mass


def test_the_physics_is_not_that_of_inference():
    folder = Path(objects.__file__).parent
    shared = {"frames", "parameters", "recording", "reference_objects", "rig", "rules", "vision"}
    # Policies act on the objects by the task's observations, and films are drawn by its figures.
    acting = {
        "robot": {"aftermath", "observer"},
        "deployment": {"aftermath", "control", "observer"},
        "repetitions": {"environment"},
        "film": {"figures", "render"},
    }
    for path in folder.glob("*.py"):
        modules = {node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)}
        own = {module.split(".")[3] for module in modules if module.startswith("jaxlfi.envs.whip.")}
        assert own <= shared | acting.get(path.stem, set()), path.name


def test_steps_make_a_rollout_and_a_reset_forgets(rig):
    """Into the stack, and then the same again from the beginning, to the last bit."""
    actions = np.array([[0.06, -0.06]] * 2 + [[0.06, 0.0]] * 2)
    times, frames = rig.rollout(actions)
    np.testing.assert_allclose(times, 0.016 * np.arange(41))
    assert (
        frames.dlo.shape == (41, 17, 3) and frames.cubes.shape == (41, 6, 3) and frames.orientations.shape == (41, 6, 4)
    )
    again = [rig.reset(), *(rig.step(action) for action in actions)]
    np.testing.assert_array_equal(frames.dlo[0], again[0].dlo)
    for name in ("gripper", "dlo", "cubes", "orientations"):
        stepped = np.concatenate([getattr(part, name) for part in again[1:]])
        np.testing.assert_array_equal(getattr(frames, name)[1:], stepped)

    target = np.array(START) + np.cumsum(actions, axis=0)
    assert np.abs(frames.gripper[10::10] - target).max() < 0.03  # it lags by some 2 / 30 s
    moved = frames.cubes[-1, :, 0] - frames.cubes[0, :, 0]
    assert moved.max() > 0.03 and moved.min() > 0  # all have been pushed away
    np.testing.assert_allclose(np.linalg.norm(frames.orientations, axis=-1), 1, atol=1e-9)
    lengths = np.linalg.norm(np.diff(frames.dlo, axis=1), axis=-1).sum(axis=1) / rig.dlo.length
    assert 0.9 < lengths.min() and lengths.max() < 1.1 and frames.dlo[..., 2].min() > -0.01


@pytest.mark.parametrize("action", [[0.061, 0], [0, np.nan], [0.01], [[0.01, 0.01]]])
def test_actions_that_are_none_are_refused(rig, action):
    rig.reset()
    with pytest.raises(ValueError, match=r"action: expected dx, dz of at most 0.06 m, got"):
        rig.step(action)


@pytest.mark.parametrize("velocity", [1e12, np.nan])
def test_a_simulation_that_breaks_down_says_so(rig, tmp_path, monkeypatch, velocity):
    monkeypatch.chdir(tmp_path)  # MuJoCo keeps a log where it is
    before = rig.reset()
    rig._data.qvel[7] = velocity
    with pytest.raises(UnstableError, match="dlo-1"):
        rig.step([0.01, 0.0])
    np.testing.assert_array_equal(rig.reset().dlo, before.dlo)
    rig.step([0.01, 0.0])


# -------------------------------------------------------------------------------------------------- recordings


@pytest.mark.slow
def test_a_recording_is_what_the_rig_does_and_its_images_show(rig):
    """Physics made again now; keypoints found in a few images, as recorded and near the truth."""
    recording = read(objects.FILE.parent / "dlo-1.npz")
    times, frames = rig.rollout(np.asarray(exploratory_actions()))
    np.testing.assert_allclose(recording.times, times, atol=1e-9)
    assert recording.frame_rate == pytest.approx(1 / FRAME_INTERVAL)
    np.testing.assert_allclose(recording.gripper, frames.gripper, atol=1e-4)
    for name, kept in (("length (m)", rig.dlo.length), ("mass (kg)", rig.dlo.mass)):
        assert recording.facts[name] == kept

    some = [0, 70, 110]
    pixels = lambda uv: 256 * np.asarray(uv)
    truth = jax.vmap(lambda line: along(line, jnp.array(EVEN)))(jnp.asarray(frames.dlo[some], jnp.float32))
    spots = jnp.concatenate([project(recording.camera, truth), project(recording.camera, frames.cubes[some])], axis=1)
    assert np.abs(pixels(recording.keypoints[some]) - pixels(spots)).max() < 5
    assert np.ptp(frames.dlo[some, -1, 0]) > 0.1 and recording.seen[some].all()

    find = jax.jit(found)
    for i in some:
        frame = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i], jnp.float32), frames)
        key = jax.random.fold_in(jax.random.key(1), i)
        keypoints, seen = find(key, recording.camera, frame, rig.place.cube_side)
        np.testing.assert_array_equal(seen, recording.seen[i])
        np.testing.assert_allclose(pixels(keypoints), pixels(recording.keypoints[i]), atol=2.0)
    moving = recording.keypoints[:, :ON_DLO]
    assert np.linalg.norm(np.diff(moving, axis=0), axis=-1).max() < 0.08  # no keypoint ever jumps
