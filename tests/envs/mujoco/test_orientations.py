"""Orientations as rotations, against SciPy's."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

mujoco = pytest.importorskip("mujoco")

import jax.numpy as jnp

from jaxlfi.envs.mujoco.logs import Log, RecordingWarning
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.orientations import aligned, angle, continuous
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

RANDOM = np.random.default_rng(0)


def test_the_angle_between_two_orientations():
    one, other = RANDOM.normal(size=(2, 50, 4))
    roll = lambda quaternions: Rotation.from_quat(np.roll(quaternions, -1, axis=1))
    expected = (roll(one).inv() * roll(other)).magnitude()
    np.testing.assert_allclose([angle(a, b) for a, b in zip(one, other, strict=True)], expected, atol=1e-6)
    np.testing.assert_allclose([angle(a, -2 * a) for a in one], 0, atol=1e-6)


def test_simulations_have_the_sign_of_the_recording_and_norm_1():
    """In NumPy and in JAX; what is no orientation stays as it is."""
    rows, recorded = RANDOM.normal(size=(3, 20, 6)), RANDOM.normal(size=(20, 6))
    rows[1, 4, 1:5] = 0.0
    found = aligned(rows, recorded, [(1, 2, 3, 4)])
    np.testing.assert_array_equal(found[..., [0, 5]], rows[..., [0, 5]])
    for own, given in zip(found[..., 1:5].reshape(-1, 4), rows[..., 1:5].reshape(-1, 4), strict=True):
        np.testing.assert_allclose(own * np.linalg.norm(given), given * np.sign(own @ given), atol=1e-12)
    assert (np.sum(found[..., 1:5] * recorded[:, 1:5], axis=-1) >= 0).all()
    np.testing.assert_allclose(aligned(jnp.asarray(rows), recorded, [(1, 2, 3, 4)]), found, atol=1e-5)
    assert aligned(rows, recorded, []) is rows


def test_changes_of_sign_and_missing_samples():
    turns = np.roll(Rotation.from_rotvec(np.outer(np.linspace(0, 9, 60), [0.3, -0.5, 0.8])).as_quat(), 1, axis=1)
    for k in range(1, 60):
        turns[k] *= np.sign(turns[k] @ turns[k - 1])
    changed = turns * RANDOM.choice([-1.3, 0.7], size=(60, 1))
    changed[[5, 6]], changed[20, 2], changed[30] = np.nan, np.nan, 0.0
    found = continuous(changed, -turns[0])
    missing = np.isin(np.arange(60), [5, 6, 20, 30])
    assert np.isnan(found[missing]).all()
    np.testing.assert_allclose(found[~missing], -turns[~missing], atol=1e-12)


BOX = """
<mujoco><option timestep="0.002" density="1.2"/><worldbody>
  <body name="box" pos="0 0 1" quat="0.9 0.3 -0.2 0.1">
    <freejoint name="box"/><geom type="box" size="0.1 0.06 0.04" mass="0.5"/>
  </body>
</worldbody></mujoco>
"""
PUSHED = {f"box/qvel[{i}]": speed for i, speed in enumerate([1.0, 0.3, 1.0, 3.0, 2.0, 5.0])}
NAMES = [f"body/box/quat[{i}]" for i in range(4)]


def thrown(count=100):
    """Times, places and orientations of a box that turns by several turns."""
    model = mujoco.MjModel.from_xml_string(BOX)
    data, poses = mujoco.MjData(model), []
    data.qvel[:] = list(PUSHED.values())
    for _ in range(count):
        mujoco.mj_forward(model, data)
        poses.append(data.qpos.copy())
        for _ in range(5):
            mujoco.mj_step(model, data)
    return 0.01 * np.arange(count), np.array(poses)


TIMES, POSES = thrown()


def compared(turns, **others):
    """The simulator of a recording of these orientations, and its simulation by the model that made them."""
    noises = dict.fromkeys(NAMES, 0.002)
    recorded = Log(TIMES, dict(zip(NAMES, turns.T, strict=True)), "box.csv")
    mass = Parameter("body/box/mass", (0.2, 1.5))
    own = simulator_of(mujoco_task(BOX, [mass], recorded, noises=noises, initial=PUSHED, **others))
    return own, own.clean([[0.5]])[0][0]


@pytest.mark.parametrize("change", ["none", "flipped", "canonical", "mixed"])
def test_the_sign_of_a_recorded_orientation_makes_no_difference(change):
    turns = POSES[:, 3:].copy()
    signs = {
        "none": np.ones(100),
        "flipped": np.where(np.arange(100) < 60, 1, -1),
        "canonical": np.sign(turns[:, 0]),
        "mixed": np.random.default_rng(0).choice([-1, 1], 100),
    }[change]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own, simulated = compared(turns * signs[:, None])
    np.testing.assert_allclose(own.observation, turns, atol=1e-6)
    np.testing.assert_allclose(simulated, turns, atol=1e-6)
    noisy, _ = own(np.random.default_rng(0), np.array([[0.5], [1.4]]))
    np.testing.assert_allclose(np.linalg.norm(noisy, axis=-1), 1, atol=1e-12)


def test_another_norm_another_order_and_lost_samples_are_said():
    turns = POSES[:, 3:]
    with pytest.warns(
        RecordingWarning, match=r"body/box/quat: orientations have norms of 1\.3 to 1\.3: normalised to 1"
    ):
        np.testing.assert_allclose(compared(1.3 * turns)[0].observation, turns, atol=1e-6)
    with pytest.warns(RecordingWarning, match="body/box/quat: recorded as x, y, z, w: as w, x, y, z it would begin"):
        np.testing.assert_allclose(compared(np.roll(-turns, -1, axis=1))[0].observation, turns, atol=1e-6)
    lost = np.where(np.isin(np.arange(100), [40, 41])[:, None], 0.0, turns)
    with pytest.warns(RecordingWarning, match="2 of 100 orientations are 0: treated as missing"):
        np.testing.assert_allclose(compared(lost)[0].observation, np.delete(turns, [40, 41], axis=0), atol=1e-6)
    with pytest.warns(RecordingWarning, match=r"quat: the recording begins 0\.5 rad from the orientation of the model"):
        turned = Rotation.from_rotvec([0.0, 0.5, 0.0]) * Rotation.from_quat(np.roll(turns, -1, axis=1))
        compared(np.roll(turned.as_quat(), 1, axis=1))
    with pytest.warns(RecordingWarning, match="quat: 1 of 4 numbers are measured: they are not compared as a rotation"):
        mass, name = Parameter("body/box/mass", (0.2, 1.5)), NAMES[0]
        mujoco_task(BOX, [mass], Log(TIMES, {name: turns[:, 0]}), noises={name: 0.1}, initial=PUSHED)
