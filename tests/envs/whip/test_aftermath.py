"""What an episode leaves behind: the retreat, which cubes count, and cubes that fall after the episode has ended."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import planner, rules
from jaxlfi.envs.whip.aftermath import RETRACTING, WAITING, Aftermath, displaced, retreat, sentence
from jaxlfi.envs.whip.environment import make
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.rig import START
from jaxlfi.envs.whip.settling import REST, aftermath, asleep
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.evaluation import evaluate

ORANGE = 3


class Landslide:
    """Physics of places: beyond x = 0.5 m the gripper pushes the top cube; three intervals later the orange one falls.

    Below z = 0.15 m everything breaks down.
    """

    scene = Scene()

    def advance(self, parameters, state, target):
        since = state.qvel[0] + ((target[0] > 0.5) | (state.qvel[0] > 0))  # intervals since the push
        out = jnp.zeros(6).at[rules.TOP].set(since > 0).at[ORANGE].set(since > 3) * 0.05
        qpos = initial_positions(self.scene, parameters).at[:2].set(target)
        qpos = qpos.at[self.scene.first_cube + 7 * np.arange(6)].add(out)
        return settled(state, qpos, state.qvel.at[0].set(since), target, target[1] < 0.15)


@pytest.mark.parametrize("corner", [(x, z) for x in rules.WORKSPACE[:, 0] for z in rules.WORKSPACE[:, 1]])
def test_the_gripper_goes_back_to_its_start_within_its_limits(corner):
    moves = retreat(np.array(corner), np)
    assert moves.shape == (RETRACTING + WAITING, 2) and np.abs(moves).max() <= rules.ACTION_LIMIT
    np.testing.assert_allclose(corner + moves.sum(axis=0), START, atol=1e-6)
    assert not moves[RETRACTING:].any()
    np.testing.assert_allclose(retreat(jnp.array(corner)), moves, atol=1e-6)


def test_cubes_count_beyond_half_a_side_in_any_direction():
    moves = 0.025 * np.array([[0, 0, 0], [0.49, 0, 0], [0, 0.51, 0], [0, 0, -0.6], [0.3, 0.3, 0.3], [0.2, 0.2, 0.2]])
    assert displaced(np.zeros((6, 3)), moves, 0.025).tolist() == [False, False, True, True, True, False]


def test_cubes_that_fall_after_the_end_are_counted():
    engine, parameters = Landslide(), median()
    towards = jnp.tile(jnp.array([0.05, 0.0]), (16, 1))
    outcome = planner.play(engine, parameters, towards)
    assert outcome.hit.tolist() == [False] * 5 + [True] and float(outcome.value) == 2.0  # "clean", when it ended
    left = planner.left(engine, parameters, towards)
    assert np.flatnonzero(left.displaced).tolist() == [ORANGE, rules.TOP]
    assert bool(left.hit) and not bool(left.clean) and not bool(left.failed)
    still = planner.left(engine, parameters, jnp.zeros((16, 2)))
    assert not still.displaced.any() and not bool(still.hit)
    broken = planner.left(engine, parameters, jnp.tile(jnp.array([0.0, -0.06]), (16, 1)))
    assert bool(broken.failed) and not bool(broken.hit)


def test_it_is_said_in_words():
    said = lambda *out, failed=False: sentence(Aftermath(np.isin(np.arange(6), out), np.array(failed)))
    assert said() == "once settled: every cube in its place"
    assert said(rules.TOP) == "once settled: yellow out of place, and no other"
    assert said(0, 4, rules.TOP) == "once settled: red, purple and yellow out of place"
    assert said(0) == "once settled: red out of place"
    assert said(rules.TOP, failed=True) == "once settled: unstable"


@pytest.mark.slow
def test_evaluations_count_what_the_physics_leave_behind():
    """A gripper driven into the stack, and one that stays where it is, by MuJoCo."""
    whip = make(detector="clean", engine="native")
    policy = lambda seen: jnp.where(seen[0] > 0.45, jnp.array([0.06, 0.0]), jnp.zeros(2))
    into = lambda seen: jnp.array([0.06, -0.03])
    domain = Domain(jnp.array([[200.0, 1e5]]))
    both = jax.jit(lambda keys: [evaluate(k, whip, act, domain) for k, act in zip(keys, (policy, into), strict=True)])
    found = jax.device_get(both(list(jax.random.split(jax.random.key(0)))))
    assert found[0].facts["displaced"].tolist() == [0] and not found[0].facts["settled_hit"][0]
    assert found[1].facts["displaced"][0] >= 2 and not found[1].facts["settled_clean"][0]
    state = physics.reset(whip.whip.engine.scene, median())
    assert not aftermath(whip.whip.engine, median(), state).displaced.any()


def test_cubes_that_have_come_to_rest_are_asleep():
    """All of them, or none: one that moves may be what holds others up."""
    state = physics.reset(Scene(), median())
    slow = state.replace(qvel=state.qvel.at[-6:].set(0.9 * REST).at[0].set(0.2))
    left = asleep(slow).qvel
    assert not np.any(left[-36:]) and left[0] == pytest.approx(0.2)  # the gripper moves on
    fast = slow.replace(qvel=slow.qvel.at[-12].set(-1.1 * REST))
    np.testing.assert_array_equal(asleep(fast).qvel, fast.qvel)
    spinning = slow.replace(qvel=slow.qvel.at[-1].set(0.1))
    np.testing.assert_array_equal(asleep(spinning).qvel, spinning.qvel)
