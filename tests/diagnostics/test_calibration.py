"""Calibration: ranks by hand, bands against SciPy, and laws that a calibrated posterior keeps and others break."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi import diagnostics
from jaxlfi.diagnostics import (
    OK,
    SIGNIFICANCE,
    coverage_verdict,
    distance_verdict,
    histogram,
    ranks_verdict,
    uniformity,
)
from jaxlfi.diagnostics import calibration as module

ranks, density_ranks, distance_ranks = (
    jax.jit(function) for function in (module.ranks, module.density_ranks, module.distance_ranks)
)
LOW, HIGH = np.array([-9.0, -14.0]), np.array([9.0, 16.0])
SCALE = np.array([0.5, 2.0])


# ------------------------------------------------------------------------------------------------------- ranks


def test_ranks_count_the_draws_below():
    truths = np.array([[2.5, 0.0], [0.0, 9.0]])
    draws = np.array([[[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]], [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]])
    np.testing.assert_array_equal(ranks(jax.random.key(0), truths, draws), [[2, 0], [0, 3]])


def test_ties_are_broken_at_random_and_ranks_stay_uniform():
    """Truths and draws clipped to one bound: half of all are equal to it."""
    rng = np.random.default_rng(0)
    truths, draws = np.maximum(rng.normal(size=(4000, 1)), 0), np.maximum(rng.normal(size=(4000, 9, 1)), 0)
    rank = np.asarray(ranks(jax.random.key(1), truths, draws))[:, 0]
    assert stats.chisquare(np.bincount(rank, minlength=10)).pvalue > 1e-3
    without = np.sum(draws[:, :, 0] < truths, axis=1)
    assert stats.chisquare(np.bincount(without, minlength=10)).pvalue < 1e-10


def test_density_ranks_count_the_draws_of_higher_density():
    truth, log_prob = jnp.array([-1.0, 5.0, -jnp.inf]), jnp.array([[0.0, -2.0, 3.0]] * 3)
    np.testing.assert_array_equal(density_ranks(jax.random.key(0), truth, log_prob), [2, 0, 3])


def test_distance_ranks_are_in_units_of_the_box():
    """The first side is a thousand times the second: with plain distances only the first would count."""
    low, high = np.array([0.0, 0.0]), np.array([1000.0, 1.0])
    truths = np.tile([500.0, 0.99], (500, 1))
    draws = np.tile([[[500.0, 0.5], [501.0, 0.5], [499.0, 0.5]]], (500, 1, 1))
    rank = np.asarray(distance_ranks(jax.random.key(0), truths, draws, low, high))
    # The draws are nearer to a point nearer to their side of the box: below 0.745, for three of four points.
    assert np.mean(rank == 3) == pytest.approx(0.745, abs=0.06) and np.mean(rank == 0) > 0.2


@pytest.mark.parametrize(("truths", "draws"), [((5, 2), (5, 9)), ((5, 2), (4, 9, 2)), ((5,), (5, 9, 1))])
def test_shapes_that_do_not_fit_are_refused(truths, draws):
    with pytest.raises(Exception, match=r"expected shapes|beartype|Float"):
        ranks(jax.random.key(0), np.zeros(truths), np.zeros(draws))


def test_whole_numbers_have_uniform_ranks_of_all_kinds():
    """Ties of values, of densities and of distances are shared out: an exact discrete posterior passes every check."""
    rng = np.random.default_rng(0)
    probability = np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    truths = rng.choice(5, (600, 2), p=probability)
    draws = rng.choice(5, (600, 30, 2), p=probability)
    density = lambda values: np.log(probability[values]).sum(-1)
    found = [
        *np.asarray(diagnostics.ranks(jax.random.key(0), truths, draws)).T,
        diagnostics.density_ranks(jax.random.key(1), density(truths), density(draws)),
        diagnostics.distance_ranks(jax.random.key(2), truths, draws, np.full(2, -0.5), np.full(2, 4.5)),
    ]
    for rank in found:
        assert stats.chisquare(np.bincount(rank, minlength=31)).pvalue > 1e-3
        assert uniformity(rank, 30).p_value > 1e-3


def test_known_numbers_are_compared_in_their_own_precision():
    """In single precision draws at such an offset would all be the same."""
    rng = np.random.default_rng(1)
    truths, draws = rng.normal(size=(300, 1)), 0.3 * rng.normal(size=(300, 50, 1))
    here, there = (np.asarray(diagnostics.ranks(jax.random.key(0), s + truths, s + draws)) for s in (0.0, 1e9))
    np.testing.assert_array_equal(here, there)
    box = np.array([[-4.0], [4.0]])
    here, there = (diagnostics.distance_ranks(jax.random.key(0), s + truths, s + draws, *(s + box)) for s in (0.0, 1e9))
    assert np.mean(np.asarray(here) == np.asarray(there)) > 0.98


GOOD = {
    "ranks": (np.arange(6.0).reshape(3, 2), np.arange(60.0).reshape(3, 10, 2)),
    "density_ranks": (np.arange(3.0), np.arange(30.0).reshape(3, 10)),
    "distance_ranks": (np.arange(6.0).reshape(3, 2), np.arange(60.0).reshape(3, 10, 2), np.zeros(2), np.full(2, 60.0)),
}


@pytest.mark.parametrize("name", GOOD)
def test_what_has_no_rank_is_refused(name):
    good = GOOD[name]
    kind = lambda *arrays: getattr(diagnostics, name)(jax.random.key(0), *arrays)
    assert kind(*good).shape[0] == 3
    for place in range(len(good)):
        spoilt = [array.copy() for array in good]
        spoilt[place][..., -1] = np.nan
        with pytest.raises(ValueError, match="expected"):
            kind(*spoilt)
        with pytest.raises(Exception, match=r"expected|beartype|Float"):
            kind(*good[:place], good[place][:0], *good[place + 1 :])
    spoilt = [array.copy() for array in good]
    spoilt[1][1] = np.nan
    rank = np.asarray(jax.jit(getattr(diagnostics, name))(jax.random.key(0), *spoilt)).reshape(3, -1)
    assert np.all(rank[1] < 0) and np.all(rank[::2] >= 0)  # which no verdict is drawn from
    if name != "density_ranks":  # a uniform posterior has one density
        with pytest.raises(ValueError, match="draws that vary"):
            kind(np.ones((3, 2)), np.ones((3, 10, 2)), *good[2:])
    if name == "distance_ranks":
        with pytest.raises(ValueError, match="low < high"):
            kind(*good[:2], np.zeros(2), np.zeros(2))


# -------------------------------------------------------------------------------------------- bands and p-values


def test_the_pointwise_band_is_binomial():
    result = uniformity(np.zeros(60, int), 19)
    np.testing.assert_allclose(result.level, np.arange(1, 20) / 20)
    for level, low, high in zip(result.level, *result.pointwise, strict=True):
        binomial = stats.binom(60, level)
        counts = np.arange(61)
        inside = counts[2 * np.minimum(binomial.cdf(counts), binomial.sf(counts - 1)) > 0.05]
        np.testing.assert_allclose([low, high], [inside.min() / 60, inside.max() / 60])


def test_histogram_of_ranks():
    rank = np.array([0, 0, 4, 5, 9, 9] * 10)
    bars = histogram(rank, 9)
    assert bars.edges.tolist() == [0, 2, 3, 5, 7, 8, 10]  # ten ranks in six bins
    assert bars.count.tolist() == [20, 0, 10, 10, 0, 20]
    np.testing.assert_allclose(bars.expected, 60 * np.diff(bars.edges) / 10)
    low, high = bars.band[:, 0]
    assert stats.binom(60, 0.2).cdf(low - 1) <= 0.025 < stats.binom(60, 0.2).cdf(low)
    assert stats.binom(60, 0.2).sf(high) <= 0.025 < stats.binom(60, 0.2).sf(high - 1)


@pytest.mark.parametrize(("count", "draws"), [(20, 20), (100, 200), (300, 50)])
def test_the_p_value_of_calibrated_ranks_is_what_it_says(count, draws):
    rng = np.random.default_rng(count)
    results = [uniformity(rng.integers(0, draws + 1, count), draws) for _ in range(400)]
    p_values = np.array([result.p_value for result in results])
    for level in (0.05, 0.3):
        assert np.mean(p_values <= level) == pytest.approx(level, abs=0.015 + 3 * np.sqrt(level / 400))
    z = np.array([[result.shift, result.dispersion] for result in results])
    np.testing.assert_allclose(z.mean(0), 0, atol=0.2)
    np.testing.assert_allclose(z.std(0), 1, atol=0.15)


def test_the_simultaneous_band_is_the_test():
    rng = np.random.default_rng(0)
    left = []
    for scale in np.linspace(0.4, 1.6, 200):
        result = uniformity(np.floor(101 * stats.norm.cdf(scale * rng.normal(size=80))).astype(int), 100, tests=3)
        low, high = result.simultaneous
        outside = np.any((result.fraction < low - 1e-9) | (result.fraction > high + 1e-9))
        left.append((outside, result.p_value <= SIGNIFICANCE))
    outside, rejected = np.array(left).T
    np.testing.assert_array_equal(outside, rejected)
    assert 10 < rejected.sum() < 190
    once = uniformity(np.arange(80), 100)
    assert uniformity(np.arange(80), 100, tests=3).p_value == pytest.approx(3 * once.p_value)


@pytest.mark.parametrize(("rank", "draws"), [([3, 11], 10), ([-1, 3], 10), ([3], 10), ([0, 1], 1)])
def test_ranks_of_other_draws_are_refused(rank, draws):
    for judge in (uniformity, histogram):
        with pytest.raises(ValueError, match="at least two ranks from 0 to the number of draws"):
            judge(np.array(rank), draws)
    for wrong in (np.array([1.5, 2.0]), np.array([np.nan, 2.0])):
        with pytest.raises(Exception, match=r"expected|Int"):
            uniformity(wrong, 10)


# --------------------------------------------------------------------------------------------------------- laws


def verdicts(scale: float, shift: float = 0.0, seed: int = 7) -> tuple[list[str], str, str]:
    """Truths from correlated Gaussian posteriors, draws from the same but wider by `scale` and off by `shift`."""
    count, draws = 150, 100
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(count, 2)) * 2
    tril = np.array([[1.0, 0.0], [0.6, 0.8]]) * SCALE[:, None]
    truths = mean + rng.normal(size=(count, 2)) @ tril.T
    centre = mean + shift * np.array([1.0, -1.0]) * SCALE
    noise = scale * rng.normal(size=(count, draws, 2))
    samples = centre[:, None] + noise @ tril.T
    white = np.linalg.solve(tril, (truths - centre).T).T / scale
    keys = jax.random.split(jax.random.key(seed), 3)
    rank = np.asarray(ranks(keys[0], truths, samples))
    by_parameter = [ranks_verdict(uniformity(rank[:, d], draws, tests=2)) for d in range(2)]
    density = density_ranks(keys[1], -0.5 * np.sum(white**2, 1), -0.5 * np.sum((noise / scale) ** 2, 2))
    distance = distance_ranks(keys[2], truths, samples, LOW, HIGH)
    return by_parameter, coverage_verdict(uniformity(density, draws)), distance_verdict(uniformity(distance, draws))


def test_the_exact_posterior_passes():
    """Three checks each fail for 1 % of sets of draws; more than 5 failures in 25 sets have a probability of 3e-4."""
    found = [verdicts(1.0, seed=seed) for seed in range(25)]
    assert sum(one != ([OK, OK], OK, OK) for one in found) <= 5


def test_a_posterior_too_narrow_is_over_confident():
    assert verdicts(0.5) == ([module.OVER] * 2, module.OVER, module.OVER)


def test_a_posterior_too_wide_is_under_confident():
    assert verdicts(2.0) == ([module.UNDER] * 2, module.UNDER, module.UNDER)


def test_a_posterior_in_a_wrong_place_is_biased():
    by_parameter, coverage, _ = verdicts(1.0, shift=1.0)
    assert by_parameter == [module.HIGH, module.LOW]
    assert coverage == module.OVER  # the truth lies where it claims little density


def test_a_truth_outside_the_support_is_a_miss():
    """A quarter of the truths have density zero: the widest region misses them."""
    inside = np.random.default_rng(0).integers(0, 51, 150)
    truth = np.where(np.arange(200) < 50, -np.inf, 0.0)
    draws = np.where(np.arange(50) < np.append(np.full(50, 20), inside)[:, None], 1.0, -1.0)
    rank = np.asarray(density_ranks(jax.random.key(0), truth, draws))
    assert (rank[:50] == 50).all()
    assert coverage_verdict(uniformity(rank, 50)) == module.OVER
    assert uniformity(rank, 50).fraction_at(0.9) == pytest.approx(0.9 * 0.75, abs=0.06)


def test_ranks_are_the_same_compiled_and_in_a_loop():
    rng = np.random.default_rng(0)
    truths, draws = rng.normal(size=(3, 6, 3)), rng.normal(size=(3, 6, 11, 3))
    keys = lambda: jax.random.split(jax.random.key(0), 3)
    many = jax.jit(jax.vmap(module.ranks))(keys(), truths, draws)
    for i in range(3):
        np.testing.assert_array_equal(many[i], module.ranks(keys()[i], truths[i], draws[i]))
