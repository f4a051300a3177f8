"""Losses on a minibatch, against plain loops."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from jaxlfi.estimators.atomic_loss import contrast
from jaxlfi.estimators.losses import LOSSES, Rows


def key():
    return jax.random.key(3)


@functools.partial(jax.jit, static_argnums=(0, 1))
def evaluated(name, part, key, rows):
    """One part of a loss on these rows."""
    return getattr(LOSSES[name], part)(key, Location(rows.given), rows)


class Location:
    """q(theta | x) = N(theta; x, diag(0.5, 2)), one for each row: asymmetric, with an oracle in SciPy."""

    scale = np.array([0.5, 2.0])

    def __init__(self, x):
        self.x = x

    def log_prob(self, theta):
        z = (theta - self.x) / self.scale
        return -0.5 * jnp.sum(z**2, axis=-1) - np.log(self.scale).sum() - np.log(2 * np.pi)


contrasted = jax.jit(lambda key, weights: contrast(key, weights, 10))


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(0)
    n = 14
    return Rows(
        value=jnp.asarray(rng.normal(size=(n, 2)), jnp.float32),
        given=jnp.asarray(rng.normal(size=(n, 2)), jnp.float32),
        weights=jnp.asarray(rng.uniform(0.2, 2.0, n), jnp.float32),
        log_prior=jnp.asarray(rng.normal(size=n), jnp.float32),
        from_prior=jnp.asarray(rng.integers(0, 2, n), jnp.float32),
    )


def oracle(rows: Rows) -> np.ndarray:
    """log q(theta_j | x_i), shape [i, j]."""
    theta, x = np.asarray(rows.value, np.float64), np.asarray(rows.given, np.float64)
    normal = stats.norm(0, Location.scale)
    return np.array([[normal.logpdf(theta[j] - x[i]).sum() for j in range(len(theta))] for i in range(len(x))])


def test_the_likelihood_is_the_weighted_mean_of_minus_log_q(rows):
    own, weights = np.diag(oracle(rows)), np.asarray(rows.weights, np.float64)
    np.testing.assert_allclose(evaluated("likelihood", "training", key(), rows), -np.mean(weights * own), rtol=1e-5)
    np.testing.assert_allclose(
        evaluated("likelihood", "held_out", key(), rows), -np.sum(weights * own) / weights.sum(), rtol=1e-5
    )


@pytest.mark.parametrize("name", ["atomic", "combined"])
@pytest.mark.parametrize("part", ["training", "held_out"])
def test_the_atomic_losses_are_the_loops(rows, name, part):
    log_q, log_prior = oracle(rows), np.asarray(rows.log_prior, np.float64)
    weights, from_prior = np.asarray(rows.weights, np.float64), np.asarray(rows.from_prior)
    others = np.asarray(contrasted(key(), rows.weights).rows)
    total = 0.0
    for i in range(len(weights)):
        atoms = [i, *others[:, i]]
        assert len(set(atoms)) == 10
        ratio = log_q[i, atoms] - log_prior[atoms]
        loss = -(ratio[0] - logsumexp(ratio))
        if name == "combined":
            loss -= from_prior[i] * log_q[i, i]
        total += weights[i] * loss
    np.testing.assert_allclose(evaluated(name, part, key(), rows), total / weights.sum(), rtol=1e-5)


@pytest.mark.parametrize("name", list(LOSSES))
def test_padding_does_not_count_among_the_held_out(rows, name):
    padded = jax.tree.map(lambda leaf: np.concatenate([leaf, 100 + leaf[:5]]), rows)
    padded.weights[14:] = 0.0
    moved = jax.tree.map(np.copy, padded)
    moved.value[14:] -= 7.0
    moved.given[14:] += 3.0
    losses = [evaluated(name, "held_out", key(), jax.tree.map(jnp.asarray, r)) for r in (padded, moved)]
    np.testing.assert_array_equal(*losses)


def test_taking_rows():
    rows = Rows(jnp.arange(6.0).reshape(3, 2), jnp.ones((3, 1)), jnp.arange(3.0), jnp.arange(3.0), jnp.zeros(3))
    taken = rows.take(jnp.array([2, 0]))
    np.testing.assert_array_equal(taken.value, [[4, 5], [0, 1]])
    np.testing.assert_array_equal(taken.weights, [2, 0])
