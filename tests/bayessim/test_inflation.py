"""Inflated proposals: the widths at which posteriors settle, in exact arithmetic, and the proposals of a round."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.correction import CORRECTIONS
from jaxlfi.bayessim.keys import round_keys
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import product
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Fixed
from tests.small import gaussian, settings, whole_runs  # noqa: F401 - a fixture

WIDE = Support([-1e3, -1e3], [1e3, 1e3])
LIKELIHOOD = GaussianMixture(jnp.zeros(1), jnp.array([[0.7, -1.2]]), jnp.array([[[0.5, 0.0], [-0.9, 0.3]]]))
"""Likelihood of the parameters given one observation: correlated, and of different widths."""

_product = jax.jit(lambda a, b: product(a, b)[0])
_inflated = jax.jit(GaussianMixture.inflated)
_divided = jax.jit(CORRECTIONS["quotient"].change, static_argnums=0)


def normal(mean: float, deviation: float) -> GaussianMixture:
    """A Gaussian in one dimension."""
    return GaussianMixture(jnp.zeros(1), jnp.array([[mean]]), jnp.array([[[deviation]]]))


def precisions(factor: Fraction, rounds: int) -> list[Fraction]:
    """Precision of q after each round, in units of the likelihood's: q is the likelihood times its proposals.

    The first proposals are uniform, the later ones `factor` times as wide as the previous posterior.
    """
    found = [Fraction(1)]
    while len(found) < rounds:
        found.append(1 + found[-1] / factor**2)
    return found


@pytest.mark.parametrize("factor", [Fraction(1), Fraction(3, 2), Fraction(2), Fraction(3)])
def test_the_width_of_every_round_is_that_of_exact_arithmetic(factor):
    likelihood = q = normal(0.7, 0.4)
    for exact in precisions(factor, 8):
        np.testing.assert_allclose(0.4**2 / q.covariance[0, 0], float(exact), rtol=2e-6)
        np.testing.assert_allclose(q.means[0], [0.7], rtol=1e-6)
        q = _product(likelihood, _inflated(q, float(factor)))


@pytest.mark.parametrize("factor", [Fraction(3, 2), Fraction(2), Fraction(3)])
def test_widths_settle_where_theory_says(factor):
    settled = 1 / (1 - 1 / factor**2)  # the limit of the precision
    assert 1 + settled / factor**2 == settled
    assert abs(precisions(factor, 60)[-1] - settled) < Fraction(1, 10**9)
    assert precisions(Fraction(1), 60)[-1] == 60  # without inflation it has no limit


def test_all_directions_settle_alike():
    q = LIKELIHOOD
    for _ in range(25):
        q = _product(LIKELIHOOD, _inflated(q, 2.0))
    np.testing.assert_allclose(q.covariance, 0.75 * LIKELIHOOD.covariance, rtol=1e-4)
    np.testing.assert_allclose(q.mean, LIKELIHOOD.mean, rtol=1e-4)


def test_of_two_widths_the_larger_is_lost():
    """A posterior that is narrow and wide at once, as in docs/calibration.md: one round leaves 1 % of it wide."""
    deviations, mean = (0.1, 1.0), jnp.array([0.7, -1.2])
    likelihood = GaussianMixture(
        jnp.zeros(2), jnp.stack([mean, mean]), jnp.stack([deviation * jnp.eye(2) for deviation in deviations])
    )
    after = _product(likelihood, _inflated(likelihood, 2.0))
    # The mass of a product of two Gaussians with equal means is N(0; 0, a + b), proportional to 1 / (a + b) in 2-D.
    variances = [Fraction(1, 100), Fraction(1)]
    parts = {(a, b): 1 / (a + 4 * b) for a in variances for b in variances}
    wide = parts[1, 1] / sum(parts.values())
    assert round(float(wide), 2) == 0.01
    np.testing.assert_allclose(after.weights[after.marginal_scales[:, 0] > 0.5], [float(wide)], rtol=1e-4)


def test_a_direction_without_information_fills_up():
    """The likelihood is flat along the second axis: there the posterior becomes as wide as its proposals."""
    ridge = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.array([[[0.5, 0.0], [0.0, 1e6]]]))
    q = _product(ridge, GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), 0.1 * jnp.eye(2)[None]))
    before = float(q.covariance[1, 1])
    for _ in range(3):
        q = _product(ridge, _inflated(q, 2.0))
    np.testing.assert_allclose(q.covariance[1, 1], 4.0**3 * before, rtol=1e-4)


@pytest.mark.parametrize("factor", [1.5, 3.0])
def test_the_quotient_leaves_the_likelihood_of_any_proposals(factor):
    """A mixture of two components is divided by the Gaussian from which proposals were drawn."""
    likelihood = GaussianMixture(
        jnp.log(jnp.array([0.3, 0.7])),
        jnp.array([[0.7, -1.2], [0.1, 0.4]]),
        jnp.array([[[0.5, 0.0], [-0.9, 0.3]], [[0.2, 0.0], [0.1, 0.4]]]),
    )
    proposal = Belief(_inflated(LIKELIHOOD, factor), WIDE, jnp.asarray(True))
    found, indefinite = _divided(None, _product(likelihood, proposal.mixture), proposal)
    assert int(indefinite) == 0
    np.testing.assert_allclose(found.weights, likelihood.weights, rtol=1e-3)
    np.testing.assert_allclose(found.means, likelihood.means, atol=2e-3)
    np.testing.assert_allclose(found.covariances, likelihood.covariances, rtol=5e-3, atol=1e-4)


def test_the_quotient_leaves_the_first_round_as_it_is():
    nothing = Belief(LIKELIHOOD, WIDE, jnp.asarray(False))
    found, _ = _divided(None, LIKELIHOOD, nothing)
    np.testing.assert_array_equal(found.means, LIKELIHOOD.means)
    np.testing.assert_array_equal(found.scale_tril, LIKELIHOOD.scale_tril)


@pytest.mark.parametrize("restriction", ["clip", "reject"])
def test_proposals_are_so_many_times_as_wide(restriction, key):
    drawn = settings(inflation=2.5, restriction=restriction, simulation_budget=4000)
    belief = Belief(LIKELIHOOD, WIDE, jnp.asarray(True))
    theta = np.asarray(jax.jit(algorithm.propose, static_argnums=1)(key, None, drawn, belief))
    deviations = 2.5 * np.sqrt(np.diag(LIKELIHOOD.covariance))
    for d in range(2):
        assert stats.kstest(theta[:, d], stats.norm(LIKELIHOOD.mean[d], deviations[d]).cdf).pvalue > 1e-3
    correlation = LIKELIHOOD.covariance[0, 1] / np.sqrt(LIKELIHOOD.covariance[0, 0] * LIKELIHOOD.covariance[1, 1])
    assert abs(np.corrcoef(theta.T)[0, 1] - correlation) < 0.03


@pytest.mark.slow
def test_a_round_keeps_what_it_drew_from(key):
    """Corrections divide by the proposal."""
    task, wide = gaussian(), settings(inflation=2.0, restriction="reject", correction="importance")
    support = task.support("ok")
    x = jnp.array([0.8, -0.6])
    state = algorithm.init(key, task, support, wide, x)
    step = jax.jit(algorithm.step, static_argnums=1)
    first, _ = step(round_keys(key, 0), task, wide, Fixed(), x, state, jnp.asarray(0))
    second, info = step(round_keys(key, 1), task, wide, Fixed(), x, first, jnp.asarray(1))
    drawn_from = _inflated(first.belief.mixture, 2.0)
    np.testing.assert_allclose(info.proposal.mixture.covariance, 4 * first.belief.mixture.covariance, rtol=1e-4)
    np.testing.assert_array_equal(second.proposals.mixture.scale_tril[1], drawn_from.scale_tril)
