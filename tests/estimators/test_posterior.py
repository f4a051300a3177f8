"""Posterior: a density truncated to a box, in either space, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import MASS_DRAWS
from jaxlfi.estimators.posterior import Posterior, truncated

PLAIN = Space(("a", "b"), (False, False))
SPACE = Space(("rate", "shift"), (True, False))
"""The first parameter is inferred as its logarithm."""
BOX = Support([-1.0, -2.0], [1.5, 2.5])
MU, SD = np.array([0.3, 0.5]), np.array([0.5, 1.2])


def gaussian(mean, covariance) -> GaussianMixture:
    """One component."""
    factor = np.linalg.cholesky(np.asarray(covariance, float))
    return GaussianMixture(jnp.zeros(1), jnp.asarray([mean], jnp.float32), jnp.asarray(factor[None], jnp.float32))


_truncated = jax.jit(truncated, static_argnums=3)


def posterior(density: GaussianMixture, space: Space = SPACE, box: Support = BOX) -> Posterior:
    """A mixture truncated to a box."""
    return _truncated(density, density, box, space)


@functools.cache
def plain() -> Posterior:
    """A posterior with a truncated log-normal rate and a truncated normal shift."""
    return posterior(gaussian(MU, np.diag(SD**2)))


LOW, HIGH = np.asarray(BOX.low, float), np.asarray(BOX.high, float)
LAWS = [stats.truncnorm(*((np.array([LOW[d], HIGH[d]]) - MU[d]) / SD[d]), MU[d], SD[d]) for d in range(2)]
MASS = np.prod([np.diff(stats.norm(MU[d], SD[d]).cdf([LOW[d], HIGH[d]]))[0] for d in range(2)])


def sampled(posterior: Posterior, key: jax.Array, space: str = "natural") -> np.ndarray:
    """4000 draws."""
    return np.asarray(posterior.sample(key, 4000, space))


def midpoints(low: float, high: float, cells: int = 400) -> tuple[np.ndarray, float]:
    """The centres of equal cells, and their width."""
    width = (high - low) / cells
    return low + width * (np.arange(cells) + 0.5), width


def grid(low, high) -> tuple[np.ndarray, float]:
    """The centres of the cells of a box, shape [n, n, 2], and their area."""
    (first, width), (second, height) = (midpoints(low[d], high[d]) for d in range(2))
    return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).astype(np.float32), width * height


def test_the_mass_inside_is_the_densitys():
    tolerance = 5 * np.sqrt(MASS * (1 - MASS) / MASS_DRAWS)
    assert float(plain().mass_inside) == pytest.approx(MASS, abs=tolerance)
    assert 0.5 < MASS < 0.95  # a posterior wholly inside would test nothing


def test_the_density_is_one_in_all_in_inference_space():
    theta, area = grid(LOW, HIGH)
    log_prob = np.asarray(plain().log_prob(theta, space="inference"), float)
    assert np.exp(log_prob).sum() * area == pytest.approx(1, abs=0.02)
    expected = LAWS[0].logpdf(theta[..., 0]) + LAWS[1].logpdf(theta[..., 1])
    np.testing.assert_allclose(log_prob, expected, atol=0.02)  # the truncation constant is a Monte Carlo estimate


def test_the_density_is_one_in_all_in_natural_units():
    """Without the Jacobian of the logarithm it would be off by a factor of up to e^1.5."""
    theta, area = grid([np.exp(LOW[0]), LOW[1]], [np.exp(HIGH[0]), HIGH[1]])
    log_prob = np.asarray(plain().log_prob(theta), float)
    assert np.exp(log_prob).sum() * area == pytest.approx(1, abs=0.02)
    rate = theta[..., 0].astype(float)
    expected = LAWS[0].logpdf(np.log(rate)) - np.log(rate) + LAWS[1].logpdf(theta[..., 1])
    np.testing.assert_allclose(log_prob, expected, atol=0.02)


def test_outside_of_the_support_there_is_nothing():
    inside = jnp.array([1.0, 0.0])
    assert np.isfinite(plain().log_prob(inside)) and np.isfinite(plain().log_prob(inside, space="inference"))
    for outside in ([5.0, 0.0], [1.0, 2.6], [0.0, 0.0], [-1.0, 0.0]):  # the last two have no logarithm
        assert np.isneginf(plain().log_prob(jnp.array(outside)))
    for outside in ([1.6, 0.0], [0.0, -2.1]):
        assert np.isneginf(plain().log_prob(jnp.array(outside), space="inference"))
    mixed = plain().log_prob(jnp.array([[1.0, 0.0], [-1.0, 0.0]]))
    np.testing.assert_array_equal(np.isfinite(mixed), [True, False])


def test_gradients_at_places_without_a_logarithm_are_no_nan():
    gradient = jax.grad(lambda theta: plain().log_prob(theta))
    assert np.isfinite(gradient(jnp.array([1.2, 0.4]))).all()


@pytest.mark.parametrize("n", [30, 250])
def test_draws_are_the_same_within_a_program(n, key):
    traced = jax.jit(lambda key: plain().sample(key, n, "inference"))(jax.random.clone(key))
    np.testing.assert_allclose(plain().sample(key, n, "inference"), traced, rtol=1e-5, atol=1e-6)


def test_fewer_draws_are_the_first_of_more(key):
    few, more = (plain().sample(jax.random.clone(key), n) for n in (30, 190))
    np.testing.assert_array_equal(few, more[:30])


def test_draws_have_the_density_in_either_space(key):
    inner = sampled(plain(), jax.random.clone(key), "inference")
    natural = sampled(plain(), key)
    np.testing.assert_allclose(natural, np.stack([np.exp(inner[:, 0]), inner[:, 1]], axis=1), rtol=1e-5)
    assert ((inner > LOW) & (inner < HIGH)).all()
    assert len(np.unique(inner, axis=0)) == 4000
    for d in range(2):
        assert stats.kstest(inner[:, d], LAWS[d].cdf).pvalue > 1e-3


@pytest.mark.parametrize("n", [1, 7])
def test_draws_are_as_many_as_were_asked_for(n, key):
    assert plain().sample(key, n).shape == (n, 2)


@pytest.mark.parametrize("distance", [3.0, 8.0, 30.0])
def test_where_next_to_nothing_is_inside_draws_are_the_truncated_mixtures(distance, key):
    """There are no atoms on the bound, nor uniform draws: the density falls from it as an exponential."""
    far = posterior(gaussian([-1.0 - 0.2 * distance, 0.0], np.diag([0.04, 1.0])), PLAIN)
    draws = sampled(far, key).astype(float)
    law = stats.truncnorm(distance, distance + 12.5)
    assert stats.kstest((draws[:, 0] + 1) / 0.2 + distance, law.cdf).statistic < 1.95 / np.sqrt(4000)
    assert (draws[:, 0] == -1.0).mean() < 1e-3
    theta = np.array([-0.9, 0.3])
    expected = law.logpdf((theta[0] + 1) / 0.2 + distance) - np.log(0.2) + stats.truncnorm(-2, 2.5).logpdf(theta[1])
    # In single precision, log-densities before truncation are accurate to a few millionths of their size.
    assert float(far.log_prob(jnp.asarray(theta))) == pytest.approx(expected, abs=2e-3 + 2e-6 * distance**2)


def test_the_mean_is_the_closed_form_in_either_space():
    inner, natural = np.asarray(plain().mean(space="inference")), np.asarray(plain().mean())
    errors = [5 * law.std() / np.sqrt(MASS_DRAWS) for law in LAWS]
    for d in range(2):
        assert inner[d] == pytest.approx(LAWS[d].mean(), abs=errors[d])
    moments = [LAWS[0].expect(lambda x, p=power: np.exp(p * x)) for power in (1, 2)]
    scale = np.sqrt(moments[1] - moments[0] ** 2)
    assert natural[0] == pytest.approx(moments[0], abs=5 * scale / np.sqrt(MASS_DRAWS))
    assert natural[1] == pytest.approx(LAWS[1].mean(), abs=errors[1])
    assert abs(moments[0] - np.exp(LAWS[0].mean())) > 0.1  # the mean of the logarithm is different


def test_the_maximum_inside_is_the_mean_of_a_gaussian():
    mean = np.array([0.4, -0.7])
    correlated = posterior(gaussian(mean, [[0.3, 0.35], [0.35, 0.8]]), PLAIN)
    np.testing.assert_allclose(correlated.map(), mean, atol=5e-3)


def test_the_maximum_at_a_bound_is_found_there():
    """The mean lies beyond the upper bound of the first parameter: the other is then its conditional mean."""
    mean, covariance = np.array([1.9, 0.5]), np.array([[0.3, 0.25], [0.25, 0.8]])
    beyond = posterior(gaussian(mean, covariance), PLAIN)
    expected = [1.5, mean[1] + covariance[0, 1] / covariance[0, 0] * (1.5 - mean[0])]
    np.testing.assert_allclose(beyond.map(), expected, atol=5e-3)
    assert bool(BOX.contains(beyond.map()))


@pytest.mark.parametrize("bound", range(2))
def test_a_maximum_on_a_bound_of_a_logarithm_has_a_density(bound):
    """Its logarithm, rounded twice, may lie beyond the bound: it did for about half of many bounds."""
    for offset in np.linspace(0.0, 0.1, 40):
        box = Support([-1.0 - offset, -2.0], [1.5 + offset, 2.5])
        one = plain().replace(support=box)
        corner = SPACE.to_natural(jnp.stack([box.low, box.high])[bound])
        assert np.isfinite(one.log_prob(corner))
        outside = corner * jnp.array([0.99999 if bound == 0 else 1.00001, 1.0])
        assert np.isneginf(one.log_prob(outside))
    beyond = posterior(gaussian([[-3.0, 0.5], [3.0, 0.5]][bound], np.diag(SD**2)))
    assert np.isfinite(beyond.log_prob(beyond.map()))


def test_below_the_lower_bound_of_many_decades_there_is_no_density():
    """The rounding error of the upper bound is larger than the lower bound."""
    wide = plain().replace(support=Support([-10.0, -2.0], [20.0, 2.5]))
    low = float(np.exp(-10.0))
    assert np.isfinite(wide.log_prob(jnp.array([1.001 * low, 0.5])))
    assert np.isneginf(wide.log_prob(jnp.array([0.999 * low, 0.5])))


def test_maxima_in_natural_units_and_in_inference_space_differ():
    """The mode of a log-normal is exp(mu - sigma^2) over the parameter and exp(mu) over its logarithm."""
    np.testing.assert_allclose(plain().map(), [np.exp(MU[0] - SD[0] ** 2), MU[1]], rtol=5e-3)
    np.testing.assert_allclose(plain().map(space="inference"), MU, atol=5e-3)


def test_the_highest_of_two_modes_is_taken():
    """A narrow mode with a third of the mass is higher than a wide one."""
    density = GaussianMixture(
        jnp.log(jnp.array([0.7, 0.3])),
        jnp.array([[-0.3, -1.0], [0.9, 1.5]]),
        jnp.stack([0.5 * jnp.eye(2), 0.05 * jnp.eye(2)]),
    )
    np.testing.assert_allclose(posterior(density, PLAIN).map(), [0.9, 1.5], atol=5e-3)


def test_another_support_truncates_anew(key):
    narrow = Support([0.0, 0.0], [1.0, 2.0])
    moved = plain().on(narrow)
    assert moved.space == SPACE and moved.support is narrow
    inner = sampled(moved, key, "inference")
    for d in range(2):
        law = stats.truncnorm(*((np.array([0.0, [1.0, 2.0][d]]) - MU[d]) / SD[d]), MU[d], SD[d])
        assert stats.kstest(inner[:, d], law.cdf).pvalue > 1e-3
    mass = np.prod([np.diff(stats.norm(MU[d], SD[d]).cdf([0.0, [1.0, 2.0][d]]))[0] for d in range(2)])
    assert float(moved.mass_inside) == pytest.approx(mass, abs=0.025)
    assert np.isneginf(moved.log_prob(jnp.array([-0.5, 0.5]), space="inference"))


def test_it_is_a_pytree_that_can_be_compiled_and_mapped(key):
    leaves, structure = jax.tree.flatten(plain())
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    again = jax.tree.unflatten(structure, leaves)
    theta = jnp.array([[1.0, 0.2], [0.7, -1.0]])
    np.testing.assert_array_equal(again.log_prob(theta), plain().log_prob(theta))
    other = posterior(gaussian([-0.2, 0.0], np.diag([0.1, 0.4])))
    both = jax.tree.map(lambda *parts: jnp.stack(parts), plain(), other)
    log_prob = jax.jit(jax.vmap(lambda p: p.log_prob(theta)))(both)
    keys = jax.random.split(key)
    draws = jax.jit(jax.vmap(lambda p, k: p.sample(k, 7)))(both, jax.random.clone(keys))
    for i, one in enumerate((plain(), other)):
        np.testing.assert_allclose(log_prob[i], one.log_prob(theta), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(draws[i], one.sample(keys[i], 7), rtol=1e-4, atol=1e-4)


def test_wrong_arguments_are_refused(key):
    for wrong in (0.5, jax.random.split(key), None):
        with pytest.raises(ValueError, match=r"^key: expected one key such as jax.random.key\(0\), or a seed, got"):
            plain().sample(wrong, 7)
    for wrong in (0, -1, 2.5, "3"):
        with pytest.raises(ValueError, match=r"^n: expected a whole number of at least 1, got"):
            plain().sample(jax.random.key(0), wrong)
    for wrong in (jnp.ones(3), jnp.ones((4, 1)), 1.0):
        with pytest.raises(ValueError, match=r"^theta: expected shape \[..., 2\], got"):
            plain().log_prob(wrong)
    for call in (plain().mean, plain().map, lambda space: plain().sample(jax.random.key(0), 7, space)):
        with pytest.raises(ValueError, match=r"^space: expected 'natural' or 'inference', got 'log'"):
            call("log")


def test_lists_and_numpy_are_taken_as_they_are():
    expected = plain().log_prob(jnp.array([1.0, 0.5]))
    for theta in ([1.0, 0.5], (1, 0.5), np.array([1.0, 0.5])):
        np.testing.assert_allclose(plain().log_prob(theta), expected, rtol=1e-6)


class Ramp:
    """A prior over two numbers that is zero below the line of equal numbers, and returns NaN there."""

    def sample(self, *, seed, sample_shape):
        return jnp.sort(jax.random.normal(seed, (sample_shape, 2)), axis=-1)

    def log_prob(self, theta):
        return jnp.where(theta[..., 1] > theta[..., 0], -0.5 * jnp.sum(theta**2, axis=-1), jnp.nan)


@pytest.mark.slow
def test_a_posterior_is_zero_where_its_prior_is(key):
    """Draws, density and maximum of a Gaussian most of which lies below the line."""
    mean, deviation = np.array([0.8, -0.4]), np.array([0.5, 0.6])
    density = gaussian(mean, np.diag(deviation**2))
    cut = jax.jit(lambda density: truncated(density, density, BOX, PLAIN, Ramp()))(density)
    theta, area = grid(BOX.low, BOX.high)
    log_prob = np.asarray(cut.log_prob(theta), float)
    above = theta[..., 1] > theta[..., 0]
    assert np.isneginf(log_prob[~above]).all() and np.isfinite(log_prob[above]).all()
    assert np.exp(log_prob).sum() * area == pytest.approx(1, abs=0.05)
    draws = sampled(cut, key).astype(float)
    assert (draws[:, 1] > draws[:, 0]).all()
    weight = np.where(above, np.exp(-0.5 * (((theta - mean) / deviation) ** 2).sum(-1)), 0.0)[..., None]
    expected = (weight * theta).sum((0, 1)) / weight.sum()
    np.testing.assert_allclose(draws.mean(0), expected, atol=0.03)
    # On the line a = b the density is highest at the mean weighted by the precisions.
    highest = (mean / deviation**2).sum() / (1 / deviation**2).sum()
    found = np.asarray(cut.map(), float)
    assert found[1] > found[0]
    np.testing.assert_allclose(found, [highest, highest], atol=0.03)
