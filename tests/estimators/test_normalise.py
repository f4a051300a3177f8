"""Normalisers, against NumPy over the valid rows, and invariance to units and offsets of a summary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.estimators.normaliser import (
    LINEAR,
    TRANSFORMS,
    Normaliser,
    fit_normaliser,
    identity,
    some_rows,
    standardiser,
)
from tests.strategies import vectors

NUMPY = {"zscore": lambda x: x, "asinh": np.arcsinh}
ROWS = 400
DRAWN = {
    "normal": lambda g: g.normal(50.0, 2.0, ROWS),
    "uniform": lambda g: g.uniform(-10.0, 10.0, ROWS),
    "upwards": lambda g: g.lognormal(0.0, 2.0, ROWS),
    "downwards": lambda g: -g.lognormal(0.0, 2.0, ROWS),
    "both sides": lambda g: g.standard_cauchy(ROWS),
    "counts": lambda g: g.poisson(3.0, ROWS).astype(float),
    "often zero": lambda g: np.where(g.uniform(size=ROWS) < 0.3, 0.0, g.lognormal(3.0, 2.0, ROWS)),
}
fit = jax.jit(fit_normaliser, static_argnums=(0, 3))


def drawn(name, seed=0):
    return DRAWN[name](np.random.default_rng(seed))


def seen(name, x):
    """A summary as a network's input, in single precision throughout; all rows count."""
    x = jnp.asarray(x, jnp.float32)[:, None]
    return np.asarray(fit(name, x, jnp.ones(len(x), bool))(x))[:, 0]


def test_all_transforms_are_tested():
    assert set(TRANSFORMS) == {*NUMPY, "none"}


@pytest.mark.parametrize("name", NUMPY)
@given(x=vectors(-50.0, 900.0, 12, 3), size=st.integers(1, 12), junk=st.sampled_from([0.0, 1e30, np.nan, np.inf]))
def test_against_numpy_over_valid_rows_only(name, x, size, junk):
    filled = x.copy()
    filled[size:] = junk
    normaliser = fit(name, jnp.asarray(filled), jnp.arange(12) < size)
    origin, unit = np.asarray(normaliser.origin, float), np.asarray(normaliser.unit, float)
    assert (unit > 0).all() and (normaliser.scale > 0).all()
    values = NUMPY[name]((x[:size] - origin) / unit)
    np.testing.assert_allclose(normaliser.mean, values.mean(0), rtol=1e-4, atol=1e-4 * np.abs(values).max() + 1e-30)
    for d in range(3):
        if np.ptp(x[:size, d]) > 1e-3 * np.abs(x[:size, d]).max():
            np.testing.assert_allclose(normaliser.scale[d], values[:, d].std(), rtol=1e-2)
        elif np.ptp(x[:size, d]) == 0:
            assert normaliser.scale[d] == np.inf


@pytest.mark.parametrize("name", NUMPY)
@given(
    kind=st.sampled_from(sorted(DRAWN)),
    power=st.integers(-12, 12),
    sign=st.sampled_from([-1, 1]),
    digits=st.integers(0, 3),
    seed=st.integers(0, 9),
)
def test_neither_unit_nor_offset_of_a_summary_changes_what_a_network_sees(name, kind, power, sign, digits, seed):
    """The offset has `digits` digits more than the spread of most values; single precision leaves four for that."""
    x = drawn(kind, seed)
    middle = np.subtract(*np.quantile(x, [0.75, 0.25]))
    plain = seen(name, x)
    other = seen(name, 10.0**power * sign * x)
    np.testing.assert_allclose(other, sign * plain, atol=2e-3 * np.abs(plain).max())
    moved = seen(name, 10.0**power * (x + 10.0**digits * middle))
    inner = np.argsort(x)[ROWS // 8 : -ROWS // 8]  # a rounded offset may swap close values at a sharp end
    assert np.corrcoef(moved, plain)[0, 1] > 0.99
    np.testing.assert_allclose(moved[inner], plain[inner], atol=0.05)


def test_normalised_rows_have_zero_mean_and_unit_spread():
    x = np.random.default_rng(0).normal([1.0, -200.0], [0.1, 30.0], (40, 2)).astype(np.float32)
    normaliser = fit("zscore", jnp.asarray(x), jnp.ones(40, bool))
    z = np.asarray(normaliser(jnp.asarray(x)))
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(z.std(0), 1, rtol=1e-4)
    assert np.corrcoef(z[:, 0], x[:, 0])[0, 1] > 0.999


@pytest.mark.parametrize("name", NUMPY)
@pytest.mark.parametrize("value", [0.0, 7.1, -1e-12, 101325.0, 3e12])
def test_a_summary_that_does_not_vary_says_nothing_whatever_is_observed(name, value):
    rounding = value * np.array([1.0, 1 + 1e-7, 1.0, 1 - 1e-7, 1.0])
    x = jnp.asarray(np.stack([rounding, np.arange(5.0)], axis=1), jnp.float32)
    normaliser = fit(name, x, jnp.ones(5, bool))
    for observed in (value, value + 10, -1e20):
        z = np.asarray(normaliser(jnp.array([observed, 4.0])))
        assert z[0] == 0 and abs(z[1]) > 1


def test_none_changes_nothing():
    x = jnp.array([[5.0, -1.0], [9.0, 4.0]])
    normaliser = fit("none", x, jnp.ones(2, bool))
    np.testing.assert_array_equal(normaliser(x), x)


def test_a_normaliser_is_a_pytree_that_knows_its_transform():
    normaliser = Normaliser(*jnp.array([[1.0], [2.0]]), "asinh", *jnp.array([[5.0], [4.0]]))
    assert [leaf.shape for leaf in jax.tree.leaves(normaliser)] == [(1,)] * 4
    doubled = jax.tree.map(lambda leaf: 2 * leaf, normaliser)
    assert doubled.name == "asinh"
    x = jnp.array([[3.0]])
    np.testing.assert_allclose(normaliser(x), (np.arcsinh((3.0 - 5.0) / 4.0) - 1.0) / 2.0, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda n, x: n(x))(doubled, x), doubled(x), rtol=1e-6)


