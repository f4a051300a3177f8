"""A value function that sees theta: standardised by Phi; the policy, and its file, do not see it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")

from rl.toy import SETTINGS, Line

from jaxlfi.rl import domains, ppo
from jaxlfi.rl.episodes import Batch

pytestmark = pytest.mark.usefixtures("keys_of_brax")

THETA = SETTINGS.replace(critic="theta")


class Hidden(Line):
    """What there is to be had is what theta says, and nothing that is observed."""

    def step(self, state, action):
        return super().step(state, action).replace(reward=state.inner.theta[1], observation=jnp.zeros(2))

    def reset(self, key, theta):
        return super().reset(key, theta).replace(observation=jnp.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("redrawn", [False, True])
def test_theta_follows_what_is_observed(redrawn):
    """This includes the current episode, if each has its own."""
    line, points = Line(), domains.uniform(jax.random.key(1), Line().feasible, 4)
    batch, plain = Batch(line, 4, redrawn, privileged=True), Batch(line, 4, redrawn)
    state, other = batch.reset(jax.random.key(0), points), plain.reset(jax.random.key(0), points)
    steps, before, anew = [jax.jit(one.step) for one in (batch, plain)], state.env.inner.theta, False
    for _ in range(12):
        theta = np.asarray(state.env.inner.theta)
        expected = np.stack([np.log(theta[:, 0]) / np.log(4), theta[:, 1] / 2], axis=1)
        np.testing.assert_allclose(state.obs[:, 2:], expected, atol=1e-6)
        np.testing.assert_array_equal(state.obs[:, :2], other.obs)
        before, anew = theta, anew or not np.array_equal(theta, before)
        state, other = (step(own, jnp.full((4, 1), 0.3)) for step, own in zip(steps, (state, other), strict=True))
    assert anew == redrawn and other.theta is None


@pytest.mark.slow
def test_the_value_function_sees_it_and_the_policy_does_not():
    hidden, points = Hidden(), domains.uniform(jax.random.key(1), Line().feasible, 4)
    settings = THETA.replace(total_steps=1200, learning_rate=0.02)
    start = ppo.init(jax.random.key(0), hidden, settings, points)
    trained, made = jax.jit(lambda state: ppo.train(hidden, settings, state, settings.updates))(start)
    networks = ppo.policy_networks(hidden, settings)
    seen = jnp.array([[0.0, 0.0, 0.0, -0.5], [0.0, 0.0, 0.0, 0.5]])
    low, high = networks.value_network.apply(None, trained.params.value, seen)
    assert high - low > 1.0  # the rewards to come, of a target of -1 and of 1 m
    mean, _ = networks.policy_network.apply(None, trained.params.policy, seen)
    np.testing.assert_array_equal(mean[0], mean[1])
    policy = ppo.as_file(hidden, trained.params)
    assert [weight.shape for weight in policy.weights] == [(2, 8), (8, 8), (8, 1)]
    act = ppo.deterministic(hidden, settings, trained.params)
    np.testing.assert_allclose(act(jnp.zeros(2)), policy(np.zeros(2)), atol=1e-6)
    assert jnp.isfinite(made.value).any()


def test_by_default_it_does_not():
    start = ppo.init(jax.random.key(0), Line(), SETTINGS, domains.point(Line.nominal, 4))
    assert start.params.value["params"]["hidden_0"]["kernel"].shape == (2, 8) and start.episodes.theta is None
    assert dataclasses.asdict(SETTINGS)["critic"] == "observations"
    with pytest.raises(ValueError, match="critic: expected one of observations, theta, got 'state'"):
        SETTINGS.replace(critic="state")
