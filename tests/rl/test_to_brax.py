"""Environments for learners that train on Brax's: one episode, Brax's wrappers around many, and a training by Brax."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.toy import Line

pytest.importorskip("brax")

from brax.envs.wrappers.training import wrap

from jaxlfi.rl.to_brax import ToBrax

LINE = Line()


def test_an_episode_as_policies_see_it():
    """Observations are scaled, and actions of 1 are pushes of 0.6 m; typed keys and raw ones begin alike."""
    environment = ToBrax("rl.toy:Line", (2.0, 1.9))
    assert (environment.observation_size, environment.action_size, environment.backend) == (2, 1, "line")
    first, step = jax.jit(environment.reset)(jax.random.key(3)), jax.jit(environment.step)
    np.testing.assert_array_equal(first.obs, environment.reset(jax.random.key_data(jax.random.key(3))).obs)
    position = first.pipeline_state.state.inner.position
    np.testing.assert_allclose(first.obs, [(position - 0.5) / 2, 1.9], rtol=1e-6)
    after = step(first, jnp.array([4.0]))
    np.testing.assert_allclose(after.obs[0], (position + 1.2 - 0.5) / 2, rtol=1e-5)
    np.testing.assert_allclose(after.reward, position + 1.2 - 1.9, rtol=1e-5)
    assert after.done == 0 and set(after.metrics) == {"there", "failed"}
    failed = step(step(after, jnp.array([1.0])), jnp.array([1.0]))
    assert failed.done == 1 and failed.metrics["failed"] == 1 and failed.metrics["there"] == 0


def test_many_are_wrapped_and_have_theta_of_their_own():
    draw = lambda key: jnp.stack([jnp.asarray(1.0), jax.random.uniform(key, minval=1.0, maxval=1.4)])
    environment = wrap(ToBrax(LINE, draw), episode_length=LINE.steps)
    state = jax.jit(environment.reset)(jax.random.key_data(jax.random.split(jax.random.key(0), 5)))
    step = jax.jit(environment.step)
    targets = state.obs[:, 1]
    assert len(np.unique(targets)) == 5
    with jax.debug_key_reuse(False):  # Brax's wrapper goes back to the first state, whose key has been used
        for t in range(1, LINE.steps + 1):
            state = step(state, jnp.full((5, 1), -0.2))  # stays
            np.testing.assert_array_equal(state.done, t == LINE.steps)
    np.testing.assert_array_equal(state.info["truncation"], 1)
    np.testing.assert_array_equal(state.obs[:, 1], targets)


@pytest.mark.slow
def test_brax_trains_on_it():
    from brax.training.agents.ppo.train import train

    settings = {"num_envs": 4, "batch_size": 4, "num_minibatches": 2, "unroll_length": 5, "num_eval_envs": 4}
    with jax.debug_key_reuse(False), warnings.catch_warnings():  # both are Brax's own
        warnings.simplefilter("ignore", DeprecationWarning)
        _, _, metrics = train(ToBrax(LINE), 400, episode_length=LINE.steps, num_evals=2, **settings)
    assert np.isfinite(metrics["eval/episode_reward"]) and "eval/episode_there" in metrics


def test_points_outside_of_phi_are_refused():
    with pytest.raises(ValueError, match=r"domain: expected gain between 0\.25 and 4 "):
        ToBrax(LINE, (5.0, 0.0))
