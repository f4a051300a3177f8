"""Tempered sequential Monte Carlo, against closed forms."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from jaxlfi.bayessim.presets import METHODS, QUICK
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.tempering import STAGES, tempered

BOX = Support([-3.0, -1.0], [3.0, 2.0])
PARTICLES = 1000


@jax.jit
def run(seed, likelihood):
    """Draws of a mixture of two Gaussians truncated to the box."""
    key_start, key_draw = jax.random.split(jax.random.key(seed))
    inside = lambda theta: jnp.where(BOX.contains(theta), 0.0, -jnp.inf)
    return tempered(key_draw, BOX.sample(key_start, PARTICLES), inside, likelihood.log_prob)


def gaussians(means, deviations, weights=(0.5, 0.5)) -> GaussianMixture:
    """Two Gaussians with independent dimensions."""
    scale_tril = jnp.asarray([np.diag(scale) for scale in deviations], jnp.float32)
    return GaussianMixture(jnp.log(jnp.asarray(weights)), jnp.asarray(means, jnp.float32), scale_tril)


def masses(means, deviations) -> np.ndarray:
    """Log-mass of each Gaussian inside the box, shape [2]."""
    law = stats.norm(np.asarray(means), np.asarray(deviations))
    return np.log(law.cdf(BOX.high) - law.cdf(BOX.low)).sum(axis=1)


LOG_VOLUME = float(np.sum(np.log(BOX.width)))


SEEDS = range(4)


@pytest.mark.slow
def test_a_gaussian_beyond_a_bound_is_truncated():
    """Its mean is outside the box in one dimension, and off-centre in the other."""
    mean, scale = np.array([1.0, 2.1]), np.array([0.1, 0.3])
    found = [run(seed, gaussians([mean, mean], [scale, scale])) for seed in SEEDS]
    for each in found:
        assert float(each.temperature) == 1 and 4 <= int(each.stages) < 20
        assert BOX.contains(each.theta).all()
    theta = np.concatenate([each.theta for each in found])
    for d in range(2):
        law = stats.truncnorm(*((np.array([BOX.low[d], BOX.high[d]]) - mean[d]) / scale[d]), mean[d], scale[d])
        assert theta[:, d].mean() == pytest.approx(law.mean(), abs=0.1 * law.std())
        assert theta[:, d].std() == pytest.approx(law.std(), rel=0.1)
        # Particles have common ancestors: no p-value of independent draws (largest of 60 seeds by fours: 0.065).
        assert stats.kstest(theta[:, d], law.cdf).statistic < 0.1
    evidence = np.mean([float(each.log_evidence) for each in found])
    assert evidence == pytest.approx(masses([mean], [scale])[0] - LOG_VOLUME, abs=0.15)


def test_both_modes_are_found_with_their_masses():
    """The modes are far apart and have unequal widths and weights."""
    means, scales, weights = [[-2.0, 0.0], [1.5, 1.0]], [[0.05, 0.1], [0.2, 0.05]], np.array([0.3, 0.7])
    found = [run(seed, gaussians(means, scales, weights)) for seed in SEEDS]
    theta = np.concatenate([each.theta for each in found])
    right = theta[:, 0] > 0
    assert right.mean() == pytest.approx(0.7, abs=0.08)
    for mode, rows in enumerate((~right, right)):
        np.testing.assert_allclose(theta[rows].mean(0), means[mode], atol=0.03)
        np.testing.assert_allclose(theta[rows].std(0), scales[mode], rtol=0.25)
    evidence = np.mean([float(each.log_evidence) for each in found])
    expected = logsumexp(np.log(weights) + masses(means, scales)) - LOG_VOLUME
    assert evidence == pytest.approx(expected, abs=0.3)


def test_a_likelihood_that_is_next_to_a_point_is_reached():
    mean, scale = np.array([2.9, -0.4]), np.array([1e-3, 1e-4])
    found = run(0, gaussians([mean, mean], [scale, scale]))
    assert int(found.stages) < STAGES and float(found.temperature) == 1
    np.testing.assert_allclose(found.theta.mean(0), mean, atol=1e-3)
    np.testing.assert_allclose(found.theta.std(0) / scale, 1, atol=0.3)


@pytest.mark.slow
def test_a_likelihood_that_is_not_finite_ends():
    """For an observation that no network can handle, draws stay in the box."""
    nowhere = gaussians([[jnp.nan, 0.0]] * 2, [[1.0, 1.0]] * 2)
    found = run(0, nowhere)
    assert BOX.contains(found.theta).all() and int(found.stages) <= STAGES


def test_without_blackjax_one_line_says_what_to_install(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "blackjax"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxlfi\[snle\]'$") as error:
        METHODS["snle"](QUICK).check()
    assert "\n" not in str(error.value)
    METHODS["apt"](QUICK).check()
