"""Episodes one after another: what ends them, what begins anew, and what a step is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.toy import Line

from jaxlfi.rl.domains import Domain
from jaxlfi.rl.episodes import Batch

LINE = Line()
N = 5
STAY, PUSH = -0.2, 1.0
"""Actions as a policy gives them: 0.1 + 0.5 a metres."""


@pytest.fixture
def domain():
    return Domain(jnp.stack([jnp.linspace(0.5, 1.0, N), jnp.full(N, 1.9)], axis=1))


@pytest.fixture
def states_twice():
    """Going on from one state more than once uses its keys more than once."""
    with jax.debug_key_reuse(False):
        yield


def rolled(batch, state, action, steps):
    """All states after so many steps of one action, stacked."""

    def step(state, _):
        state = batch.step(state, jnp.full((N, 1), action))
        return state, state

    return jax.jit(lambda state: jax.lax.scan(step, state, length=steps)[1])(state)


def test_the_time_limit_is_a_termination_and_a_new_episode_follows_in_the_same_step(key, domain):
    batch = Batch(LINE, N)
    first = batch.reset(key, domain)
    states = rolled(batch, first, STAY, 15)
    ends = np.arange(1, 16) % LINE.steps == 0
    np.testing.assert_array_equal(states.done, np.repeat(ends[:, None], N, 1))
    np.testing.assert_array_equal(states.info["truncation"], 0)
    np.testing.assert_array_equal(states.info["ended"].done, states.done > 0)
    np.testing.assert_array_equal(states.info["ended"].steps[ends], LINE.steps)
    np.testing.assert_array_equal(states.steps[ends], 0)
    # Nothing moved: the return is seven times the distance, also of the second episode.
    starts = np.stack([first.env.inner.position, states.env.inner.position[6]])
    np.testing.assert_allclose(states.info["ended"].value[ends], -7 * np.abs(1.9 - starts), rtol=1e-5)
    assert np.all(np.abs(starts[0] - starts[1]) > 1e-4)  # a start of its own


def test_an_action_is_limited_and_scaled_by_the_schema(key, domain, states_twice):
    batch = Batch(LINE, N)
    first = batch.reset(key, domain)
    for action, moved in ((PUSH, 0.6), (50.0, 0.6), (-50.0, -0.4), (STAY, 0.0), (0.5, 0.35)):
        after = batch.step(first, jnp.full((N, 1), action))
        expected = first.env.inner.position + domain.theta[:, 0] * moved
        np.testing.assert_allclose(after.env.inner.position, expected, atol=1e-6)
        np.testing.assert_allclose(after.obs[:, 0], (after.env.inner.position - 0.5) / 2.0, atol=1e-6)


def test_a_failed_simulation_is_truncated_and_worth_nothing(key):
    fast = Domain(jnp.tile(jnp.array([[4.0, -2.0]]), (N, 1)))
    batch = Batch(LINE, N)
    states = rolled(batch, batch.reset(key, fast), PUSH, 2)  # 2.4 m a step
    np.testing.assert_array_equal(states.info["truncation"], [[0] * N, [1] * N])
    np.testing.assert_array_equal(states.done, states.info["truncation"])
    np.testing.assert_array_equal(states.reward[1], 0)
    np.testing.assert_array_equal(states.info["ended"].facts["failed"][1], True)


def test_each_environment_keeps_its_theta_unless_they_are_redrawn(key, domain, states_twice):
    states = rolled(Batch(LINE, N), Batch(LINE, N).reset(key, domain), STAY, 40)
    np.testing.assert_array_equal(states.env.inner.theta, np.tile(domain.theta, (40, 1, 1)))
    pool = Domain(jnp.stack([jnp.ones(64), jnp.linspace(-2, 2, 64)], axis=1))
    redrawn = Batch(LINE, N, redrawn=True)
    states = rolled(redrawn, redrawn.reset(key, pool), STAY, 40)
    every = np.asarray(states.env.inner.theta[..., 1])
    assert np.isin(every, np.asarray(pool.theta[:, 1])).all()
    assert all(len(np.unique(own)) >= 4 for own in every.T)


def test_each_environment_needs_a_point(key, domain):
    """An index beyond the last point would be taken for the last one."""
    with pytest.raises(ValueError, match="domain: expected 6 points, one an environment, got 5"):
        Batch(LINE, N + 1).reset(key, domain)
    Batch(LINE, N + 1, redrawn=True).reset(key, domain)


def test_an_episode_does_not_depend_on_the_others(key, domain, states_twice):
    """Environment i alone, with its key, is what it is among others."""
    batch, alone = Batch(LINE, N), Batch(LINE, 1)
    together = rolled(batch, batch.reset(key, domain), 0.3, 20)
    first = batch.reset(key, domain)
    one = jax.tree.map(lambda leaf: leaf[2:3], first)
    step = lambda state, _: (lambda after: (after, after))(alone.step(state, jnp.full((1, 1), 0.3)))
    single = jax.lax.scan(step, one, length=20)[1]
    np.testing.assert_allclose(single.obs[:, 0], together.obs[:, 2], atol=1e-6)
    np.testing.assert_allclose(single.reward[:, 0], together.reward[:, 2], atol=1e-6)
