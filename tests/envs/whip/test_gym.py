"""The gymnasium environment of the whipping task: its checker, its episodes, and a vector against single ones."""

import warnings

import jax
import numpy as np
import pytest

pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from jaxlfi.envs.whip.gym import WhipGym, WhipVector, initial_domain
from jaxlfi.envs.whip.parameters import INITIAL, check, median
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from tests.golden import make_whip_gym as golden
from tests.golden.make_whip_gym import ENGINE, WHIP


def play(environment, actions, seed=0):
    """An episode, or as much of it as there are actions for: observations, rewards, ends and the last info."""
    observation, info = environment.reset(seed=seed)
    observations, rewards = [observation], []
    for action in actions:
        observation, reward, terminated, truncated, info = environment.step(action)
        observations.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            return np.stack(observations), rewards, (terminated, truncated), info
    return np.stack(observations), rewards, (False, False), info


def test_gymnasium_has_nothing_against_it():
    environment = WhipGym(initial_domain, engine=ENGINE, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity")  # keypoints may be anywhere
        warnings.filterwarnings("ignore", message=".*alternative render modes")
        check_env(environment)
    picture = environment.render()
    assert picture.shape == (256, 256, 3) and picture.dtype == np.uint8
    red = np.argwhere((picture == np.round([0.85 * 255, 0.15 * 255, 0.15 * 255])).all(-1)).mean(0) / 256
    yellow = np.argwhere((picture == np.round([0.95 * 255, 0.85 * 255, 0.1 * 255])).all(-1)).mean(0) / 256
    assert red[0] > yellow[0] + 0.1 and abs(red[1] - yellow[1]) < 0.01


def test_a_whip_that_hits_the_top_cube():
    observations, rewards, ends, info = play(WhipGym(engine=ENGINE), WHIP)
    assert rewards == [0.0] * 6 + [2.0] and ends == (True, False)
    np.testing.assert_array_equal(info["hit"], [0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(observations[-1, 22:], info["hit"])
    assert not info["outside"] and not info["failed"] and info["seen"].all()
    assert info["length"] == pytest.approx(0.25) and info["young"] == pytest.approx(2.5e4)


def test_leaving_the_workspace_and_doing_nothing():
    _, rewards, ends, info = play(WhipGym(engine=ENGINE), np.tile([0.0, 0.06], (5, 1)))
    assert rewards == [0.0, 0.0, -1.0] and ends == (True, False) and info["outside"] is True
    _, rewards, ends, info = play(WhipGym(engine=ENGINE), 0 * WHIP)
    assert rewards == [0.0] * 16 and ends == (False, True) and not info["hit"].any()


def test_a_bad_action_is_refused_and_nothing_is_lost():
    environment = WhipGym(engine=ENGINE, detector="noisy")
    undisturbed, *_ = play(environment, WHIP[:3], seed=4)
    environment.reset(seed=4)
    seen = []
    for action in WHIP[:3]:
        for bad, got in (
            ([np.nan, 0.0], "finite numbers, got"),
            ([0.0, np.inf], "finite"),
            ([0.01], r"shape \[1\]"),
            (0.3, r"shape \[\]"),
            ("left", "got 'left'"),
            (None, "finite|shape"),
        ):
            with pytest.raises(ValueError, match=got) as error:
                environment.step(bad)
            assert str(error.value).startswith("action: expected") and "\n" not in str(error.value)
        seen.append(environment.step(action)[0])
    np.testing.assert_array_equal(seen, undisturbed[1:])


def test_seeds_decide_scenes_and_noise():
    environment = WhipGym(initial_domain, "transporter", ENGINE)
    first, again, other = (play(environment, WHIP[:2], seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0], again[0])
    assert first[3]["young"] == again[3]["young"] != other[3]["young"]
    later = [environment.reset()[1]["length"] for _ in range(3)]
    environment.reset(seed=2)
    assert [environment.reset()[1]["length"] for _ in range(3)] != later and len({*later}) == 3
    assert WhipGym(engine=ENGINE).reset()[0].shape == (28,)


def test_the_initial_domain_is_the_initial_support():
    scenes = jax.jit(jax.vmap(initial_domain))(jax.random.split(jax.random.key(0), 400))
    check(scenes)
    drawn = np.stack([scenes.length, scenes.young], axis=-1)
    low, high = np.asarray(INITIAL.low), np.asarray(INITIAL.high)
    assert (drawn >= low).all() and (drawn <= high).all()
    np.testing.assert_allclose((drawn.mean(0) - low) / (high - low), 0.5, atol=0.05)
    np.testing.assert_allclose((drawn.std(0)) / (high - low), 12**-0.5, atol=0.03)


@pytest.mark.slow
def test_a_vector_is_single_ones_which_begin_anew(key):
    """Two of three leave the workspace, at times of their own, and then ignore an action."""
    many = WhipVector(3, initial_domain, "transporter", ENGINE)
    assert many.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    single = [WhipGym(initial_domain, "transporter", ENGINE) for _ in range(3)]
    observations, info = many.reset(seed=7)
    assert observations in many.observation_space
    for i, environment in enumerate(single):
        own, own_info = environment.reset(seed=7 + i)
        np.testing.assert_allclose(observations[i], own, atol=1e-6)
        assert info["young"][i] == pytest.approx(own_info["young"])
    ended = np.zeros((18, 3), bool)
    for t in range(18):
        actions = np.stack([[0.0, 0.05], [-0.02, 0.0], [0.01 * (-1) ** t, 0.0]]).astype(np.float32)
        observations, rewards, terminated, truncated, info = many.step(actions)
        assert rewards.shape == terminated.shape == truncated.shape == (3,) and observations.dtype == np.float32
        assert observations.flags.writeable and rewards.flags.writeable
        for i, environment in enumerate(single):
            if t and ended[t - 1, i]:
                (own, own_info), ends = environment.reset(), (0.0, False, False)
            else:
                own, *ends, own_info = environment.step(actions[i])
            np.testing.assert_allclose(observations[i], own, atol=1e-4)
            np.testing.assert_allclose([rewards[i], terminated[i], truncated[i]], ends, atol=1e-6)
            assert info["length"][i] == pytest.approx(own_info["length"]) and info["_length"][i]
            np.testing.assert_array_equal(info["hit"][i], own_info["hit"])
            ended[t, i] = terminated[i] or truncated[i]
    assert ended.sum(0).tolist() == [3, 2, 1] and ended[15, 2]


@pytest.mark.slow
def test_a_vector_begins_anew_in_the_same_step_if_asked_to():
    """As above; the last observation and what it says of the old scene are in the info."""
    many = WhipVector(3, initial_domain, "transporter", ENGINE, autoreset_mode="SameStep")
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    single = [WhipGym(initial_domain, "transporter", ENGINE) for _ in range(3)]
    many.reset(seed=7)
    for i, environment in enumerate(single):
        environment.reset(seed=7 + i)
    ended = [0, 0, 0]
    for t in range(17):
        actions = np.stack([[0.0, 0.05], [-0.02, 0.0], [0.01 * (-1) ** t, 0.0]]).astype(np.float32)
        observations, rewards, terminated, truncated, info = many.step(actions)
        for i, environment in enumerate(single):
            own, *ends, own_info = environment.step(actions[i])
            np.testing.assert_allclose([rewards[i], terminated[i], truncated[i]], ends, atol=1e-6)
            over = ends[1] or ends[2]
            assert info.get("_final_obs", np.zeros(3, bool))[i] == over
            if over:
                ended[i] += 1
                np.testing.assert_allclose(info["final_obs"][i], own, atol=1e-4)
                final = info["final_info"]
                assert final["young"][i] == pytest.approx(own_info["young"]) and final["_young"][i]
                np.testing.assert_array_equal(final["hit"][i], own_info["hit"])
                own, own_info = environment.reset()
            np.testing.assert_allclose(observations[i], own, atol=1e-4)
            assert info["young"][i] == pytest.approx(own_info["young"])
    assert ended == [4, 2, 1]


@pytest.mark.slow
def test_nuisances_are_drawn_for_given_lengths_and_moduli():
    """Every episode of a scene has its length and modulus, and a stack that stands elsewhere."""
    lengths, moduli = np.array([0.2, 0.3]), np.array([1e4, 4e4])
    many = WhipVector(2, median(lengths, moduli), engine=ENGINE, nuisances="random", autoreset_mode="SameStep")
    starts = [many.reset(seed=0)[0]]
    for _ in range(10):
        observations, _, terminated, _, info = many.step(np.tile(np.float32([[0.0, 0.06]]), (2, 1)))
        np.testing.assert_allclose(info["length"], lengths, rtol=1e-6)
        np.testing.assert_allclose(info["young"], moduli, rtol=1e-6)
        if terminated.any():
            assert terminated.all()
            starts.append(observations)
    stacks = np.stack(starts)[:, :, 20]  # u of the top cube
    assert len(stacks) == 4 and len(np.unique(stacks)) == 8
    single = WhipGym(median(0.2, 1e4), engine=ENGINE, nuisances="random")
    assert len({float(single.reset(seed=seed)[0][20]) for seed in range(3)}) == 3
    with pytest.raises(ValueError, match="nuisances: expected fixed or random, got 'some'"):
        WhipGym(engine=ENGINE, nuisances="some")
    with pytest.raises(ValueError, match="autoreset_mode: expected NextStep or SameStep, got 'Disabled'"):
        WhipVector(2, engine=ENGINE, autoreset_mode="Disabled")


def test_a_vector_of_scenes_of_their_own():
    lengths = np.array([0.2, 0.3])
    many = WhipVector(2, median(lengths, 1e4), engine=ENGINE)
    np.testing.assert_allclose(many.reset(seed=[3, None])[1]["length"], lengths, rtol=1e-6)
    with pytest.raises(ValueError, match=r"action: expected numbers of shape \[2, 2\], got shape \[2\]"):
        many.step([0.0, 0.0])
    with pytest.raises(ValueError, match="seed: expected 2 of them, got 1"):
        many.reset(seed=[3])
    with pytest.raises(ValueError, match=r"parameters: expected one scene's or \[3\], got \[2\] for length"):
        WhipVector(3, median(lengths, 1e4), engine=ENGINE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": median(length=0.4)}, "length: expected numbers between"),
        ({"parameters": median(length=np.array([0.2, 0.3]))}, r"one scene's or \[\], got \[2\]"),
        ({"detector": "perfect"}, "detector: expected one of clean, .*, got 'perfect'"),
        ({"render_mode": "human"}, "render_mode: expected rgb_array or none, got 'human'"),
    ],
)
def test_bad_input_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        WhipGym(**{"engine": ENGINE, **changes})


def test_a_reset_comes_first():
    for environment, action in ((WhipGym(engine=ENGINE), [0.0, 0.0]), (WhipVector(1, engine=ENGINE), [[0.0, 0.0]])):
        with pytest.raises(gymnasium.error.ResetNeeded):
            environment.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded):
        WhipGym(engine=ENGINE, render_mode="rgb_array").render()


def test_gymnasium_finds_both_by_name():
    assert isinstance(gymnasium.make("jaxlfi/Whip-v0", engine=ENGINE).unwrapped, WhipGym)
    vector = gymnasium.make_vec("jaxlfi/Whip-v0", num_envs=2, vectorization_mode="vector_entry_point", engine=ENGINE)
    assert isinstance(vector, WhipVector) and vector.num_envs == 2
    with pytest.raises(ValueError, match="num_envs"):
        WhipVector(0, engine=ENGINE)


def same_numbers(found, name):
    """Within what another processor rounds otherwise; moduli are in Pa."""
    np.testing.assert_allclose(found, np.load(golden.PATH)[name], rtol=1e-5, atol=1e-3)


def test_numbers_are_those_of_the_first_adapter():
    same_numbers(golden.fixed(), "fixed")
    same_numbers(golden.drawn(), "drawn")


@pytest.mark.slow
def test_those_of_vectors_too():
    same_numbers(golden.in_the_next_step(), "next")
    for found, name in zip(golden.in_the_same_step(), ("same", "final"), strict=True):
        same_numbers(found, name)


def test_a_detectors_numbers_may_be_arrays():
    own = DETECTORS["learnt-transporter"].replace(noise=np.float32(0.01), places=np.array([0.1, 0.4, 0.7, 0.9]))
    assert WhipGym(engine=ENGINE, detector=own)._course.environment.whip.detector.places == (0.1, 0.4, 0.7, 0.9)
