"""The whipping task: its rules against a plain reading of section VI, and its episodes on scripted and real physics."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip import trajectory as rollout
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.observer import OBSERVATION
from jaxlfi.envs.whip.parameters import median, randomised
from jaxlfi.envs.whip.physics.engine import settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.keypoints import CLEAN, DETECTORS
from jaxlfi.tasks.summaries import cross_correlation


class Puppet:
    """Physics by a script: the gripper is where its set-point is; where that is far enough, cubes are pushed along x.

    The script travels in the velocities, of which there is no other use: six displacements in m, the x beyond which
    they are in force, and the x beyond which the simulation breaks down.
    """

    scene = Scene()

    def advance(self, parameters, state, target):
        push, beyond, breaks = state.qvel[:6], state.qvel[6], state.qvel[7]
        cubes = self.scene.first_cube + 7 * np.arange(6)
        rest = initial_positions(self.scene, parameters)
        qpos = rest.at[:2].set(target).at[cubes].add(jnp.where(target[0] > beyond, push, 0.0))
        return settled(state, qpos, state.qvel, target, target[0] > breaks)


PUPPET, ENGINE = Puppet(), NativeEngine(threads=1)
MEDIAN = median(length=0.23, young=8e3)


@functools.partial(jax.jit, static_argnums=0)
def run(engine, detector, key, parameters, script, actions):
    """The observations [T + 1] and the steps of an episode, stacked."""
    whip = Whip(engine, detector)
    first, observation = whip.reset(jax.random.fold_in(key, 0), parameters)
    state = first.state.replace(qvel=first.state.qvel.at[: script.size].add(script))

    def step(episode, at):
        return whip.step(jax.random.fold_in(key, at[0]), parameters, episode, at[1])

    _, steps = jax.lax.scan(step, first.replace(state=state), (jnp.arange(len(actions)) + 1, actions))
    return jnp.concatenate([observation[None], steps.observation]), steps


def act(actions, *cubes, metres=0.05, beyond=0.5, breaks=9.0, parameters=MEDIAN):
    """An episode with the puppet, which pushes these cubes; for as long as there are actions, at most 16 steps."""
    script = np.float32([*(metres * np.isin(np.arange(6), cubes)), beyond, breaks])
    padded = np.zeros((16, 2), np.float32)
    padded[: len(actions)] = actions
    observations, steps = run(PUPPET, CLEAN, jax.random.key(0), parameters, script, padded)
    return np.asarray(observations)[: len(actions) + 1], jax.tree.map(
        lambda leaf: np.asarray(leaf)[: len(actions)], steps
    )


STILL = np.zeros((16, 2), np.float32)
FORWARD = np.tile(np.float32([0.03, 0.0]), (16, 1))
"""Beyond x = 0.5 with the fourth action, out of the workspace with the seventh."""
WHIP = np.array([[-0.06, 0.0]] * 2 + [[0.06, 0.0]] * 4 + [[0.0, 0.0]] * 10, np.float32)
"""Back and forth: a DLO of 0.3 m and 5 kPa hits the three upper cubes with the eighth."""


# ------------------------------------------------------------------------------------------------------- rules


def reward_as_written(hit):
    """Section VI-G, line by line."""
    reward = 0.0
    if hit[5]:
        reward = 2.0
    for i in (4, 3, 2, 1, 0):
        if hit[i]:
            reward -= 0.05 * 2 ** (4 - i)
    return reward


def test_rewards_of_all_hit_patterns():
    patterns = np.array(list(itertools.product([False, True], repeat=6)))
    expected = np.array([reward_as_written(pattern) for pattern in patterns])
    assert len({*np.round(expected, 6)}) > 32 and expected.max() == 2.0 and expected.min() == pytest.approx(-1.55)
    np.testing.assert_allclose(rules.reward(patterns, np.zeros(64, bool)), expected, atol=1e-6)
    np.testing.assert_array_equal(rules.reward(patterns, np.ones(64, bool)), -1.0)


def test_the_lower_the_cube_the_dearer():
    """Red, green, blue, orange and purple, bottom-up, as the paper lists them."""
    alone = [float(rules.reward(np.arange(6) == cube, np.asarray(False))) for cube in range(6)]
    assert alone == pytest.approx([-0.8, -0.4, -0.2, -0.1, -0.05, 2.0])


@pytest.mark.parametrize(("axis", "low", "high"), [(0, 0.275, 0.6), (1, 0.1, 0.5)])
def test_the_workspace_ends_at_each_side(axis, low, high):
    at = lambda value: np.where(np.arange(2) == axis, np.float32(value), np.float32(0.3))
    assert not rules.outside(at(low)) and not rules.outside(at(high))
    assert rules.outside(at(low - 1e-5)) and rules.outside(at(high + 1e-5))
    np.testing.assert_array_equal(rules.outside(np.stack([at(low), at(high + 0.1)])), [False, True])


def test_a_hit_is_further_than_six_hundredths_and_stays():
    start = np.random.default_rng(0).uniform(0.2, 0.8, (6, 2)).astype(np.float32)
    directions = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0.6, 0.8], [-0.8, 0.6]], np.float32)
    none = np.zeros(6, bool)
    moved = lambda distance: rules.hits(none, start, start + np.float32(distance) * directions)
    assert not moved(0.0599).any() and moved(0.0601).all()
    assert not rules.hits(none, 0 * start, np.float32(0.06) * np.eye(6, 2, dtype=np.float32)).any()
    before = np.array([True, False, False, True, False, False])
    np.testing.assert_array_equal(rules.hits(before, start, start), before)


def test_actions_are_clipped_each_axis_by_itself():
    target = np.array([0.4, 0.36], np.float32)
    np.testing.assert_allclose(rules.moved_target(target, np.array([0.3, -0.01])), [0.46, 0.35], rtol=1e-6)
    np.testing.assert_allclose(rules.moved_target(target, np.array([0.02, -7.0])), [0.42, 0.30], rtol=1e-6)


# ------------------------------------------------------------------------------------- episodes by the script


def test_the_layout_of_an_observation():
    """Gripper, four DLO and six cube keypoints, six flags, of what the scene's own camera sees."""
    parameters = randomised(jax.random.key(3), 0.21, 4e3)
    assert np.abs(parameters.camera).min() > 1e-3
    observations, steps = act(FORWARD[:4], 1, 4, parameters=parameters)
    assert observations.shape == (5, OBSERVATION) and observations.dtype == np.float32
    np.testing.assert_allclose(observations[:, 0], 0.4 + 0.03 * np.arange(5), rtol=1e-6)
    np.testing.assert_allclose(observations[:, 1], 0.36, rtol=1e-6)
    last = observations[-1, 2:22].reshape(10, 2)
    camera = side_camera(parameters)
    hanging = np.array([[0.52, 0.0, 0.36 - part * 0.21] for part in (0.25, 0.5, 0.75, 1.0)], np.float32)
    np.testing.assert_allclose(last[:4], project(camera, hanging), atol=1e-5)
    x, y = parameters.stack
    shifts = 0.05 * np.isin(np.arange(6), [1, 4])
    cubes = [[0.6 + x + shifts[i], y, (i + 0.5) * parameters.cube_side] for i in range(6)]
    np.testing.assert_allclose(last[4:], project(camera, jnp.array(cubes)), atol=1e-3)  # they sink into each other
    np.testing.assert_array_equal(observations[-1, 22:], [0, 1, 0, 0, 1, 0])
    np.testing.assert_array_equal(observations[-2, 22:], 0)
    np.testing.assert_array_equal(steps.hit[-1], [0, 1, 0, 0, 1, 0])
    assert steps.seen.all()


