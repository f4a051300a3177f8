"""Bounds of parameters that the observation says nothing of: a distance against SciPy, and what is taken back by it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Centre, Edge, Identified, Mode
from jaxlfi.heuristics.identified import PLACES, from_uniform

BOX, PHI = Support([-1.0, 0.0, 2.0], [1.0, 4.0, 3.0]), Support([-9.0, -9.0, -9.0], [9.0, 9.0, 9.0])
apply = jax.jit(lambda rule, previous, posterior, feasible: rule(previous, posterior, feasible))


def posterior(means=(0.1, 3.4, 2.5), scales=(1.2, 0.5, 0.05)):
    """Wide in the first parameter, against the upper bound in the second, well inside in the third."""
    one = GaussianMixture(
        jnp.log(jnp.array([0.6, 0.4])),
        jnp.stack([jnp.array(means), jnp.array(means) + 0.05]),
        jnp.stack([jnp.diag(jnp.array(scales)), 1.1 * jnp.diag(jnp.array(scales))]),
    )
    return Belief(one, BOX, jnp.asarray(True)), one


def test_the_distance_is_kolmogorovs_within_the_box():
    _, mixture = posterior()
    at = BOX.low + PLACES[:, None] * BOX.width
    parts = [stats.norm(mean, np.diag(scale)) for mean, scale in zip(mixture.means, mixture.scale_tril, strict=True)]
    cdf = lambda x: sum(weight * part.cdf(x) for weight, part in zip((0.6, 0.4), parts, strict=True))
    truncated = (cdf(at) - cdf(BOX.low)) / (cdf(BOX.high) - cdf(BOX.low))
    expected = np.abs(truncated - PLACES[:, None]).max(axis=0)
    np.testing.assert_allclose(from_uniform(mixture, BOX), expected, atol=2e-4)
    assert expected[0] < 0.1 < 0.3 < expected[1]


def test_a_posterior_beyond_the_box_is_far_from_uniform():
    _, mixture = posterior(means=(40.0, 2.0, -50.0), scales=(0.1, 100.0, 0.1))
    np.testing.assert_allclose(from_uniform(mixture, BOX), [1.0, 0.0, 1.0], atol=0.01)


def test_bounds_of_what_is_not_identified_stay():
    belief, mixture = posterior()
    alone, moved = apply(Edge(), belief, mixture, PHI)
    assert (np.asarray(moved.high_shift) > 0).tolist() == [True, True, False]
    after, seen = apply(Identified(Edge()), belief, mixture, PHI)
    np.testing.assert_array_equal(after.support.low, [BOX.low[0], *alone.support.low[1:]])
    np.testing.assert_array_equal(after.support.high, [BOX.high[0], *alone.support.high[1:]])
    np.testing.assert_array_equal(seen.high_shift, [0.0, *moved.high_shift[1:]])
    assert after.mixture.means.shape == mixture.means.shape and bool(after.informed)
    np.testing.assert_array_equal(seen.evidence["mass_left"], moved.evidence["mass_left"])


@pytest.mark.parametrize("rule", [Edge(), Mode(), Centre()], ids=["edge", "mode", "centre"])
def test_without_a_threshold_it_is_the_rule_itself(rule):
    belief, mixture = posterior()
    plain, _ = apply(rule, belief, mixture, PHI)
    wrapped, _ = apply(Identified(rule, least_change=0.0), belief, mixture, PHI)
    np.testing.assert_array_equal(plain.support.low, wrapped.support.low)
    np.testing.assert_array_equal(plain.support.high, wrapped.support.high)
    still, _ = apply(Identified(rule, least_change=jnp.array([1.0, 0.0, 1.0])), belief, mixture, PHI)
    np.testing.assert_array_equal(still.support.high, [BOX.high[0], plain.support.high[1], BOX.high[2]])
