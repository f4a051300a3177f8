"""Masses and draws of densities that have no closed form, against those of a mixture that has one."""

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from scipy import stats

from jaxlfi.distributions.mass import log_mass_inside, rare_draws
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.region import Region
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import log_mass


@struct.dataclass
class Flow:
    """A Gaussian that hides its closed form."""

    own: GaussianMixture

    def log_prob(self, theta):
        return self.own.log_prob(theta)

    def sample(self, key, n):
        return self.own.sample(key, n)


TRUE = GaussianMixture(jnp.zeros(1), jnp.array([[0.0, 0.3]]), jnp.array([[[1.0, 0.0], [0.5, 0.6]]]))
FITTED = GaussianMixture(jnp.zeros(1), jnp.array([[0.1, 0.2]]), jnp.array([[[1.1, 0.0], [0.3, 0.7]]]))
"""A mixture like the density, as if fitted to its draws."""
UNIT = distrax.Independent(distrax.Uniform(jnp.zeros(2), jnp.ones(2)), 1)

WIDE = Support([-6.0, -6.0], [6.0, 6.0])

_log_mass, _exact = jax.jit(log_mass_inside), jax.jit(log_mass)
_log_mass_within = jax.jit(lambda density, mixture: log_mass_inside(density, mixture, Region(WIDE, UNIT)))
_rare_draws_within = jax.jit(lambda key, density, mixture: rare_draws(density, mixture, Region(WIDE, UNIT))(key, 300))


def moved(mixture: GaussianMixture, shift: float) -> GaussianMixture:
    """The mixture shifted along the diagonal."""
    return mixture.replace(means=np.asarray(mixture.means) + np.float32(shift))


@pytest.mark.parametrize("low", [-1.0, 2.0, 5.0])
def test_a_flows_mass_is_the_mixtures_it_equals(low):
    """Masses range from two thirds to a ten-millionth."""
    support = Support([low, -1.0], [low + 2.5, 1.5])
    expected = float(_exact(TRUE, support))
    assert float(_log_mass(Flow(TRUE), FITTED, support)) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("shift", [0.0, 4.0])
def test_a_mass_where_a_prior_is_not_zero_is_that_of_its_box(shift):
    """The prior is zero except in a small part of a wide box; rejection finds nothing of a shifted density there."""
    true, fitted = moved(TRUE, shift), moved(FITTED, shift)
    expected = float(_exact(true, Support([0.0, 0.0], [1.0, 1.0])))
    for density, mixture in ((Flow(true), fitted), (true, true)):
        assert float(_log_mass_within(density, mixture)) == pytest.approx(expected, abs=0.4)


def test_rare_draws_are_the_densitys_own(key):
    """They are not draws of the mixture that was fitted to the density."""
    support = Support([4.0, -1.0], [6.0, 4.0])
    sampler = jax.jit(lambda key: rare_draws(Flow(TRUE), FITTED, support)(key, 3000))
    draws = np.asarray(sampler(key), float)
    assert np.asarray(support.contains(draws)).all() and len(np.unique(draws, axis=0)) > 2900
    assert stats.kstest(draws[:, 0], stats.truncnorm(4, 6).cdf).statistic < 0.05
    left = (draws[:, 1] - 0.3 - 0.5 * draws[:, 0]) / 0.6
    assert np.mean(left) == pytest.approx(0, abs=0.3)  # with the mixture it would be beyond -1.2


def test_rare_draws_keep_out_of_where_a_prior_is_zero(key):
    far = GaussianMixture(*(np.float32(leaf) for leaf in (TRUE.logits, 0.2 * TRUE.means - 4.0, 0.2 * TRUE.scale_tril)))
    for density in (Flow(far), far):
        draws = np.asarray(_rare_draws_within(key, density, far))
        key = jax.random.clone(key)
        assert ((draws >= 0) & (draws <= 1)).all()
        assert draws.max(axis=1).mean() < 0.5  # at the corner nearest to the density
