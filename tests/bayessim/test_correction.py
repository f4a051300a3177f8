"""Corrections: densities on a grid, and importance weights against NumPy."""

import dataclasses
import functools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from jaxlfi.bayessim.correction import CORRECTIONS, effective_size, equal_weights, importance_weights
from jaxlfi.distributions.belief import Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.tasks.task import Task

BOX = Support([-9.0, -7.0], [9.0, 7.0])


@functools.cache
def prior_of(prior):
    """A prior in the form that a task has."""
    return Task(lambda key, theta: theta, ("a", "b"), {"box": BOX}, BOX, prior=prior).inference.prior


multiplied = jax.jit(CORRECTIONS["paper"].change, static_argnums=0)
importance = jax.jit(importance_weights, static_argnums=0)


def gaussian(mean, factor) -> GaussianMixture:
    return GaussianMixture(np.zeros(1, np.float32), np.float32([mean]), np.float32([factor]))


def density(mixture: GaussianMixture):
    """The density of a mixture, by SciPy."""
    weights, factors = special.softmax(np.asarray(mixture.logits, float)), np.asarray(mixture.scale_tril, float)
    parts = [
        stats.multivariate_normal(*pair) for pair in zip(np.asarray(mixture.means), factors @ factors.mT, strict=True)
    ]
    return lambda theta: sum(w * part.pdf(theta) for w, part in zip(weights, parts, strict=True))


moments = jax.jit(lambda mixture: (mixture.mean, mixture.covariance))


Q = gaussian([1.0, -0.5], [[0.8, 0.0], [0.3, 0.5]])
PREVIOUS = gaussian([0.2, 0.4], [[0.6, 0.0], [-0.4, 0.9]])
INFORMED = Belief(PREVIOUS, BOX, jnp.asarray(True))
PRIOR = distrax.MultivariateNormalTri(jnp.array([0.5, -1.0]), jnp.array([[2.0, 0.0], [0.7, 3.0]]))


def on_grid(mixture: GaussianMixture, expected) -> None:
    """Compare a mixture with a density that need not be normalised, by mean and covariance on a fine grid."""
    axes = np.linspace(-6, 6, 241), np.linspace(-6, 6, 241)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    mass = expected(grid)
    mass /= mass.sum()
    mean, found = mass @ grid, moments(mixture)
    np.testing.assert_allclose(found[0], mean, atol=1e-3)
    np.testing.assert_allclose(found[1], (grid - mean).T @ ((grid - mean) * mass[:, None]), atol=1e-3)


@pytest.mark.parametrize("name", ["none", "importance"])
def test_some_corrections_leave_the_mixture_as_it_is(name):
    posterior, bad = CORRECTIONS[name].change(None, Q, INFORMED)
    assert posterior is Q and int(bad) == 0


@pytest.mark.parametrize("name", ["none", "paper"])
def test_some_corrections_weigh_all_filled_rows_the_same(name):
    weights = CORRECTIONS[name].row_weights(None, data(np.ones((3, 2)), 5), INFORMED, 0, 0.0)
    np.testing.assert_array_equal(weights, [1, 1, 1, 0, 0])


@pytest.mark.parametrize("name", ["none", "paper"])
def test_simulations_given_with_a_density_keep_their_weights(name):
    given = data(np.ones((3, 2)), 5).replace(weight=jnp.array([0.5, 2.0, 0.25, 7.0, 1.0]))
    weights = CORRECTIONS[name].row_weights(None, given, INFORMED, 0, 0.0)
    np.testing.assert_array_equal(weights, [0.5, 2.0, 0.25, 0, 0])


def test_to_the_letter_multiplies_by_the_reference():
    posterior, bad = multiplied(None, Q, INFORMED)
    assert int(bad) == 0 and posterior.logits.shape == (1,)
    on_grid(posterior, lambda theta: density(Q)(theta) * density(PREVIOUS)(theta))


def test_to_the_letter_divides_by_a_gaussian_prior():
    posterior, bad = multiplied(prior_of(PRIOR), Q, INFORMED)
    assert int(bad) == 0
    prior = stats.multivariate_normal([0.5, -1.0], np.array([[4.0, 1.4], [1.4, 9.49]]))
    on_grid(posterior, lambda theta: density(Q)(theta) * density(PREVIOUS)(theta) / prior.pdf(theta))


