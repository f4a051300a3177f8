"""ADR on a push meant for one mass, whose error at any other is known: ranges end where the error is as allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.rl.randomisation import adr
from jaxlfi.rl.randomisation.adr import Adr, Probe

SPACE = Space(("mass", "offset"), (True, False))
FEASIBLE = SPACE.box_to_inference(Support([0.1, -1.0], [30.0, 3.0]))
START = jnp.array([np.log(2.0), 0.5])
SETTINGS = Adr(low_threshold=-0.5, high_threshold=-0.3, step=0.01, buffer=4)


def performance(theta):
    """The impulse that takes 2 kg one metre takes a mass m 2 / m metres: minus how far off that is."""
    return -jnp.abs(2.0 / jnp.exp(theta[..., 0]) - 1.0)


def trained(key, ranges, of=performance, rounds=400):
    """So many rounds of eight probes each."""

    def one(ranges, key):
        probes = adr.probes(key, ranges, 8)
        return adr.recorded(SETTINGS, ranges, probes, of(probes.theta)), adr.entropy(ranges)

    return jax.jit(lambda key: jax.lax.scan(one, ranges, jax.random.split(key, rounds)))(key)


def test_ranges_end_where_the_error_is_between_the_thresholds(key):
    """Masses whose error is 0.3 and 0.5: 2 / 1.3 and 2 / 1.5 kg below, 2 / 0.7 and 2 / 0.5 kg above. The other
    parameter changes the performance only through the mass drawn beside it: its range takes all of Phi."""
    ranges, entropies = trained(key, adr.init(START, FEASIBLE))
    width = float(FEASIBLE.width[0]) * 0.01
    low, high = float(ranges.support.low[0]), float(ranges.support.high[0])
    assert np.log(2 / 1.5) - width <= low <= np.log(2 / 1.3) + width
    assert np.log(2 / 0.7) - width <= high <= np.log(2 / 0.5) + width
    np.testing.assert_allclose([ranges.support.low[1], ranges.support.high[1]], [-1.0, 3.0], atol=1e-5)
    assert entropies[0] == -np.inf and entropies[-1] > -1


def test_ranges_shrink_to_the_start_where_the_policy_fails_everywhere(key):
    key_before, key_after = jax.random.split(key)
    ranges, _ = trained(key_before, adr.init(START, FEASIBLE))
    assert (np.asarray(ranges.support.width) > 0.5).all()
    after, _ = trained(key_after, ranges, of=lambda theta: jnp.full(theta.shape[:-1], -5.0), rounds=800)
    np.testing.assert_allclose(after.support.low, START, atol=1e-5)
    np.testing.assert_allclose(after.support.high, START, atol=1e-5)


@pytest.mark.parametrize(("mean", "moves"), [(0.9, 1), (0.6, 0), (0.2, -1)])
def test_a_bound_moves_once_its_buffer_is_full_and_no_other_does(mean, moves):
    settings = Adr(low_threshold=0.3, high_threshold=0.8, step=0.1, buffer=3)
    support = Support(jnp.array([0.0, -0.5]), jnp.array([1.5, 1.5]))
    ranges = adr.init(START, FEASIBLE).replace(support=support)
    probes = lambda n: Probe(jnp.zeros((n, 2)), jnp.full(n, 1), jnp.full(n, 1))
    two = adr.recorded(settings, ranges, probes(2), jnp.array([mean - 0.1, mean + 0.1]))
    assert two.support.high[1] == 1.5 and two.counts.tolist() == [[0, 0], [0, 2]]
    three = adr.recorded(settings, two, probes(1), jnp.array([mean]))
    np.testing.assert_allclose(three.support.high, [1.5, 1.5 + moves * 0.4], rtol=1e-6)  # Phi is 4 wide there
    assert three.support.low.tolist() == support.low.tolist() and not three.counts.any() and not three.sums.any()


def test_a_lower_bound_moves_out_downwards():
    settings = Adr(low_threshold=0.3, high_threshold=0.8, step=0.1, buffer=1)
    ranges = adr.init(START, FEASIBLE)
    one = Probe(jnp.zeros((1, 2)), jnp.array([1]), jnp.array([0]))
    after = adr.recorded(settings, ranges, one, jnp.array([1.0]))
    np.testing.assert_allclose(after.support.low, START - jnp.array([0.0, 0.4]), rtol=1e-6)
    np.testing.assert_allclose(after.support.high, START, rtol=1e-6)


def test_probes_are_at_a_bound_and_elsewhere_within_the_ranges(key):
    support = Support(jnp.array([0.0, -0.5]), jnp.array([1.5, 2.0]))
    probes = adr.probes(key, adr.init(START, FEASIBLE).replace(support=support), 4000)
    theta, rows = np.asarray(probes.theta), np.arange(4000)
    bounds = np.stack([support.low, support.high])
    np.testing.assert_array_equal(theta[rows, probes.parameter], bounds[probes.upper, probes.parameter])
    other = theta[np.asarray(probes.parameter) == 1, 0]
    assert stats.kstest(other, stats.uniform(0.0, 1.5).cdf).pvalue > 1e-4
    counts = np.bincount(2 * np.asarray(probes.parameter) + np.asarray(probes.upper), minlength=4)
    assert stats.chisquare(counts).pvalue > 1e-4


def test_the_domain_is_in_natural_units(key):
    ranges = adr.init(START, FEASIBLE).replace(support=Support(jnp.array([0.0, 1.0]), jnp.array([1.0, 2.0])))
    theta = np.asarray(adr.domain(key, ranges, SPACE, 2000).theta)
    assert stats.kstest(np.log(theta[:, 0]), stats.uniform(0, 1).cdf).pvalue > 1e-4
    assert theta[:, 1].min() >= 1.0 and theta[:, 1].max() <= 2.0
