"""Any environment for other people's learners: gymnasium's checker, episodes one and many, and Brax's wrappers."""

import importlib.util
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.toy import Line

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from jaxlfi.rl import gym
from jaxlfi.rl.gym import GymEnvironment, GymVector

LINE = Line()
NAME = "rl.toy:Line"


def drawn(key):
    """Gains of 1, and targets that a point reaches by its third push."""
    return jnp.stack([jnp.asarray(1.0), jax.random.uniform(key, minval=1.0, maxval=1.4)])


def test_gymnasium_has_nothing_against_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity")  # a position may be anywhere
        warnings.filterwarnings("ignore", message=".*(render|normalized)")
        check_env(GymEnvironment(LINE, drawn))
        check_env(GymEnvironment(NAME))


def test_an_episode_is_that_of_the_environment():
    """An action of 0.3 m moves by gain times that; times and failures truncate, the target terminates."""
    environment = GymEnvironment(LINE, (2.0, 1.9))
    first, info = environment.reset(seed=3)
    assert info == {"there": False, "failed": False, "gain": 2.0, "target": pytest.approx(1.9)}
    seen, reward, terminated, truncated, _ = environment.step([0.3])
    assert seen == pytest.approx(first + np.array([0.6, 0.0])) and reward == pytest.approx(seen[0] - 1.9)
    assert not terminated and not truncated and seen.dtype == np.float32
    seen, *_, info = environment.step([50.0])  # limited to 0.6 m
    assert seen[0] == pytest.approx(first[0] + 1.8)
    there = environment.step([(1.9 - seen[0]) / 2])
    assert there[2:4] == (True, False) and there[4]["there"] is True
    for far, length, failed in ((0.0, LINE.steps, False), (0.6, 3, True)):
        environment.reset(seed=3)
        ends = [environment.step([far])[2:] for _ in range(length)]
        assert [end[:2] for end in ends] == [(False, False)] * (length - 1) + [(False, True)]
        assert ends[-1][2]["failed"] is failed


@pytest.mark.slow
@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_many_are_single_ones_which_begin_anew(mode):
    many = GymVector(3, LINE, drawn, mode)
    single = [GymEnvironment(LINE, drawn) for _ in range(3)]
    observations, info = many.reset(seed=7)
    assert observations in many.observation_space and observations.flags.writeable
    for i, environment in enumerate(single):
        own, own_info = environment.reset(seed=7 + i)
        np.testing.assert_allclose(observations[i], own, atol=1e-6)
        assert info["target"][i] == pytest.approx(own_info["target"]) and info["_target"][i]
    over, ended = np.zeros(3, bool), 0
    for t in range(18):
        actions = np.float32([[0.5], [0.6 - 0.02 * (t % 5)], [0.1 * (-1) ** t]])
        observations, rewards, terminated, truncated, info = many.step(actions)
        for i, environment in enumerate(single):
            if over[i] and mode is AutoresetMode.NEXT_STEP:
                (own, own_info), ends = environment.reset(), (0.0, False, False)
            else:
                own, *ends, own_info = environment.step(actions[i])
            np.testing.assert_allclose([rewards[i], terminated[i], truncated[i]], ends, atol=1e-5)
            ended += ends[1] or ends[2]
            if (ends[1] or ends[2]) and mode is AutoresetMode.SAME_STEP:
                assert info["_final_obs"][i] and info["final_info"]["_there"][i]
                np.testing.assert_allclose(info["final_obs"][i], own, atol=1e-5)
                assert info["final_info"]["target"][i] == pytest.approx(own_info["target"])
                own, own_info = environment.reset()
            np.testing.assert_allclose(observations[i], own, atol=1e-5)
            assert info["target"][i] == pytest.approx(own_info["target"])
        over = terminated | truncated
    assert ended > 6


class Noisy(Line):
    """Draws its rewards with a key of its own in each step."""

    def reset(self, key, theta):
        key, key_start = jax.random.split(key)
        state = super().reset(key_start, theta)
        return state.replace(inner=(state.inner, key))

    def step(self, state, action):
        point, key = state.inner
        key, key_reward = jax.random.split(key)
        after = super().step(state.replace(inner=point), action)
        return after.replace(inner=(after.inner, key), reward=jax.random.normal(key_reward))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_an_environments_own_keys_are_used_once(mode):
    """More than an episode, of which all rewards differ but those of resets."""
    many = GymVector(2, Noisy(), autoreset_mode=mode)
    many.reset(seed=0)
    rewards = np.stack([many.step(np.zeros((2, 1), np.float32))[1] for _ in range(LINE.steps + 3)])
    assert len(np.unique(rewards[rewards != 0])) == np.sum(rewards != 0) > 2 * LINE.steps


def test_environments_keep_points_of_their_own():
    points = np.array([[1.0, -1.0], [2.0, 1.0]])
    many = GymVector(2, NAME, points, "SameStep")
    many.reset(seed=[3, None])
    for _ in range(9):  # more than an episode
        info = many.step(np.float32([[0.1], [0.1]]))[-1]
        np.testing.assert_allclose(np.stack([info["gain"], info["target"]], axis=1), points)


def test_gymnasium_finds_both_by_name():
    asked = {"environment": NAME, "theta": (1.0, 0.2)}
    assert isinstance(gymnasium.make("jaxlfi/Environment-v0", **asked).unwrapped, GymEnvironment)
    vector = gymnasium.make_vec("jaxlfi/Environment-v0", num_envs=2, vectorization_mode="vector_entry_point", **asked)
    assert isinstance(vector, GymVector) and vector.num_envs == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GymEnvironment(LINE, (5.0, 0.0)), r"domain: expected gain between 0\.25 and 4 "),
        (lambda: GymEnvironment(LINE, 1.0), "domain: expected 2 numbers"),
        (lambda: GymVector(3, LINE, np.ones((2, 2))), r"theta: expected one point or \[3\], got \[2\]"),
        (lambda: GymEnvironment(LINE, render_mode="human"), "render_mode: expected none, got 'human'"),
        (lambda: GymEnvironment("nothing"), "environment: expected one of"),
        (lambda: GymVector(0, LINE), "num_envs: expected at least 1, got 0"),
        (lambda: GymVector(2, LINE, autoreset_mode="Disabled"), "autoreset_mode: expected NextStep or SameStep"),
        (lambda: GymVector(2, LINE).reset(seed=[3]), "seed: expected 2 of them, got 1"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_reset_comes_first():
    for environment, action in ((GymEnvironment(LINE), [0.0]), (GymVector(1, LINE), [[0.0]])):
        with pytest.raises(gymnasium.error.ResetNeeded):
            environment.step(action)


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    spec = importlib.util.spec_from_file_location("gym_without", gym.__file__)
    with pytest.raises(ImportError, match=r"needs gymnasium: pip install 'jaxlfi\[whip\]'"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