def test_a_prior_too_narrow_to_divide_by_is_counted():
    """If the prior is narrower than the product, no Gaussian is left: the pair is kept undivided, and counted."""
    narrow = distrax.MultivariateNormalDiag(jnp.zeros(2), jnp.array([0.1, 5.0]))
    posterior, bad = multiplied(prior_of(narrow), Q, INFORMED)
    assert int(bad) == 1
    undivided, _ = multiplied(None, Q, INFORMED)
    np.testing.assert_allclose(moments(posterior)[0], moments(undivided)[0], atol=1e-5)


def test_mixtures_keep_their_number_of_components():
    """The mean and covariance of all K^2 products survive their reduction to K."""
    q = GaussianMixture(
        np.float32([0.0, 1.0]),
        np.float32([[1.0, -0.5], [-1.0, 0.3]]),
        np.float32([Q.scale_tril[0], 0.7 * np.eye(2)]),
    )
    before = GaussianMixture(
        np.float32([0.5, 0.0]),
        np.float32([[0.2, 0.4], [-0.6, 0.0]]),
        np.float32([PREVIOUS.scale_tril[0], np.eye(2)]),
    )
    posterior, _ = multiplied(None, q, dataclasses.replace(INFORMED, mixture=before))
    assert posterior.logits.shape == (2,)
    on_grid(posterior, lambda theta: density(q)(theta) * density(before)(theta))


def test_before_any_data_there_is_no_reference():
    for prior in (None, PRIOR):
        posterior, bad = multiplied(prior_of(prior), Q, NOTHING)
        np.testing.assert_array_equal(posterior.means, Q.means)
        np.testing.assert_array_equal(posterior.scale_tril, Q.scale_tril)
        assert int(bad) == 0


def test_to_the_letter_refuses_other_priors():
    with pytest.raises(
        ValueError, match=r"^correction='paper' .* multivariate normal, got Independent; use correction="
    ):
        multiplied(prior_of(distrax.Independent(distrax.Laplace(jnp.zeros(2), jnp.ones(2)), 1)), Q, INFORMED)


# --------------------------------------------------------------------------------------- importance weights


def data(theta, capacity: int = 40) -> Dataset:
    theta = np.asarray(theta, np.float32)
    padded = np.zeros((capacity, theta.shape[1]), np.float32)
    padded[: len(theta)] = theta
    ones, rows = np.ones(capacity, np.float32), np.zeros(capacity, np.int32)
    return Dataset(*map(jnp.asarray, (padded, 0 * ones[:, None], rows, ones, np.int32(len(theta)))))


def proposals(*beliefs: Belief) -> Belief:
    """The proposals of three rounds; if fewer are given, the last one is repeated."""
    beliefs += beliefs[-1:] * (3 - len(beliefs))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *beliefs)


THETA = np.random.default_rng(0).uniform([-4, -3], [4, 3], (30, 2))
NOTHING = jax.jit(uninformed, static_argnums=1)(BOX, 1)
ROUNDS = proposals(NOTHING, INFORMED, dataclasses.replace(INFORMED, mixture=Q))


def relative(weights, size=len(THETA)):
    """Weights divided by their mean."""
    weights = np.asarray(weights)[:size]
    return weights / weights.mean()


def truncated(weights):
    return np.minimum(weights, np.sqrt(len(weights)) * weights.mean())


def test_in_the_first_round_all_weigh_the_same():
    weights = importance(None, data(THETA), ROUNDS, 0)
    np.testing.assert_allclose(relative(weights), 1, rtol=1e-5)
    np.testing.assert_array_equal(weights[30:], 0)


@pytest.mark.parametrize("rounds", [2, 3])
def test_weights_against_numpy(rounds):
    """A uniform first round, then Gaussians almost wholly inside the box; later rounds do not count."""
    weights = importance(None, data(THETA), ROUNDS, rounds - 1)
    each = [np.full(30, 1 / (18.0 * 14.0)), density(PREVIOUS)(THETA), density(Q)(THETA)][:rounds]
    np.testing.assert_allclose(relative(weights), relative(truncated(1 / np.sum(each, axis=0))), rtol=5e-3)


