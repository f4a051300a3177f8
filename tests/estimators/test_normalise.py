"""Normalisers, against NumPy over the valid rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.estimators.normaliser import TRANSFORMS, Normaliser, fit_normaliser
from tests.strategies import vectors

NUMPY = {"zscore": lambda x: x, "asinh": np.arcsinh}


def test_all_transforms_are_tested():
    assert set(TRANSFORMS) == {*NUMPY, "none"}


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