@pytest.mark.parametrize("name", TRANSFORMS)
def test_no_rows_at_all_leave_summaries_as_they_are(name):
    normaliser = fit(name, jnp.full((3, 2), jnp.nan), jnp.zeros(3, bool))
    assert jax.tree.structure(normaliser) == jax.tree.structure(identity(2, name))
    for leaf, expected in zip(jax.tree.leaves(normaliser), jax.tree.leaves(identity(2, name)), strict=True):
        np.testing.assert_array_equal(leaf, expected)


@pytest.mark.parametrize("kind", sorted(set(DRAWN) - {"often zero"}))
def test_origin_and_unit_are_median_and_median_absolute_deviation(kind):
    x = drawn(kind).astype(np.float32)
    some = np.asarray(some_rows(jnp.asarray(x[:, None]), jnp.ones(ROWS, bool)), float)[:, 0]
    found = fit("asinh", jnp.asarray(x[:, None]), jnp.ones(ROWS, bool))
    median = np.quantile(some, 0.5, method="lower")
    np.testing.assert_allclose(found.origin[0], median, rtol=1e-6)
    deviation = np.quantile(np.abs(some - median), 0.5, method="lower")
    np.testing.assert_allclose(found.unit[0], LINEAR * deviation, rtol=1e-5)
    np.testing.assert_allclose(deviation, stats.median_abs_deviation(x), rtol=0.4)


def test_where_most_values_are_equal_the_mean_deviation_is_the_unit():
    x = jnp.asarray([0.0] * 70 + [4.0] * 30)[:, None]
    np.testing.assert_allclose(fit("asinh", x, jnp.ones(100, bool)).unit, LINEAR * 1.2, rtol=0.1)


@pytest.mark.parametrize("kind", ["upwards", "downwards", "both sides"])
def test_tails_of_many_orders_of_magnitude_stay_within_a_few_deviations(kind):
    x = drawn(kind)
    values = seen("asinh", x)
    assert np.abs(values).max() < 8 < 0.9 * np.abs(stats.zscore(x)).max()
    # The middle of the values is neither squeezed into a point nor blown up.
    assert 0.2 < np.diff(np.quantile(values, [0.25, 0.75]))[0] < 2


def test_what_has_no_tails_stays_nearly_linear():
    x = drawn("uniform")
    assert np.corrcoef(x, seen("asinh", x))[0, 1] > 0.995


def test_rows_are_chosen_evenly_among_the_valid_ones_whatever_their_period():
    valid = np.arange(1000) % 3 == 0
    rows = np.asarray(some_rows(jnp.arange(1000.0)[:, None], jnp.asarray(valid)))[:, 0]
    assert valid[rows.astype(int)].all()
    assert stats.kstest(rows / 1000, "uniform").statistic < 0.02
    assert len(np.unique(rows // 3 % 8)) == 8


def test_records_have_one_normaliser():
    x = jnp.asarray(np.random.default_rng(1).lognormal(0.0, 1.0, (30, 6)), jnp.float32)
    normaliser = fit("asinh", x, jnp.ones(30, bool), 2)
    for leaf in jax.tree.leaves(normaliser):
        np.testing.assert_array_equal(leaf, np.tile(leaf[:2], 3))


def test_parameters_are_standardised_also_where_they_do_not_vary():
    values = jnp.array([[0.5, -0.2], [0.5, 0.4], [9.0, 9.0]])
    normaliser = standardiser(values, jnp.array([True, True, False]))
    np.testing.assert_allclose(normaliser.mean, [0.5, 0.1], rtol=1e-6)
    np.testing.assert_allclose(normaliser.scale, [1.0, 0.3], rtol=1e-6)
