"""Named summaries against plain NumPy."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.tasks import summaries


def plain_series(trajectory):
    """The definition, in float64 and loops."""
    count, channels = trajectory.shape
    mean, variance = trajectory.mean(0), trajectory.var(0, ddof=1)
    z = (trajectory - mean) / np.sqrt(variance)
    memory = [np.sum(z[lag:, c] * z[:-lag, c]) / (count - 1) for c in range(channels) for lag in (1, 2)]
    pairs = [(a, b) for a in range(channels) for b in range(a + 1, channels)]
    coupling = [np.sum(z[:, a] * z[:, b]) / (count - 1) for a, b in pairs]
    return np.concatenate([mean, np.log(variance + 1), memory, coupling])


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_series_matches_its_definition(channels):
    rng = np.random.default_rng(channels)
    trajectory = np.cumsum(rng.normal(size=(40, channels)) * (1 + np.arange(channels)), axis=0)
    ours = np.asarray(summaries.series(jnp.asarray(trajectory, jnp.float32)))
    assert ours.shape == (4 * channels + channels * (channels - 1) // 2,)
    np.testing.assert_allclose(ours, plain_series(trajectory), rtol=2e-4, atol=2e-4)


def test_series_of_a_constant_channel_has_no_correlations():
    rng = np.random.default_rng(0)
    trajectory = np.stack([np.full(20, 3.0), rng.normal(size=20)], axis=-1).astype(np.float32)
    ours = np.asarray(summaries.series(jnp.asarray(trajectory)))
    np.testing.assert_array_equal(ours[[2, 4, 5, 8]], 0.0)
    np.testing.assert_allclose(ours[[1, 3, 6, 7]], plain_series(trajectory[:, 1:]), rtol=1e-3, atol=1e-4)


def test_identity_flattens():
    trajectory = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(summaries.named("identity")(trajectory), [0, 1, 2, 3, 4, 5])


def test_unknown_name_lists_the_known():
    with pytest.raises(ValueError, match=r"summary: expected one of \['identity', 'series'\], got 'nine'"):
        summaries.named("nine")


def test_cross_correlation_against_loops():
    rng = np.random.default_rng(3)
    states, actions = rng.normal(2.0, 3.0, (16, 28)), rng.uniform(-0.06, 0.06, (16, 2))
    x = summaries.cross_correlation(jnp.asarray(np.hstack([states, actions]), jnp.float32), actions=2)
    products = [sum(s[i] * a[j] for s, a in zip(states, actions, strict=True)) for i in range(28) for j in range(2)]
    expected = np.concatenate([products, states.mean(axis=0), states.std(axis=0)])
    assert x.shape == (112,)
    np.testing.assert_allclose(x, expected, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("actions", [0, 3, 4])
def test_cross_correlation_needs_states_and_actions(actions):
    with pytest.raises(ValueError, match=f"actions: expected some of the 3 columns, got {actions}"):
        summaries.cross_correlation(jnp.ones((5, 3)), actions=actions)


def test_a_long_summary_of_rows_is_laid_out_by_them():
    """A short one is so many single numbers, as is one that does not say what it consists of."""

    def some_rows(trajectory, rows):
        return jnp.ravel(trajectory[np.asarray(rows)])

    rows = tuple(range(0, 500, 10))
    assert summaries.layout(functools.partial(some_rows, rows=rows), (500, 11), 550) == (550, 1)
    some_rows.of_rows = True
    assert summaries.layout(functools.partial(some_rows, rows=rows), (500, 11), 550) == (50, 11)
    assert summaries.layout(functools.partial(some_rows, rows=rows[:20]), (500, 11), 220) == (220, 1)
