"""Kernel ridge regression, against a NumPy version that refits without each row and each fold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.flow_estimators import SplineFlow
from jaxlfi.estimators.kernel import LENGTHS, PENALTIES, kernel_ridge, unfitted_kernel
from jaxlfi.estimators.regression import KernelRegression, Regression, unfitted, unfitted_kernels
from jaxlfi.estimators.ridge import FOLDS

regressed = jax.jit(kernel_ridge, static_argnums=3)
predicted = jax.jit(lambda found, z: found(z))


def waves(n: int, seed: int, noise: float = 0.05):
    """Parameters of a wave over a wide prior, and numbers that are far from linear in them."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-1, 1, (n, 2))
    times = np.linspace(0, 6, 30)
    x = np.cos((2 + theta[:, :1]) * times) + np.exp(-0.3 * (1.1 + theta[:, 1:]) * times)
    return theta.astype(np.float32), (x + noise * rng.normal(size=x.shape)).astype(np.float32)


def gram(a, b, squared_length):
    """The kernel matrix, from differences."""
    distances = ((a[:, None] - b[None]) ** 2).sum(-1)
    return np.exp(-distances / (2 * squared_length)) + 1 + a @ b.T / a.shape[1]


def fitted_to(rows, y, squared_length, penalty):
    """A function that predicts new rows by a regression on these rows."""
    mean = y.mean()
    weights = np.linalg.solve(gram(rows, rows, squared_length) + penalty * np.eye(len(rows)), y - mean)
    return lambda z: mean + gram(z, rows, squared_length) @ weights


def without_each(rows, y, squared_length, penalty):
    """Mean squared error of predicting each row by a regression on the others, with the same mean."""
    errors = []
    for row in range(len(rows)):
        others = np.arange(len(rows)) != row
        matrix = gram(rows[others], rows[others], squared_length) + penalty * np.eye(others.sum())
        weights = np.linalg.solve(matrix, (y - y.mean())[others])
        errors.append((y[row] - y.mean() - gram(rows[[row]], rows[others], squared_length)[0] @ weights) ** 2)
    return np.mean(errors)


def test_length_and_penalty_are_those_with_the_least_error_of_rows_left_out():
    theta, x = waves(60, 0)
    counted = np.arange(60) < 55
    found, own = regressed(jnp.asarray(x), jnp.asarray(theta), jnp.asarray(counted), 60)
    rows, new = x[counted].astype(float), waves(40, 1)[1].astype(float)
    spread = 2 * rows.var(axis=0).sum()
    for d in range(2):
        y = theta[counted, d].astype(float)
        errors = {
            (length, penalty): without_each(rows, y, length * spread, penalty)
            for length in LENGTHS.tolist()
            for penalty in PENALTIES.tolist()
        }
        length, penalty = min(errors, key=lambda pair: errors[pair])
        np.testing.assert_allclose(found.squared_length[d], length * spread, rtol=1e-4)
        expected = fitted_to(rows, y, length * spread, penalty)(new)
        np.testing.assert_allclose(np.asarray(predicted(found, jnp.asarray(new)))[:, d], expected, atol=3e-3)
        folds = np.arange(55) % FOLDS
        for fold in range(FOLDS):
            mean, kept = y.mean(), folds != fold
            matrix = gram(rows[kept], rows[kept], length * spread) + penalty * np.eye(kept.sum())
            weights = np.linalg.solve(matrix, y[kept] - mean)
            by_others = mean + gram(rows[~kept], rows[kept], length * spread) @ weights
            np.testing.assert_allclose(np.asarray(own)[:55][~kept, d], by_others, atol=3e-3)


