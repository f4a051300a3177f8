"""What the whipping task rewards, on scenes made by hand: by order, and once the scene has settled."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import rewards, rules
from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.engine import settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.registry import ENVIRONMENTS

RED, GREEN, BLUE, ORANGE, PURPLE, YELLOW = range(6)
MODULE, BEFORE = "jaxlfi.envs.whip.environment", ("dx 5 before", "dz 5 before")


def scene(*cubes: int) -> np.ndarray:
    return np.isin(np.arange(6), cubes)


@pytest.mark.parametrize(
    ("hit", "paper", "ordered"),
    [
        ((YELLOW,), 2.0, 2.0),
        ((YELLOW, PURPLE), 1.95, 1.95),
        ((YELLOW, PURPLE, ORANGE, RED), 1.05, 1.85),  # blue stands between, so that red was not struck
        ((YELLOW, RED), 1.2, 2.0),
        ((PURPLE, ORANGE), -0.15, 0.0),  # under a target that stands
        ((GREEN,), -0.4, 0.0),
        ((RED, GREEN, BLUE, ORANGE, PURPLE, YELLOW), 0.45, 0.45),
        ((), 0.0, 0.0),
    ],
)
def test_by_order_a_cube_costs_only_with_all_above_it(hit, paper, ordered):
    inside, outside = np.asarray(False), np.asarray(True)
    assert float(rules.reward(scene(*hit), inside)) == pytest.approx(paper, abs=1e-6)
    assert float(rewards.ordered(scene(*hit), inside)) == pytest.approx(ordered, abs=1e-6)
    assert float(rewards.ordered(scene(*hit), outside)) == -1.0


@pytest.mark.parametrize(
    ("fallen", "expected"),
    [
        ((YELLOW,), 2.0),
        ((YELLOW, RED), 1.75),
        ((YELLOW, PURPLE), 1.75),
        ((YELLOW, PURPLE, ORANGE), 1.5),
        ((RED, GREEN, BLUE, ORANGE, PURPLE, YELLOW), 0.75),
        ((PURPLE, GREEN), -0.5),
        ((), 0.0),
    ],
)
def test_once_settled_every_other_cube_that_has_fallen_costs_a_quarter(fallen, expected):
    left = lambda failed: Aftermath(scene(*fallen), np.asarray(failed))
    assert float(rewards.settled(left(False), np.asarray(False))) == pytest.approx(expected)
    assert float(rewards.settled(left(False), np.asarray(True))) == -1.0
    assert float(rewards.settled(left(True), np.asarray(False))) == 0.0


class Landslide:
    """Physics of places: beyond x = 0.5 m the gripper pushes the top cube; two intervals later blue and orange fall.

    Below z = 0.2 m the orange one is pushed alone; above z = 0.45 m everything breaks down.
    """

    scene = Scene()

    def advance(self, parameters, state, target):
        since = state.qvel[0] + ((target[0] > 0.5) | (state.qvel[0] > 0))
        low = jnp.maximum(state.qvel[1], target[1] < 0.2)
        push = jnp.zeros(6).at[YELLOW].set(since > 0).at[BLUE].set(since > 2)
        push = push.at[ORANGE].set(jnp.maximum(since > 2, low)) * 0.05
        qpos = initial_positions(self.scene, parameters).at[:2].set(target)
        qpos = qpos.at[self.scene.first_cube + 7 * np.arange(6)].add(push)
        return settled(state, qpos, state.qvel.at[0].set(since).at[1].set(low), target, target[1] > 0.45)


@functools.cache
def compiled(name: str):
    whip = Whip(Landslide(), reward=name)
    return jax.jit(whip.reset), jax.jit(whip.step)


def played(name: str, action, steps: int = rules.STEPS) -> tuple[list[float], bool]:
    """Rewards of an episode up to its end, and whether it failed."""
    (reset, step), parameters, found = compiled(name), median(), []
    episode, _ = reset(jax.random.key(0), parameters)
    for index in range(steps):
        episode, made = step(jax.random.key(index), parameters, episode, jnp.asarray(action))
        found.append(float(made.reward))
        if made.terminated or made.truncated:
            break
    return found, bool(made.failed)


@pytest.mark.slow
def test_what_falls_after_the_hit_counts_only_once_settled():
    towards = [0.05, 0.0]
    for name, last in (("paper", 2.0), ("ordered", 2.0), ("settled", 1.5)):
        rewarded, _ = played(name, towards)
        assert 1 < len(rewarded) < rules.STEPS and not any(rewarded[:-1])
        assert rewarded[-1] == pytest.approx(last)


def test_a_cube_struck_from_under_the_target_costs_at_every_step_or_once_in_the_end_or_never():
    downwards = [0.0, -0.012]  # to z = 0.2 m and below, within the workspace
    rewarded, _ = played("paper", downwards)
    assert len(rewarded) == rules.STEPS and rewarded[-1] == pytest.approx(-0.1) and sum(rewarded) < -0.15
    assert not any(played("ordered", downwards)[0])
    rewarded, _ = played("settled", downwards)
    assert not any(rewarded[:-1]) and rewarded[-1] == pytest.approx(-rewards.FALLEN_COST)


@pytest.mark.parametrize(("action", "reward"), [([0.05, 0.0], 1.5), ([-0.06, 0.0], -1.0)])
def test_steps_beyond_the_end_of_an_episode_are_not_settled_again(action, reward):
    """Evaluations take them, and leave them out: each would simulate eleven more intervals."""
    (reset, step), parameters, found = compiled("settled"), median(), []
    episode, _ = reset(jax.random.key(0), parameters)
    for index in range(rules.STEPS):
        episode, made = step(jax.random.key(index), parameters, episode, jnp.asarray(action))
        found.append(float(made.reward))
    assert [one for one in found if one] == [pytest.approx(reward)]


@pytest.mark.parametrize("name", rewards.REWARDS)
def test_leaving_costs_one_and_an_unstable_simulation_nothing(name):
    rewarded, failed = played(name, [-0.06, 0.0])
    assert rewarded[-1] == -1.0 and not any(rewarded[:-1]) and not failed
    rewarded, failed = played(name, [0.0, 0.05])
    assert failed and not any(rewarded)


def test_the_rewards_name_is_an_option_and_an_unknown_one_is_refused():
    assert ENVIRONMENTS.load("whip,engine=native").reward == "paper"
    assert ENVIRONMENTS.load("whip,engine=native,reward=settled").whip.reward == "settled"
    with pytest.raises(ValueError, match=r"reward: expected one of paper, ordered, settled, got 'kind'$"):
        ENVIRONMENTS.load("whip,reward=kind")


def test_with_a_history_it_is_the_same_task():
    own, env = (
        ENVIRONMENTS.load(f"{name},engine=native,reward=settled") for name in ("whip", f"{MODULE}:with_history")
    )
    assert env.observations.size == 6 * own.observations.size + 5 * own.actions.size
    assert env.observations.names[28] == "gripper x 1 before" and env.observations.names[-2:] == BEFORE
    assert env.bounds.shape == (2, env.observations.size)
    assert (env.name, env.reward, env.steps) == (own.name, "settled", own.steps)
    assert not hasattr(env, "deployment")  # which speaks of single observations
    with pytest.raises(ValueError, match="history: expected a whole number from 2"):
        ENVIRONMENTS.load(f"{MODULE}:with_history,history=1,engine=native")


def test_the_command_refuses_unknown_names_in_a_line(tmp_path, capsys):
    pytest.importorskip("brax")
    from jaxlfi.cli import train

    words = ["--domain", "median", "--out", str(tmp_path / "out")]
    assert train.main(["whip,engine=native", "--reward", "kind", *words]) != 0
    (said,) = capsys.readouterr().err.splitlines()
    assert said.endswith("reward: expected one of paper, ordered, settled, got 'kind'")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_trainings_and_policies_record_it(tmp_path):
    pytest.importorskip("brax")
    from jaxlfi.cli import train
    from jaxlfi.rl import training
    from jaxlfi.rl.policy import load

    words = ["--domain", "median", "--out", str(tmp_path / "out"), "--environments", "2", "--minibatches", "2"]
    words += ["--total-steps", "32", "--epochs", "1", "--hidden", "4", "--no-figures", "--reward", "settled"]
    with jax.debug_key_reuse(False):  # Brax uses keys in its own way
        assert train.main(["whip,detector=clean,engine=native", *words]) == 0
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    assert config["environment"].endswith(",reward=settled") and config["reward"] == "settled"
    assert load(tmp_path / "out" / "median" / "seed_000" / "policy.npz").schema["reward"] == "settled"
    with pytest.raises(training.StoreError, match="expected a training with the reward paper, got one with settled"):
        training.resumed(tmp_path / "out", ENVIRONMENTS.load("whip,detector=clean,engine=native"), print)
