"""The planner of whips: what it draws, how it counts, and that it finds what there is to find."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from experiments import whip_plan
from jaxlfi.envs.whip import planner, rules
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.engine import settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.planner import CrossEntropy
from jaxlfi.envs.whip.rig import START


class Terrain:
    """Physics of places: the gripper is where its set-point is, and what it does there depends on the place.

    Nearer than 0.1 m to the stack, in x, it pushes the top cube if it is higher than 0.4 m, and else the blue one.
    Below 0.2 m everything breaks down.
    """

    scene = Scene()

    def advance(self, parameters, state, target):
        near, high = target[0] > 0.5 + parameters.stack[0], target[1] > 0.4
        push = 0.05 * jnp.stack([0.0, 0.0, near & ~high, 0.0, 0.0, near & high])
        rest = initial_positions(self.scene, parameters)
        qpos = rest.at[:2].set(target).at[self.scene.first_cube + 7 * np.arange(6)].add(push)
        return settled(state, qpos, state.qvel, target, target[1] < 0.2)


TERRAIN = Terrain()
METHOD = CrossEntropy(population=16, elites=4, iterations=6, stacks=3, target_return=1.999)


play = jax.jit(functools.partial(planner.play, TERRAIN))
mean_return = jax.jit(functools.partial(planner.mean_return, TERRAIN, stacks=3))
plan = jax.jit(lambda key, parameters: planner.plan(key, TERRAIN, parameters, METHOD))


def actions(*legs):
    """Actions as (times, dx, dz); the rest stands still."""
    moves = [[dx, dz] for times, dx, dz in legs for _ in range(times)]
    return np.float32(moves + [[0.0, 0.0]] * (16 - len(moves)))


# ------------------------------------------------------------------------------------------------------- draws


def test_plans_stay_in_the_workspace_and_within_the_limit():
    wild = 0.2 * jax.random.normal(jax.random.key(0), (50, 16, 2))
    tamed = np.asarray(jax.vmap(planner.inside)(wild), float)
    assert np.abs(tamed).max() <= rules.ACTION_LIMIT + 1e-6
    path = np.asarray(START) + np.cumsum(tamed, axis=1)
    low, high = rules.WORKSPACE[0] + 0.004, rules.WORKSPACE[1] - 0.004
    assert (path > low).all() and (path < high).all()
    assert (path.min((0, 1)) < low + 0.002).all() and (path.max((0, 1)) > high - 0.002).all()
    # What stays inside by itself is left alone, and walls do not hold what moves off them.
    gentle = actions((3, 0.05, -0.02), (3, -0.06, 0.0))
    np.testing.assert_allclose(planner.inside(gentle), gentle, atol=1e-7)
    bounced = np.asarray(planner.inside(actions((5, 0.06, 0.0), (1, -0.06, 0.0))))
    np.testing.assert_allclose(bounced[:6, 0], [0.06, 0.06, 0.06, 0.015, 0.0, -0.06], atol=1e-6)


def test_draws_have_the_mean_deviation_and_correlation_asked_for():
    noise = jax.random.normal(jax.random.key(1), (4000, 16, 2))
    mean, deviation = np.zeros((16, 2)), np.full((16, 2), 1e-3)
    mean[3], deviation[5, 1] = [0.01, -0.01], 2e-3
    drawn = np.asarray(jax.vmap(lambda noise: planner.draw(noise, mean, deviation, 0.6))(noise), float)
    np.testing.assert_allclose(drawn.mean(0), mean, atol=1e-4)
    np.testing.assert_allclose(drawn.std(0) / deviation, 1.0, atol=0.05)
    for lag, expected in ((1, 0.6), (2, 0.36), (5, 0.6**5)):
        together = [np.corrcoef(drawn[:, t, 0], drawn[:, t + lag, 0])[0, 1] for t in range(16 - lag)]
        np.testing.assert_allclose(together, expected, atol=0.06)
    assert abs(np.corrcoef(drawn[:, 4, 0], drawn[:, 4, 1])[0, 1]) < 0.05


# ----------------------------------------------------------------------------------------------------- returns


@pytest.mark.parametrize(
    ("legs", "value", "hit", "steps", "end"),
    [
        ([(1, 0.0, 0.06), (2, 0.06, 0.0)], 2.0, [5], 3, None),
        ([(2, 0.06, 0.0)], -0.2 * 15, [2], 16, None),
        ([(2, 0.06, 0.0), (1, 0.0, 0.06)], -0.2 + 1.8, [2, 5], 3, None),
        ([(2, 0.06, 0.0), (5, -0.06, 0.0)], -0.2 * 5 - 1.0, [2], 7, "outside"),
        ([(2, 0.06, 0.0), (3, 0.0, -0.06)], -0.2 * 3, [2], 5, "failed"),
        ([], 0.0, [], 16, None),
    ],
)
def test_episodes_earn_until_they_end(legs, value, hit, steps, end):
    outcome = play(median(), actions(*legs))
    assert outcome.value == pytest.approx(value, abs=1e-5) and outcome.steps == steps
    np.testing.assert_array_equal(np.flatnonzero(outcome.hit), hit)
    assert bool(outcome.outside) == (end == "outside") and bool(outcome.failed) == (end == "failed")


def test_the_mean_is_over_the_middles_of_equal_parts():
    """The gripper stops 2 cm beyond where the undisplaced stack's cube is pushed."""
    reach = actions((1, 0.0, 0.06), (2, 0.06, 0.0))
    jitters = {0.0: 1.0, 0.029: 1.0, 0.031: 2 / 3, 0.5: 2 / 3}  # the third place is two thirds of the range away
    for jitter, fraction in jitters.items():
        assert mean_return(median(), reach, jitter=jitter) == pytest.approx(2 * fraction)
    aside = median().replace(stack=jnp.array([0.01, 0.0]))
    assert mean_return(aside, reach, jitter=0.016) == pytest.approx(2 * 2 / 3)


