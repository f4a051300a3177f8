"""Stable-Baselines3 on a vector environment of gymnasium: its ends and last observations, and the files of policies."""

import gymnasium
import numpy as np
import pytest

# PyTorch is too large for the extra `test`.
pytest.importorskip("stable_baselines3", reason="needs the extra bench")
pytest.importorskip("brax")

from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO

from experiments import sb3
from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS
from jaxlfi.rl.policy import load


class Counter(gymnasium.Env):
    """Counts its steps from a start of its own, up to a limit that truncates it, or an action that terminates it."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, start):
        self.start, self.episode = start, 0

    def reset(self, *, seed=None, options=None):
        self.steps, self.episode = 0, self.episode + 1
        return self.seen(), {"hit": np.zeros(6, bool)}

    def step(self, action):
        self.steps += 1
        hit = np.array([0, 0, 0, 0, 0, action[0] > 0.5], bool)
        return self.seen(), float(action[1]), bool(action[0] > 0.5), self.steps == 3, {"hit": hit}

    def seen(self):
        return np.float32([self.start + 10 * self.episode + self.steps])


def counters(mode=AutoresetMode.SAME_STEP):
    return SyncVectorEnv([lambda: Counter(100), lambda: Counter(200)], autoreset_mode=mode)


def test_ends_and_last_observations_are_those_of_the_episode():
    environments = sb3.OfGymnasium(counters())
    assert environments.reset().tolist() == [[110], [210]]
    seen, rewards, over, infos = environments.step(np.float32([[0, 0.25], [0, -1]]))
    assert (seen.tolist(), rewards.tolist(), over.tolist(), infos) == (
        [[111], [211]],
        [0.25, -1],
        [False] * 2,
        [{}, {}],
    )
    seen, rewards, over, infos = environments.step(np.float32([[0, 0], [1, 0.5]]))
    assert seen.tolist() == [[112], [220]] and rewards.tolist() == [0, 0.5] and over.tolist() == [False, True]
    assert infos[0] == {} and infos[1]["terminal_observation"].tolist() == [212]
    assert infos[1]["TimeLimit.truncated"] is False and infos[1]["hit"].tolist() == [False] * 5 + [True]
    seen, _, over, infos = environments.step(np.float32([[0, 0], [0, 0]]))
    assert seen.tolist() == [[120], [221]] and over.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is True and infos[0]["terminal_observation"].tolist() == [113]
    with pytest.raises(ValueError, match=r"environments: expected those of AutoresetMode\.SAME_STEP"):
        sb3.OfGymnasium(counters(AutoresetMode.NEXT_STEP))


def test_it_is_trained_and_every_episode_is_counted(monkeypatch):
    """Two environments, episodes of at most three steps; returns are sums of rewards, of the right episode."""
    monkeypatch.setattr(sb3, "ENVIRONMENTS", 2)
    episodes, seen = sb3.Episodes(), []
    counted = episodes._on_step
    episodes._on_step = lambda: seen.append((episodes.locals["rewards"].copy(), episodes.locals["dones"])) or counted()
    model = PPO("MlpPolicy", sb3.OfGymnasium(counters()), n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu")
    model.learn(16, callback=episodes)
    expected, sums = [], np.zeros(2)
    for step, (rewards, over) in enumerate(seen):
        sums += rewards
        expected += [(2 * (step + 1), sums[place]) for place in np.flatnonzero(over)]
        sums[over] = 0.0
    assert len(seen) == 8 and len(expected) >= 5
    np.testing.assert_allclose([row[:2] for row in episodes.rows], expected, rtol=1e-6)
    assert any(row[2] for row in episodes.rows) and all(hit == clean for *_, hit, clean in episodes.rows)


def test_returns_are_averaged_over_the_steps_of_an_update():
    rows = [(12, 1.0, True, False), (192, 3.0, False, False), (193, 5.0, True, True), (700, -1.0, False, False)]
    curves = sb3.binned(rows, 768)
    np.testing.assert_array_equal(curves["episodes"], [2, 1, 0, 1])
    np.testing.assert_array_equal(curves["value"], [2.0, 5.0, np.nan, -1.0])
    np.testing.assert_array_equal(curves["hit"], [0.5, 1.0, np.nan, 0.0])
    np.testing.assert_array_equal(curves["clean_hit"], [0.0, 1.0, np.nan, 0.0])


def test_a_policy_is_the_model_that_was_trained(tmp_path):
    class Space(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATIONS.size,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    model = PPO("MlpPolicy", Space(), seed=3, device="cpu")
    model.policy.action_net.weight.data *= 200  # which begins with hardly any action at all
    policy = load(sb3.as_policy(model, 3).save(tmp_path / "policy.npz"))
    policy.require("whip", OBSERVATIONS, ACTIONS)
    random = np.random.default_rng(0)
    observations = random.normal(0.5, 30.0, (50, OBSERVATIONS.size)).astype(np.float32)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(policy(observations), 0.06 * expected, atol=1e-5)
    assert (np.abs(expected) == 1).any() and (np.abs(expected) < 0.9).any()