def test_sixteen_steps_truncate():
    _, steps = act(STILL)
    np.testing.assert_array_equal(steps.truncated, np.arange(1, 17) == 16)
    assert not steps.terminated.any() and not steps.reward.any() and not steps.failed.any()


@pytest.mark.parametrize(
    ("action", "steps_inside"),
    [((0.06, 0.0), 3), ((-0.06, 0.0), 2), ((0.0, 0.06), 2), ((0.0, -0.06), 4)],
)
def test_leaving_the_workspace_terminates_with_minus_one(action, steps_inside):
    """From (0.40, 0.36) to 0.6, 0.275, 0.5 and 0.1."""
    _, steps = act(np.tile(action, (5, 1)))
    np.testing.assert_array_equal(steps.outside, np.arange(5) >= steps_inside)
    np.testing.assert_array_equal(steps.terminated, steps.outside)
    np.testing.assert_array_equal(steps.reward, np.where(steps.outside, -1.0, 0.0))


def test_hitting_the_top_cube_terminates():
    _, steps = act(FORWARD[:5], 5)
    np.testing.assert_array_equal(steps.terminated, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(steps.reward, [0, 0, 0, 2, 2])
    assert not steps.truncated.any()


def test_leaving_with_a_hit_is_still_a_failure():
    _, steps = act(FORWARD[:7], 5, beyond=0.6)
    assert steps.hit[-1, 5] and steps.outside[-1] and steps.terminated[-1] and steps.reward[-1] == -1.0


def test_penalties_repeat_although_cubes_go_back():
    """Purple and blue are pushed once, by an action forward, and stand as before after one back."""
    actions = np.concatenate([FORWARD[:4], -FORWARD[:2], STILL[:2]])
    _, steps = act(actions, 4, 2)
    np.testing.assert_allclose(steps.reward, [0, 0, 0, -0.25, -0.25, -0.25, -0.25, -0.25], atol=1e-6)
    assert not steps.terminated.any()


def test_a_push_of_less_than_the_threshold_is_no_hit():
    """0.06 of an image that is 0.6 m across."""
    assert not act(FORWARD[:5], 5, metres=0.0355)[1].hit.any()
    assert act(FORWARD[:5], 5, metres=0.0365)[1].hit[-1, 5]


def test_actions_beyond_the_limit_do_no_more_than_it():
    far, _ = act([[5.0, -0.08], [-1e9, np.inf]])
    near, _ = act([[0.06, -0.06], [-0.06, 0.06]])
    np.testing.assert_array_equal(far, near)


def test_unstable_physics_truncates_without_reward():
    """However many cubes were hit before, and wherever the gripper was last."""
    observations, steps = act(FORWARD[:7], 0, 5, breaks=0.53)
    np.testing.assert_array_equal(steps.failed, np.arange(7) >= 4)
    np.testing.assert_array_equal(steps.truncated, steps.failed)
    np.testing.assert_array_equal(steps.terminated, [0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(steps.reward, [0, 0, 0, 1.2, 0, 0, 0], rtol=1e-6)
    np.testing.assert_array_equal(observations[5:], np.stack([observations[4]] * 3))  # the last that was finite


# ------------------------------------------------------------------------------------------------- real physics

NO_SCRIPT = np.zeros(0, np.float32)
reset = jax.jit(Whip(ENGINE, DETECTORS["transporter"]).reset)


def test_eager_is_jitted_and_the_second_call_compiles_nothing():
    whip, traced = Whip(ENGINE, DETECTORS["transporter"]), []

    def step(key, episode, action):
        traced.append(action)
        return whip.step(key, MEDIAN, episode, action)

    episode, _ = reset(jax.random.key(0), MEDIAN)
    compiled = jax.jit(step)
    for seed in (1, 2):
        eager, jitted = (made(jax.random.key(seed), episode, WHIP[0]) for made in (step, compiled))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), eager, jitted)
        episode = eager[0]
    assert len(traced) == 3


@pytest.mark.slow
def test_a_batch_is_a_loop():
    """Scenes, keys and actions of their own; cubes have been hit by then."""
    key = jax.random.key(1)  # in most scenes the whip misses
    keys = [jax.random.fold_in(key, i) for i in range(3)]
    scenes = [
        randomised(jax.random.fold_in(key, 3 + i), *theta)
        for i, theta in enumerate([(0.2, 5e2), (0.3, 5e3), (0.35, 4e5)])
    ]
    actions = np.stack([np.roll(WHIP, 1, axis=0), WHIP, -0.3 * WHIP])
    with jax.debug_key_reuse(False):  # which takes a vmapped scan over keys for a reuse
        own = functools.partial(run, ENGINE, DETECTORS["transporter"])
        batched = jax.vmap(own, in_axes=(0, 0, None, 0))
        stack = lambda *leaves: jnp.stack(leaves)
        together = batched(jnp.stack(keys), jax.tree.map(stack, *scenes), NO_SCRIPT, actions)
        for i in range(3):
            alone = own(keys[i], scenes[i], NO_SCRIPT, actions[i])
            # Until cubes have fallen; from then on rounding grows.
            close = lambda a, b, i=i: np.testing.assert_allclose(a[i, :9], b[:9], atol=2e-5)
            jax.tree.map(close, together, alone)
    assert together[1].hit[1, 8].any()


def test_an_episode_survives_flattening():
    episode, _ = reset(jax.random.key(0), MEDIAN)
    leaves, structure = jax.tree.flatten(episode)
    again = jax.tree.unflatten(structure, [np.asarray(leaf) for leaf in leaves])
    assert jax.tree.structure(again) == structure and all(hasattr(leaf, "shape") for leaf in leaves)
    jax.tree.map(np.testing.assert_array_equal, episode, again)


@functools.partial(jax.jit, static_argnums=0)
def trajectory(engine, camera, parameters, actions):
    return rollout.trajectory(jax.random.key(0), engine, CLEAN, camera, parameters, actions)


@pytest.mark.slow
def test_a_trajectory_is_the_states_before_each_action():
    """The trajectory is that of an episode with the same actions, whose cubes fall."""
    parameters = median(length=0.3, young=5e3)
    observations, steps = run(ENGINE, CLEAN, jax.random.key(1), parameters, NO_SCRIPT, WHIP)
    made, valid = trajectory(ENGINE, side_camera(parameters), parameters, WHIP)
    assert valid and made.shape == (16, 30)
    np.testing.assert_array_equal(made[:, 28:], WHIP)
    hit = np.asarray(made[:, 22:28]).astype(bool)
    np.testing.assert_array_equal(hit[:8], False)
    np.testing.assert_array_equal(hit[8], [0, 0, 0, 1, 1, 1])
    # Until something falls; from then on rounding grows.
    np.testing.assert_allclose(made[:8, :22], observations[:8, :22], atol=1e-4)
    np.testing.assert_array_equal(hit[:9], np.concatenate([np.zeros((1, 6), bool), steps.hit[:8]]))
    cubes = np.asarray(made[:, 10:22]).reshape(16, 6, 2)
    away = np.linalg.norm(cubes - cubes[0], axis=-1) > 0.06
    np.testing.assert_array_equal(hit, np.logical_or.accumulate(away, axis=0))
    summary = cross_correlation(made, actions=2)
    assert summary.shape == (112,) and np.isfinite(summary).all()


def test_trajectories_are_seen_through_the_camera_that_is_given():
    moved = side_camera(MEDIAN.replace(camera=jnp.array([0.02, 0.0, -0.01])))
    own, other = (trajectory(ENGINE, camera, MEDIAN, STILL)[0] for camera in (side_camera(MEDIAN), moved))
    np.testing.assert_array_equal(own[:, :2], other[:, :2])
    shift = np.asarray(other - own)[:, 2:22].reshape(16, 10, 2)
    np.testing.assert_allclose(shift, np.broadcast_to([-0.02 / 0.6, -0.01 / 0.6], shift.shape), atol=1e-4)


class Fragile(Puppet):
    """Breaks down beyond x = 0.5."""

    def advance(self, parameters, state, target):
        return settled(state, state.qpos, state.qvel, target, target[0] > 0.5)


def test_a_trajectory_that_breaks_down_is_not_valid():
    """The last action has its effect after the last state."""
    fragile, steps = Fragile(), np.arange(16)[:, None]
    late = np.where(steps == 3, [[0.06, 0.0]], np.where(steps == 15, [[0.06, 0.0]], 0.0)).astype(np.float32)
    valid = [trajectory(fragile, side_camera(MEDIAN), MEDIAN, actions)[1] for actions in (FORWARD, STILL, late)]
    np.testing.assert_array_equal(valid, [False, True, True])