def test_the_defensive_fraction_is_part_of_the_proposal():
    fraction = 0.3
    weights = importance(None, data(THETA), ROUNDS, 1, fraction)
    uniform = np.full(30, 1 / (18.0 * 14.0))
    proposal = uniform + fraction * uniform + (1 - fraction) * density(PREVIOUS)(THETA)
    np.testing.assert_allclose(relative(weights), relative(truncated(1 / proposal)), rtol=5e-3)
    assert np.abs(relative(weights) - relative(importance(None, data(THETA), ROUNDS, 1))).max() > 0.1


def test_simulations_given_with_a_density_count_as_draws_of_the_prior():
    """A simulation that stands for two has twice the weight, with the same mixture of proposals."""
    given = data(THETA).replace(weight=jnp.ones(40).at[:10].set(2.0))
    plain = 1 / (np.full(30, 1 / (18.0 * 14.0)) + density(PREVIOUS)(THETA))
    expected = plain * np.where(np.arange(30) < 10, 2.0, 1.0)
    weights = importance(None, given, ROUNDS, 1)
    np.testing.assert_allclose(relative(weights), relative(truncated(expected)), rtol=5e-3)


def test_a_prior_of_the_tasks_own_is_target_and_first_proposal():
    weights = importance(prior_of(PRIOR), data(THETA), ROUNDS, 1)
    normal = stats.multivariate_normal([0.5, -1.0], np.array([[4.0, 1.4], [1.4, 9.49]]))
    draws = normal.rvs(200_000, random_state=0)
    mass = np.mean(np.all((draws > BOX.low) & (draws < BOX.high), axis=1))
    prior = normal.pdf(THETA)
    expected = prior / (prior / mass + density(PREVIOUS)(THETA))
    assert 0.5 < mass < 1
    # The mass inside is estimated from a few thousand draws.
    np.testing.assert_allclose(relative(weights), relative(truncated(expected)), rtol=0.03)


def test_a_proposal_restricted_to_its_box_is_denser_inside():
    """Half of the Gaussian lies in the box, so that its density is twice as high there, and zero outside."""
    half = Support([0.2, -7.0], [9.0, 7.0])
    rounds = proposals(NOTHING, Belief(PREVIOUS, half, jnp.asarray(True)))
    weights = importance(None, data(THETA), rounds, 1)
    inside = THETA[:, 0] > 0.2
    expected = 1 / (1 / 252 + np.where(inside, 2 * density(PREVIOUS)(THETA), 0.0))
    # Mass inside is estimated from 512 draws: five standard errors of a half.
    np.testing.assert_allclose(relative(weights), relative(truncated(expected)), rtol=5 / np.sqrt(512))


def test_weights_are_truncated():
    """One row of thirty lies where proposals are thin: its weight becomes sqrt(n) times the mean before truncation."""
    rounds = proposals(INFORMED)
    theta = np.tile([0.2, 0.4], (30, 1))
    theta[3] = [-4.0, 5.0]
    weights = np.asarray(importance(None, data(theta), rounds, 1))
    assert weights.argmax() == 3
    plain = 1 / density(PREVIOUS)(theta)
    np.testing.assert_allclose(relative(weights), relative(truncated(plain)), rtol=1e-2)
    assert relative(plain)[3] > 29 and plain[3] / plain.mean() > np.sqrt(30)


def test_rows_that_no_proposal_could_draw_and_empty_rows_weigh_nothing():
    small = dataclasses.replace(INFORMED, support=Support([-1.0, -1.0], [2.0, 2.0]))
    weights = importance(None, data([[0.0, 0.0], [3.0, 0.0]]), proposals(small), 1)
    assert float(weights[0]) > 0
    np.testing.assert_array_equal(weights[1:], 0.0)


def test_no_rows_at_all_have_finite_weights():
    weights = importance(None, data(np.zeros((0, 2))), ROUNDS, 1)
    np.testing.assert_array_equal(weights, np.zeros(40))


def test_effective_size():
    assert float(effective_size(jnp.ones(7))) == pytest.approx(7)
    assert float(effective_size(jnp.array([1.0, 0.0, 0.0]))) == pytest.approx(1)
    assert float(effective_size(jnp.array([3.0, 1.0]))) == pytest.approx(16 / 10)
    assert float(effective_size(jnp.zeros(3))) == 0
    assert CORRECTIONS["none"].row_weights is equal_weights
