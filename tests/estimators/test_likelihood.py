"""Posteriors from a likelihood network, against closed forms: one compiled program for all the data below."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood
from jaxlfi.estimators.training import fit

pytestmark = pytest.mark.slow

ESTIMATOR = MixtureLikelihood(
    hidden=(32, 32), components=2, ensemble_size=2, learning_rate=3e-3, epochs=0, steps=800, validation=0.1,
    schedule="cosine", warm_start=False,
)  # fmt: skip
SPACE = Space(("first", "second"), (False, False))
PHI = Support([-3.0, -3.0], [3.0, 3.0])
BOX = Support([-2.0, -1.0], [1.0, 2.5])
ROWS = 1000
MIXING = np.array([[1.0, 0.4], [-0.2, 0.8]])
NOISE = np.array([0.3, 0.5])


class Normal:
    """A prior that is narrower than the box."""

    mean, scale = np.array([-0.5, 1.5], np.float32), np.array([0.4, 0.6], np.float32)

    def log_prob(self, theta):
        """Log-density up to a constant, which the library requires."""
        return -0.5 * jnp.sum(((theta - self.mean) / self.scale) ** 2, axis=-1)

    def sample(self, seed, sample_shape):
        """Draws, some of them outside of the box."""
        return self.mean + self.scale * jax.random.normal(seed, (sample_shape, 2))


@jax.jit
def trained(seed, estimator, theta, x):
    """A network trained on simulations."""
    key_start, key_fit = jax.random.split(jax.random.key(seed))
    full = datasets.empty(ROWS, 2, 2).replace(theta=theta, x=x, size=jnp.asarray(ROWS))
    return fit(key_fit, untrained(key_start, estimator, 2, PHI, SPACE), full, jnp.ones(ROWS), ROWS)[0]


@jax.jit
def condition(network, x, support):
    """The posterior of x."""
    return network.condition(x, support)


def linear(theta: np.ndarray, rng: np.random.Generator, noise: np.ndarray = NOISE) -> np.ndarray:
    """MIXING theta plus noise."""
    return theta @ MIXING.T + noise * rng.normal(size=theta.shape)


def network_of(simulator, seed: int = 0, theta: np.ndarray | None = None, noise_floor: float = 0.03):
    """A network trained on simulations of parameters drawn from Phi, or of the given ones."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(PHI.low, PHI.high, (ROWS, 2)) if theta is None else theta
    estimator = ESTIMATOR.replace(noise_floor=noise_floor)
    return trained(seed, estimator, *(np.asarray(part, np.float32) for part in (theta, simulator(theta, rng))))


