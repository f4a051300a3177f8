"""Normalisers, against NumPy over the valid rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.estimators.normaliser import TRANSFORMS, UNITS, Normaliser, fit_normaliser
from tests.strategies import vectors

NUMPY = {"zscore": lambda x: x, "asinh": np.arcsinh}


def test_all_transforms_are_tested():
    assert set(TRANSFORMS) == {*NUMPY, "none", "fitted-asinh"}


@pytest.mark.parametrize("name", NUMPY)
@given(x=vectors(-50.0, 900.0, 12, 3), size=st.integers(1, 12), junk=st.sampled_from([0.0, 1e30, np.nan, np.inf]))
def test_against_numpy_over_valid_rows_only(name, x, size, junk):
    values = NUMPY[name](x[:size].astype(np.float64))
    mean, scale = values.mean(0), values.std(0)
    filled = x.copy()
    filled[size:] = junk
    normaliser = fit_normaliser(name, jnp.asarray(filled), jnp.arange(12) < size)
    np.testing.assert_allclose(normaliser.mean, mean, rtol=1e-5, atol=1e-4)
    for d in range(3):
        if scale[d] > 1e-3 * (1 + abs(mean[d])):
            np.testing.assert_allclose(normaliser.scale[d], scale[d], rtol=1e-2)
        elif scale[d] == 0:
            # A constant summary is centred only (rounding of the mean may leave a residue, but no division by
            # it).
            assert float(normaliser.scale[d]) == 1.0
    assert bool(jnp.all(normaliser.scale > 0))


def test_normalised_rows_have_zero_mean_and_unit_spread():
    x = np.random.default_rng(0).normal([1.0, -200.0], [0.1, 30.0], (40, 2)).astype(np.float32)
    normaliser = fit_normaliser("zscore", jnp.asarray(x), jnp.ones(40, bool))
    z = np.asarray(normaliser(jnp.asarray(x)))
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(z.std(0), 1, rtol=1e-4)
    assert np.corrcoef(z[:, 0], x[:, 0])[0, 1] > 0.999


def test_a_constant_summary_is_centred_only():
    x = jnp.stack([jnp.full(5, 7.0), jnp.arange(5.0)], axis=1)
    normaliser = fit_normaliser("zscore", x, jnp.ones(5, bool))
    np.testing.assert_allclose(normaliser.scale, [1.0, np.sqrt(2.0)], rtol=1e-6)
    np.testing.assert_allclose(normaliser(jnp.array([9.0, 2.0])), [2.0, 0.0], atol=1e-6)


def test_asinh_is_applied_before_centring():
    normaliser = Normaliser(jnp.array([1.0, 0.0]), jnp.array([2.0, 1.0]), "asinh")
    x = jnp.array([1e6, -3.0])
    expected = [(np.arcsinh(1e6) - 1) / 2, -np.arcsinh(3.0)]
    np.testing.assert_allclose(normaliser(x), expected, rtol=1e-6)


def test_none_changes_nothing():
    x = jnp.array([[5.0, -1.0], [9.0, 4.0]])
    normaliser = fit_normaliser("none", x, jnp.ones(2, bool))
    np.testing.assert_array_equal(normaliser(x), x)


def test_a_normaliser_is_a_pytree_that_knows_its_transform():
    normaliser = fit_normaliser("asinh", jnp.array([[5.0], [9.0]]), jnp.ones(2, bool))
    assert [leaf.shape for leaf in jax.tree.leaves(normaliser)] == [(1,), (1,)]
    doubled = jax.tree.map(lambda leaf: 2 * leaf, normaliser)
    assert doubled.name == "asinh"
    x = jnp.array([[3.0]])
    np.testing.assert_allclose(jax.jit(lambda n, x: n(x))(doubled, x), doubled(x), rtol=1e-6)
    np.testing.assert_allclose(doubled(x), (np.arcsinh(3.0) - doubled.mean[None]) / doubled.scale, rtol=1e-6)


def test_no_rows_at_all_leave_summaries_as_they_are():
    normaliser = fit_normaliser("zscore", jnp.full((3, 2), 5.0), jnp.zeros(3, bool))
    np.testing.assert_array_equal(normaliser.mean, [0, 0])
    np.testing.assert_array_equal(normaliser.scale, [1, 1])


def log_likelihood(x, unit):
    """Of one summary's values, as normal variables after asinh, up to a constant: density by change of variables."""
    values = np.arcsinh(x / unit)
    density = stats.norm(values.mean(), values.std()).logpdf(values) - 0.5 * np.log(unit**2 + x**2)
    return density.mean()


TAILS = {
    "normal": lambda g: g.normal(50.0, 2.0, 400),
    "uniform": lambda g: g.uniform(-10.0, 10.0, 400),
    "positive": lambda g: g.lognormal(0.0, 2.0, 400),
    "both sides": lambda g: g.standard_cauchy(400),
}


@pytest.mark.parametrize("name", TAILS)
@pytest.mark.parametrize("factor", [1.0, 1e-4, 1e5])
def test_the_unit_of_asinh_is_the_likeliest_whatever_the_units_of_a_summary(name, factor):
    x = factor * TAILS[name](np.random.default_rng(0))
    filled = np.concatenate([x, np.full(100, np.nan)]).astype(np.float32)
    found = fit_normaliser("fitted-asinh", jnp.asarray(filled[:, None]), jnp.arange(500) < 400)
    units = np.median(np.abs(x)) * UNITS
    best = max(log_likelihood(x, unit) for unit in units)
    np.testing.assert_allclose(log_likelihood(x, float(found.unit[0])), best, atol=1e-3)
    seen = np.asarray(found(jnp.asarray(filled[:400, None])))[:, 0]
    expected = np.arcsinh(x / float(found.unit[0]))
    np.testing.assert_allclose(seen, (expected - expected.mean()) / expected.std(), atol=2e-3)
    tails = found.unit[0] / np.median(np.abs(x))
    assert tails >= 10 if name in ("normal", "uniform") else tails < 5


def test_a_fitted_unit_survives_summaries_that_do_not_vary_and_no_rows():
    for x, valid in [(jnp.zeros((5, 1)), jnp.ones(5, bool)), (jnp.full((5, 1), jnp.nan), jnp.zeros(5, bool))]:
        normaliser = fit_normaliser("fitted-asinh", x, valid)
        np.testing.assert_array_equal(normaliser(jnp.zeros(1)), 0)
        assert np.isfinite(normaliser(jnp.ones(1))).all()


def test_records_have_one_fitted_unit():
    x = jnp.asarray(np.random.default_rng(1).lognormal(0.0, 1.0, (30, 6)), jnp.float32)
    unit = np.asarray(fit_normaliser("fitted-asinh", x, jnp.ones(30, bool), record_size=2).unit)
    np.testing.assert_array_equal(unit, np.tile(unit[:2], 3))
