"""The inputs of networks and regressions for long summaries, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.bayessim.presets import QUICK
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.averages import (
    LONG,
    MOST,
    MOST_CHANNELS,
    as_series,
    seen,
    seen_channels,
    seen_size,
    shrunk,
)
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.inverse_regression import inverse_regression
from jaxlfi.estimators.regression import Regression, features_size, unfitted
from jaxlfi.estimators.robust_estimates import robust_estimates

LAYOUTS = [(1, 40), (1, 512), (1, 513), (1, 4001), (4, 1000), (40, 14), (64, 64), (600, 1), (1000, 12)]
"""Numbers of channels and records."""


def means(values, axis, most):
    """Means of neighbours along an axis, as a loop over groups of equal size; the last group may be smaller."""
    size = values.shape[axis]
    each = -(-size // most)
    groups = [np.take(values, range(first, min(first + each, size)), axis) for first in range(0, size, each)]
    return np.stack([group.mean(axis) for group in groups], axis)


@pytest.mark.parametrize(("channels", "records"), LAYOUTS)
def test_means_of_neighbours(channels, records):
    obs = channels * records
    x = np.random.default_rng(0).normal(size=(3, obs))
    found = np.asarray(seen(jnp.asarray(x, jnp.float32), channels))
    series = x.reshape(3, records, channels)
    if obs > LONG:
        series = means(series, 2, MOST_CHANNELS)
        assert as_series(jnp.asarray(x), channels).shape == series.shape
        series = means(series, 1, MOST // series.shape[2])
    assert found.shape == (3, seen_size(obs, channels)) and found.shape[1] <= (MOST if obs > LONG else obs)
    assert series.shape[2] == seen_channels(obs, channels)
    np.testing.assert_allclose(found, series.reshape(3, -1), atol=1e-5)


@pytest.mark.parametrize(("channels", "records"), [(1, 2000), (3, 400), (64, 64)])
def test_features_of_a_long_summary_cost_no_more_than_those_of_a_short_one(channels, records):
    """No decomposed matrix has a side as long as the summary: the largest has the rows by the models' predictors."""
    obs, rows = channels * records, 300
    regression = unfitted(2, obs, channels)
    few = seen_size(obs, channels)
    assert regression.coefficients.shape[0] == features_size(2, obs, channels) == 6
    assert regression.coefficients.shape[1] < 2 * few + 40 * 2 * MOST_CHANNELS + 40
    given = (jnp.zeros((rows, 2)), jnp.zeros((rows, obs)), jnp.ones(rows, bool), jnp.ones(rows, bool))
    program = jax.make_jaxpr(Regression.fitted)(regression, *given)
    largest = [var.aval.size for one in equations(program.jaxpr) if one.primitive.name == "svd" for var in one.invars]
    assert largest and max(largest) <= rows * (few + 40 * 2 * MOST_CHANNELS + 40)


def equations(jaxpr):
    """The equations of a program and of the programs within it."""
    for one in jaxpr.eqns:
        yield one
        for inner in jax.core.jaxprs_in_params(one.params):
            yield from equations(inner)


def test_networks_see_means_and_features():
    box, obs = Support(jnp.zeros(2), jnp.ones(2)), 4096
    estimator = QUICK.estimator.for_layout((obs // 4, 4))
    network = untrained(jax.random.key(0), estimator, obs, box, Space(("a", "b"), (False, False)))
    given = network.given(jnp.ones((5, obs)))
    assert given.shape == (5, MOST + 6) == (5, estimator.inputs(2, obs))
    numbers, features = np.split(np.asarray(estimator.views(2, obs)) > 0, [MOST], axis=1)
    np.testing.assert_array_equal(numbers.all(axis=1), ~features.any(axis=1))
    assert numbers[0].all() and features[1:].all()
    plain = estimator.replace(reduction="none", record_size=0)
    assert plain.inputs(2, obs) == obs  # as in the paper


def test_what_errors_alone_would_explain_is_taken_back():
    rng = np.random.default_rng(0)
    rows, errors = 400, np.geomspace(0.1, 10, 3001)
    true = np.zeros((2, 3001))
    true[:, :320] = 0.7 * errors[:320] / np.sqrt(rows) * rng.normal(size=(2, 320))  # smaller than the noise of others
    true[:, 480:500] = errors[480:500] / np.sqrt(rows) * rng.normal(9, 1, (2, 20))
    found = true + errors / np.sqrt(rows) * rng.normal(size=(2, 3001))
    kept = np.asarray(shrunk(jnp.asarray(found), jnp.asarray(errors), rows))
    assert kept.shape == found.shape
    np.testing.assert_allclose(kept[:, 480:496], found[:, 480:496], rtol=0.05)
    wrong = lambda guess, where: np.sum(((guess - true) / errors)[:, where] ** 2)
    for where, gain in ((slice(0, 320), 0.5), (slice(496, None), 0.1)):
        assert wrong(kept, where) < gain * wrong(found, where)
    best = 0.49 / 1.49  # shrinkage to the posterior means for responses of one size
    assert wrong(kept, slice(0, 320)) < 1.3 * wrong(best * found, slice(0, 320))


@pytest.mark.parametrize(("model", "numbers"), [(inverse_regression, 2000), (robust_estimates, 800)])
def test_estimates_from_many_numbers_of_which_few_tell(model, numbers):
    """Estimates for a linear model with independent errors, against its exact posterior means."""
    rng = np.random.default_rng(0)
    response = np.zeros((2, numbers))
    response[:, 700:720] = rng.normal(size=(2, 20))
    theta = rng.normal(size=(900, 2))
    x = theta @ response + 2 * rng.normal(size=(900, numbers))
    exact = x @ response.T @ np.linalg.inv(response @ response.T + 4 * np.eye(2))
    fitted, new = slice(0, 300), slice(300, None)
    single = lambda values: jnp.asarray(values, jnp.float32)
    found, *_ = jax.jit(model)(single(x[fitted]), single(theta[fitted]), jnp.ones(300, bool))
    estimates = np.asarray(jax.jit(lambda model, z: model(z))(found, single(x[new])))[:, :2]
    away = lambda guess: np.std(theta[new] - guess * (guess * theta[new]).mean(0) / (guess**2).mean(0), axis=0)
    assert np.all(away(estimates) < 1.2 * away(exact[new]))