def exact(x: np.ndarray, prior: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, standard deviations and a sample of the linear model's posterior in BOX, by weights on a grid."""
    axes = [np.linspace(BOX.low[d], BOX.high[d], 401) for d in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    log_p = stats.norm(grid @ MIXING.T, NOISE).logpdf(x).sum(1)
    log_p = log_p + (stats.norm(Normal.mean, Normal.scale).logpdf(grid).sum(1) if prior else 0)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    mean = p @ grid
    return mean, np.sqrt(p @ (grid - mean) ** 2), grid[np.random.default_rng(0).choice(len(grid), 1000, p=p)]


X = np.array([0.5, 1.6])
"""An observation whose posterior the box truncates on one side in both dimensions."""


def agree(posterior, mean, deviation, within=0.25):
    """Compare means and standard deviations, in units of the latter."""
    draws = np.asarray(posterior.sample(jax.random.key(1), 1000))
    np.testing.assert_allclose((draws.mean(0) - mean) / deviation, 0, atol=within)
    np.testing.assert_allclose(draws.std(0) / deviation, 1, atol=within)
    return draws


@pytest.fixture(scope="module")
def network():
    """A network trained on simulations from all of Phi."""
    return network_of(linear)


@pytest.fixture(scope="module")
def posterior(network):
    """The posterior of X in BOX."""
    return condition(network, X, BOX)


def test_the_posterior_of_a_linear_gaussian_is_the_closed_form_in_the_box(posterior):
    mean, deviation, sample = exact(X)
    draws = agree(posterior, mean, deviation)
    assert BOX.contains(draws).all() and float(posterior.mass_inside) == 1
    for d in range(2):
        assert stats.ks_2samp(draws[:, d], sample[:, d]).statistic < 0.2
    low, high = BOX.low + 0.05 * BOX.width, BOX.high - 0.05 * BOX.width
    inner = np.mean(((draws > low) & (draws < high)).all(axis=1))
    assert inner < 0.97  # the box truncates it


def test_the_evidence_is_the_closed_form(posterior):
    """The integral of the likelihood over the box, relative to the normalised summaries."""
    axes = [np.linspace(BOX.low[d], BOX.high[d], 401) for d in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    likelihood = np.exp(stats.norm(grid @ MIXING.T, NOISE).logpdf(X).sum(1))
    integral = np.log(likelihood.mean() * np.prod(BOX.width))
    normaliser = posterior.density.network.normaliser
    scale = np.asarray(normaliser.scale * normaliser.unit)
    assert float(posterior.density.log_evidence) == pytest.approx(integral + np.log(scale).sum(), abs=0.2)


def test_the_prior_of_the_task_counts(network):
    agree(condition(network.replace(prior=Normal()), X, BOX), *exact(X, prior=True)[:2])


def test_what_was_proposed_does_not_matter(posterior):
    """70 % of the simulations are drawn around a point 1.5 posterior standard deviations from the posterior's mean.

    An estimator of the posterior would need a correction: multiplied by the density of these proposals, its posterior
    would be too narrow and shifted towards them.
    """
    mean, deviation, _ = exact(X)
    rng = np.random.default_rng(3)
    near = rng.normal(mean + [1.5, -1.5] * deviation, deviation, (ROWS, 2)).clip(PHI.low, PHI.high)
    skewed = np.where(rng.uniform(size=(ROWS, 1)) < 0.7, near, rng.uniform(PHI.low, PHI.high, (ROWS, 2)))
    agree(condition(network_of(linear, 3, skewed), X, BOX), mean, deviation, within=0.6)


def test_on_another_box_it_is_found_anew(posterior):
    wide = posterior.on(PHI)
    draws = np.asarray(wide.sample(jax.random.key(1), 1000))
    assert not BOX.contains(draws).all()
    inside = draws[np.asarray(BOX.contains(draws))]
    mean, deviation, _ = exact(X)
    np.testing.assert_allclose((inside.mean(0) - mean) / deviation, 0, atol=0.25)
    # On part of the box, the density is that on the whole box, divided by the mass in the part.
    theta = np.asarray(BOX.centre)
    ratio = float(posterior.log_prob(theta) - wide.log_prob(theta))
    assert ratio == pytest.approx(-np.log(len(inside) / len(draws)), abs=0.15)


def test_both_signs_of_a_square_are_found():
    """x = (theta_1^2, theta_2) with noise."""
    square = lambda theta, rng: theta ** np.array([2, 1]) + 0.3 * rng.normal(size=theta.shape)
    draws = np.asarray(condition(network_of(square, 1), np.array([4.0, 0.5]), PHI).sample(jax.random.key(1), 1000))
    right = draws[:, 0] > 0
    assert 0.25 < right.mean() < 0.75
    for sign, rows in ((1, right), (-1, ~right)):
        assert draws[rows, 0].mean() == pytest.approx(2 * sign, abs=0.2)
        assert 0.04 < draws[rows, 0].std() < 0.25
    assert draws[:, 1].std() == pytest.approx(0.3, rel=0.35)


def test_summaries_that_hardly_vary_do_not_make_it_spuriously_sharp():
    """Without noise in the simulator, the errors for a dozen truths are not larger than the posteriors' widths."""
    exactly = lambda theta, rng: linear(theta, rng, np.zeros(2))
    network = network_of(exactly, 2, noise_floor=0.05)
    truths = np.random.default_rng(7).uniform([-2.0, -2.0], [2.0, 2.0], (12, 2))
    z = []
    for x, truth in zip(linear(truths, np.random.default_rng(0), np.zeros(2)), truths, strict=True):
        draws = np.asarray(condition(network, x, PHI).sample(jax.random.key(1), 1000))
        z.append((truth - draws.mean(0)) / draws.std(0))
    assert np.mean(np.abs(z) < 2) > 0.8
    assert 0.02 < draws.std(0).max() < 0.4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loss": "atomic"}, r"^loss: expected 'likelihood' for MixtureLikelihood, got 'atomic'$"),
        ({"embedding": "mlp"}, r"^embedding: expected 'none' for MixtureLikelihood"),
        ({"noise_floor": -0.1}, r"^noise_floor: expected a number in \[0, 1\]"),
        ({"particles": 1}, r"^particles: expected a whole number"),
    ],
)
def test_what_cannot_work_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        ESTIMATOR.replace(**changes).check()