def test_more_rows_than_it_can_use_leave_the_last_ones_and_the_others_are_new_to_it():
    theta, x = waves(90, 2)
    counted = np.arange(90) < 80
    found, own = regressed(jnp.asarray(x), jnp.asarray(theta), jnp.asarray(counted), 50)
    alone, own_alone = regressed(jnp.asarray(x[30:80]), jnp.asarray(theta[30:80]), jnp.ones(50, bool), 50)
    np.testing.assert_array_equal(found.rows, x[30:80])
    np.testing.assert_allclose(found.weights, alone.weights, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(own[30:80], own_alone, atol=1e-3)
    np.testing.assert_allclose(own[:30], predicted(alone, jnp.asarray(x[:30])), atol=1e-3)


def test_parameters_in_other_units_are_predicted_in_them():
    theta, x = waves(100, 3)
    every, scale, shift = jnp.ones(100, bool), jnp.asarray([3.0, 0.2]), jnp.asarray([-7.0, 1.0])
    own = regressed(jnp.asarray(x), jnp.asarray(theta), every, 100)[1]
    other = regressed(jnp.asarray(x), scale * theta + shift, every, 100)[1]
    np.testing.assert_allclose(other, scale * own + shift, atol=5e-3)


def test_without_rows_nothing_is_predicted():
    found, own = regressed(jnp.ones((20, 3)), jnp.ones((20, 2)), jnp.zeros(20, bool), 20)
    np.testing.assert_array_equal(own, 0)
    np.testing.assert_array_equal(predicted(found, jnp.ones((4, 3))), 0)
    np.testing.assert_array_equal(predicted(unfitted_kernel(5, 3, 2), jnp.ones((4, 3))), 0)


@pytest.mark.slow  # both regressions have oracles of their own
def test_over_a_whole_prior_features_by_kernels_tell_more_than_those_by_lines():
    """On new simulations; from raw numbers, kernels leave a third of what linear features with products leave."""
    theta, x = waves(700, 4)
    new, seen = waves(300, 5)
    every = jnp.ones(700, bool)
    given = jnp.asarray(theta), jnp.asarray(x), every, every
    unexplained = {}
    for kind, before in ((Regression, unfitted(2, 30, 1)), (KernelRegression, unfitted_kernels(2, 30, 1, 700))):
        found, own = jax.jit(kind.fitted)(before, *given)
        features = np.asarray(jax.jit(lambda found: found(jnp.asarray(seen)))(found))
        predictions = [0, 1, 2, 3] if kind is Regression else [0, 1, 4, 5]  # from numbers and from statistics
        features, own = features[:, predictions], np.asarray(own)[:, predictions]
        share = lambda f, of: np.array([1 - np.corrcoef(f[:, d], of[:, d % 2])[0, 1] ** 2 for d in range(4)])
        unexplained[kind] = share(features, new)
        np.testing.assert_allclose(share(np.asarray(own), theta), unexplained[kind], rtol=0.5)
    assert np.all(unexplained[KernelRegression][:2] < unexplained[Regression][:2] / 3)
    assert np.all(unexplained[KernelRegression] < unexplained[Regression])


@pytest.mark.slow  # test_ridge.py tests the Gaussian that it starts from
def test_a_flow_of_features_starts_as_wide_as_the_parameters_are_uncertain_at_each_summary():
    """Before any training, for parameters a and -a with errors of 0.05 exp(b) and 0.1, and a summary (a, b)."""
    rng = np.random.default_rng(6)
    x = rng.normal(size=(1000, 2)).astype(np.float32)
    widths = lambda x: np.stack([0.05 * np.exp(x[:, 1]), np.full(len(x), 0.1)], axis=1)
    theta = np.stack([x[:, 0], -x[:, 0]], axis=1) + widths(x) * rng.normal(size=(1000, 2))
    estimator = SplineFlow(
        hidden=(8,),
        transforms=2,
        regression=1,
        reduction="regression",
        regressor="kernel",
        short_summary=0,
        record_size=2,
        warm_start=False,
    )
    box, space = Support(-4 * jnp.ones(2), 4 * jnp.ones(2)), Space(("a", "b"), (False, False))
    rows = jnp.asarray(theta, jnp.float32), jnp.asarray(x), jnp.zeros(1000, jnp.int32), jnp.ones(1000)
    dataset = Dataset(*rows, jnp.asarray(1000))

    @jax.jit
    def begun(key):
        network = untrained(key, estimator, 2, box, space, rows=1000)
        return network.restarted(jax.random.key(1), dataset)[0]

    network = begun(jax.random.key(0))
    assert estimator.inputs(2, 2) == 4
    draw = jax.jit(jax.vmap(lambda x: estimator.density(network, x).sample(jax.random.key(2), 4000)))
    at = np.array([[0.5, 1.0], [0.5, -1.0], [-1.0, 0.0]], np.float32)
    draws = np.asarray(draw(at))
    np.testing.assert_allclose(draws.mean(1), np.stack([at[:, 0], -at[:, 0]], axis=1), atol=0.06)
    ratio = draws.std(1) / widths(at)
    assert np.all((ratio > 0.8) & (ratio < 1.7))  # small errors are overestimated: penalties shrink to the mean
    assert draws.std(1)[0, 0] > 4 * draws.std(1)[1, 0]  # the exact ratio is exp(2) = 7.4
