"""The whipping task as policies are trained on it: units, scaling, keys, rewards."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.environment import make
from jaxlfi.envs.whip.parameters import HIGHEST, LOWEST
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.registry import ENVIRONMENTS
from jaxlfi.rl.environment import Environment

THETA = jnp.array([[200.0, 1e5], [300.0, 2e3]])
KEYS = jax.random.split(jax.random.key(0), 2)


@pytest.fixture(scope="module")
def whip():
    return make(detector="clean", engine="native")


@pytest.fixture(scope="module")
def started(whip):
    return jax.jit(jax.vmap(whip.reset))(KEYS, THETA)


def test_it_is_found_by_name(whip):
    found = ENVIRONMENTS.load("whip,detector=clean,engine=native")
    assert found == whip and isinstance(found, Environment)
    assert "whip" in ENVIRONMENTS.names()
    for reference, expected in (
        ("whip,detector=eye", "detector: expected one of clean"),
        ("whip,colour=red", "environment: expected options among detector, engine"),
        ("nothing", "environment: expected one of"),
        ("math:pi", "environment: expected 'math:pi' to give a jaxlfi.rl.environment.Environment, got float"),
    ):
        with pytest.raises(ValueError, match=expected):
            ENVIRONMENTS.load(reference)


def test_boxes_are_the_papers_in_mm_and_pa(whip):
    np.testing.assert_allclose(whip.supports["initial"].low, [195, 1e3])
    np.testing.assert_allclose(whip.supports["initial"].high, [305, 5e4])
    np.testing.assert_allclose([whip.feasible.low, whip.feasible.high], [[50, 500], [350, 5e5]])
    np.testing.assert_allclose(whip.nominal, [250, 2.5e4])


def test_its_policies_will_say_what_a_robot_must_keep_to(whip):
    """Limits of the set-point: 6 cm in 0.16 s along each axis, within the workspace."""
    facts = whip.deployment
    assert (facts.control_interval, facts.steps, facts.moved) == (0.16, 16, ("gripper x", "gripper z"))
    assert facts.limits.step == (0.06, 0.06) and facts.limits.speed == pytest.approx(0.06 * 2**0.5 / 0.16)
    assert (facts.limits.low, facts.limits.high) == ((0.275, 0.1), (0.6, 0.5))
    assert facts.detector["name"] == "clean" and facts.detector["spacing"] == 0.25
    assert make(detector="mask", engine="native").deployment.detector["name"] == "mask"


@pytest.mark.parametrize("name", DETECTORS)
def test_what_they_say_of_any_detector_can_be_written_as_json(name):
    said = json.loads(json.dumps(make(detector=name, engine="native").deployment.detector))
    assert said.pop("name") == name
    places = said.pop("places")
    known = DETECTORS[name]
    assert places == (None if known.places is None else pytest.approx(known.places))
    assert said == {key: pytest.approx(getattr(known, key)) for key in said} and len(said) == 11


def test_an_episode_begins_in_a_scene_of_theta_with_nuisances_of_its_own(whip, started):
    scene = started.inner.parameters
    np.testing.assert_allclose(scene.length, [0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(scene.young, [1e5, 2e3], rtol=1e-6)
    for name in ("density", "cube_side", "stack", "camera"):
        value = np.asarray(getattr(scene, name))
        assert (value[0] != value[1]).all()
        assert (value >= np.float32(getattr(LOWEST, name)) - 1e-7).all()
        assert (value <= np.float32(getattr(HIGHEST, name)) + 1e-7).all()


def test_observations_are_scaled_to_about_one(whip, started):
    assert whip.observations.size == 28 and whip.actions.size == 2
    scaled = np.asarray(whip.observations.to_unit(started.observation))
    assert np.abs(scaled).max() < 2.5
    corners = np.float32(rules.WORKSPACE)
    at_corners = np.concatenate([corners, np.full((2, 26), 0.5, np.float32)], axis=1)
    np.testing.assert_allclose(np.abs(whip.observations.to_unit(at_corners)[:, 0]), 1.625, rtol=1e-5)
    np.testing.assert_allclose(whip.observations.from_unit(scaled), started.observation, atol=1e-6)
    np.testing.assert_allclose(whip.actions.from_unit(jnp.array([1.0, -1.0])), [0.06, -0.06])


def test_leaving_the_workspace_ends_the_episode(whip, started):
    step = jax.jit(jax.vmap(whip.step))
    state, rewards = started, []
    for _ in range(6):
        state = step(state, jnp.tile(jnp.array([-0.06, 0.06]), (2, 1)))
        rewards.append(np.asarray(state.reward))
        if state.terminated.all():
            break
    assert state.terminated.all() and state.facts["outside"].all() and not state.truncated.any()
    np.testing.assert_array_equal(rewards[-1], -1)
    assert not state.facts["hit"].any()


def test_keys_of_steps_differ(started, whip):
    with jax.debug_key_reuse(False):
        after = jax.jit(jax.vmap(whip.step))(started, jnp.zeros((2, 2)))
    before = jax.random.key_data(started.inner.key)
    assert (np.asarray(jax.random.key_data(after.inner.key)) != np.asarray(before)).any(axis=1).all()
