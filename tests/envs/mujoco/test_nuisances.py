"""What episodes draw, by the moments of many: uniform, normal, and Ornstein-Uhlenbeck."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.envs.mujoco.nuisances import Nuisances

GOAL = Goal(
    ("place", "speed"),
    interval=0.1,
    duration=2.0,
    targets={"place": ("there", 1.0)},
    commands={"there": (-1.0, 3.0)},
    action_delay=(0.01, 0.05),
    observation_delay=(0.02, 0.02),
    bias=0.5,
)
MANY, NOISE = 4000, np.array([0.2, 1.0])


@pytest.fixture(scope="module")
def drawn():
    """What 4,000 episodes drew, and their errors after each of 30 control intervals, shape [30, 4000, 2]."""
    nuisances = Nuisances(GOAL, {"speed": Discrepancy(0.7, 0.25)})

    def later(one, key):
        return nuisances.later(jax.random.wrap_key_data(key), one), one.errors

    def errors(key):
        key_first, key_later = jax.random.split(key)
        first = nuisances.draw(key_first, jnp.asarray(NOISE))
        return first, jax.lax.scan(later, first, jax.random.key_data(jax.random.split(key_later, 30)))[1]

    first, course = jax.jit(jax.vmap(errors, out_axes=(0, 1)))(jax.random.split(jax.random.key(0), MANY))
    return jax.device_get((first, course))


def test_delays_and_commands_are_uniform(drawn):
    first, _ = drawn
    for values, low, high in ((first.commands[:, 0], -1.0, 3.0), (first.action_delay, 0.01, 0.05)):
        assert np.abs(np.sort(values) - np.linspace(low, high, MANY)).max() < 0.04 * (high - low)
    np.testing.assert_allclose(first.observation_delay, 0.02, rtol=1e-6)


def test_offsets_are_fractions_of_the_noise(drawn):
    first, _ = drawn
    np.testing.assert_allclose(first.offsets.std(axis=0), 0.5 * NOISE, rtol=0.05)
    assert np.abs(first.offsets.mean(axis=0) / NOISE).max() < 0.03
    assert abs(np.corrcoef(first.offsets.T)[0, 1]) < 0.06


def test_errors_keep_their_deviation_and_fade_in_their_time(drawn):
    _, course = drawn
    assert not course[..., 0].any()
    errors = course[..., 1]
    np.testing.assert_allclose(errors.std(axis=1), 0.7, rtol=0.06)
    for lag in (1, 3):
        found = np.mean(errors[lag:] * errors[:-lag]) / 0.7**2
        assert found == pytest.approx(np.exp(-lag * 0.1 / 0.25), abs=0.03)