# ------------------------------------------------------------------------------------------------------ search


def test_one_iteration_against_numpy():
    search = planner.init(METHOD)
    search = search.replace(mean=search.mean.at[:2].set(0.05), value=jnp.asarray(1.0), actions=search.mean + 0.01)
    key = jax.random.key(5)
    after, values = jax.jit(lambda key, search: planner.step(key, TERRAIN, median(), search, METHOD))(key, search)
    noise = jax.random.normal(jax.random.key(5), (16, 16, 2))
    tried = jax.vmap(lambda noise: planner.draw(noise, search.mean, search.deviation, METHOD.correlation))(noise)
    tried, values = np.asarray(tried), np.asarray(values)
    returns = [mean_return(median(), one, jitter=METHOD.jitter) for one in tried]
    np.testing.assert_allclose(values, returns, atol=1e-5)
    assert len({*np.round(values, 3)}) > 4
    order = np.argsort(-np.append(1.0, values), kind="stable")[:4]
    elites = np.concatenate([np.asarray(search.actions)[None], tried])[order]
    np.testing.assert_allclose(after.mean, 0.2 * search.mean + 0.8 * elites.mean(0), atol=1e-6)
    deviation = 0.2 * search.deviation + 0.8 * elites.std(0)
    np.testing.assert_allclose(after.deviation, np.maximum(deviation, 0.004), atol=1e-6)
    np.testing.assert_array_equal(after.actions, elites[0])
    assert after.value == max(1.0, values.max())


def test_a_search_ends_once_it_is_good_enough():
    found = plan(jax.random.key(0), median())
    history = np.asarray(found.history)
    used = np.isfinite(history).all(axis=1)
    assert found.value == 2.0 == np.nanmax(history) and history.shape == (6, 16)
    assert used.any() and not used.all() and np.isnan(history[~used]).all()
    assert (np.diff(used.astype(int)) <= 0).all() and (np.nanmax(history[used], axis=1)[:-1] < 2.0).all()
    assert mean_return(median(), found.actions, jitter=METHOD.jitter) == 2.0


def test_scenes_are_planned_for_side_by_side():
    """The second stack is out of reach: its search goes on to the end."""
    scenes = median(length=np.array([0.2, 0.3])).replace(stack=jnp.array([[0.0, 0.0], [0.2, 0.0]]))
    keys = [jax.random.key(0), jax.random.key(1)]
    with jax.debug_key_reuse(False):  # which takes a batched loop over keys for a reuse
        both = jax.vmap(plan)(jnp.stack(keys), scenes)
        for i in range(2):
            alone = plan(keys[i], jax.tree.map(lambda leaf, i=i: leaf[i], scenes))
            jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-5), both, alone)
    assert both.value[0] == 2.0 and both.value[1] == 0.0 and np.isfinite(both.history[1]).all()


# -------------------------------------------------------------------------------------------------- experiment


def test_the_map_counts_rollouts_until_the_first_good_plan(monkeypatch):
    history = np.full((3, 4), np.nan)
    history[:2] = [[0.0, 1.0, 1.9, 0.0], [1.0, 1.95, 2.0, 0.0]]
    none = planner.Plan(np.zeros((16, 2)), np.float32(1.9), np.where(history < 1.95, history, np.nan))
    outcome = planner.Outcome(2.0, np.arange(6) == 5, False, False, 3)
    monkeypatch.setattr(whip_plan, "_judge", lambda *arguments: (1.5, outcome))
    monkeypatch.setattr(whip_plan, "_plan", lambda *arguments: none.replace(history=history))
    one = whip_plan.search(0.2, 1e4, METHOD, TERRAIN)
    assert one["first"] == 3 * 6 and one["rollouts"] == 3 * 8 and one["elsewhere"] == 1.5
    monkeypatch.setattr(whip_plan, "_plan", lambda *arguments: none)
    assert np.isnan(whip_plan.search(0.2, 1e4, METHOD, TERRAIN)["first"])


def test_the_map_is_written(monkeypatch, tmp_path, capsys):
    def search(length, young, method, engine):
        easy = length > 0.2
        numbers = {"value": 1.6 + easy * 0.4, "elsewhere": 1.5, "first": 12.0 if easy else np.nan}
        return {
            **numbers,
            "hit": np.arange(6) >= 5 - easy,
            "actions": np.zeros((16, 2)),
            "rollouts": 48,
            "seconds": 1.0,
        }

    monkeypatch.setattr(whip_plan, "search", search)
    whip_plan.main(["--quick", "--out", str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == {"map.csv", "map.json", "map.png", "plans.npz"}
    lines = (tmp_path / "map.csv").read_text().splitlines()
    assert len(lines) == 10 and lines[1] == "1000,0.12,1.6,1.5,nan,48,1,0,0,0,0,0,1"
    assert lines[2] == "1000,0.25,2,1.5,12,48,1,0,0,0,0,1,1"
    with np.load(tmp_path / "plans.npz") as arrays:
        assert arrays["actions"].shape == (3, 3, 16, 2)
    assert "120 mm 1.60, 250 mm 2.00" in capsys.readouterr().out
