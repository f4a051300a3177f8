"""A task's own prior: sequential rounds keep it in the posterior, whatever they propose."""

import dataclasses
import functools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi import METHODS, QUICK, infer
from jaxlfi.bayessim import algorithm
from jaxlfi.distributions.belief import RESTRICTIONS, Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import product
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.heuristics import Fixed
from tests.small import settings, whole_runs  # noqa: F401 - a fixture

CENTRE, DEVIATION = np.array([-1.0, 0.5], np.float32), np.array([0.3, 0.6], np.float32)
PRIOR = distrax.MultivariateNormalDiag(jnp.asarray(CENTRE), jnp.asarray(DEVIATION))
PLAIN = gaussian_linear.task()
X = jnp.asarray(gaussian_linear.MIXING @ np.array([0.2, -0.6], np.float32))

BELIEF = Belief(
    GaussianMixture(jnp.zeros(1), jnp.array([[-0.4, 0.2]]), jnp.array([[[0.3, 0.0], [0.1, 0.4]]])),
    Support([-10.0, -10.0], [10.0, 10.0]),
    jnp.asarray(True),
)

_propose = jax.jit(algorithm.propose, static_argnums=1)
_product = jax.jit(lambda a, b: product(a, b)[0])


def gaussian(mean, covariance) -> GaussianMixture:
    return GaussianMixture(np.zeros(1, np.float32), np.float32([mean]), np.float32([np.linalg.cholesky(covariance)]))


AS_MIXTURE = gaussian(CENTRE, np.diag(DEVIATION**2))


@functools.cache
def task():
    """The Gaussian task with that prior, which is checked when it is made."""
    return dataclasses.replace(PLAIN, prior=PRIOR)


@functools.cache
def exact() -> GaussianMixture:
    """The posterior of X under that prior."""
    return _product(jax.jit(gaussian_linear.posterior)(X), AS_MIXTURE)


def many(restriction):
    """Settings of 4000 proposals, with one program per restriction."""
    return settings(inflation=2.0, restriction=restriction, simulation_budget=4000)


@functools.cache
@jax.jit
def wide_times_prior():
    """Mean and covariance of the proposals."""
    expected, _ = product(BELIEF.mixture.inflated(2.0), AS_MIXTURE)
    return expected.mean, expected.covariance


@pytest.mark.slow
@pytest.mark.parametrize("restriction", ["clip", "reject", "mixed"])
def test_proposals_are_the_wide_posterior_times_the_prior(restriction, key):
    theta = np.asarray(_propose(key, task().inference.prior, many(restriction), BELIEF))
    mean, covariance = wide_times_prior()
    for d in range(2):
        marginal = stats.norm(float(mean[d]), np.sqrt(float(covariance[d, d])))
        # 4,000 of 128,000 without replacement, of which about a fifth are likely: nearly independent
        assert stats.kstest(theta[:, d], marginal.cdf).pvalue > 1e-3


@pytest.mark.parametrize(  # test_belief.py tests draws of the others
    "restriction", [pytest.param(one, marks=[pytest.mark.slow] * (one != QUICK.restriction)) for one in RESTRICTIONS]
)
def test_they_stay_in_the_support(restriction, key):
    box = Support([-0.5, 0.0], [0.5, 0.3])
    theta = np.asarray(_propose(key, task().inference.prior, many(restriction), BELIEF.replace(support=box)))
    assert theta.shape == (4000, 2) and ((theta >= np.asarray(box.low)) & (theta <= np.asarray(box.high))).all()


ACCOUNTING = {
    "importance": settings(correction="importance", inflation=2.0),
    "paper": settings(correction="paper"),
    "one round": settings(rounds=1),
    "apt": METHODS["apt"](QUICK),
    "npe": METHODS["npe"](QUICK),
    "snle": METHODS["snle"](QUICK),
}
"""Settings under which a posterior keeps the prior, whatever was proposed."""


def test_settings_say_whether_they_account_for_the_prior():
    assert all(one.includes_prior for one in ACCOUNTING.values()) and not settings().includes_prior


@pytest.mark.parametrize(
    "accounting",
    [pytest.param(one, marks=[pytest.mark.slow] * (name != "importance")) for name, one in ACCOUNTING.items()],
    ids=ACCOUNTING,
)
def test_what_accounts_for_the_prior_by_itself_proposes_as_without_one(accounting, key):
    accounting = accounting.replace(defensive=0.0)
    theta = [_propose(jax.random.clone(key), own.inference.prior, accounting, BELIEF) for own in (task(), PLAIN)]
    np.testing.assert_array_equal(*theta)


def test_rounds_settle_at_the_exact_mean_and_three_quarters_of_the_variance():
    likelihood = gaussian_linear.posterior(X)
    q = likelihood
    for _ in range(40):
        q = _product(likelihood, _product(q.inflated(2.0), AS_MIXTURE))
    np.testing.assert_allclose(q.mean, exact().mean, atol=1e-4)
    np.testing.assert_allclose(q.covariance, 0.75 * exact().covariance, rtol=1e-3)


@pytest.mark.slow
def test_a_sequential_run_keeps_the_prior():
    """The median of five runs counts; without the prior, the mean would be the likelihood's, three deviations away."""
    network = MixtureNetwork(
        hidden=(16,),
        components=1,
        epochs=0,
        steps=600,
        batch_size=100,
        learning_rate=5e-3,
        schedule="cosine",
        warm_start=False,
    )
    sequential = settings(
        estimator=network,
        rounds=6,
        simulations_per_round=200,
        simulation_budget=200,
        inflation=2.0,
        restriction="mixed",
    )
    run = lambda key: algorithm.run(key, task(), sequential, Fixed(), X, task().support("ok"), lambda *_: ())[0].belief
    mixtures = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(3), 5)).mixture
    deviation = np.sqrt(np.diag(exact().covariance))
    off = (np.median(jax.vmap(lambda mixture: mixture.mean)(mixtures), axis=0) - exact().mean) / deviation
    without = (np.asarray(gaussian_linear.posterior(X).mean) - exact().mean) / deviation
    assert np.abs(off).max() < 0.5 and np.abs(without).max() > 2.0


class Disc:
    """A prior that is uniform over a disc about the origin, and zero beyond."""

    def sample(self, *, seed, sample_shape):
        key_radius, key_angle = jax.random.split(seed)
        radius = jnp.sqrt(jax.random.uniform(key_radius, (sample_shape,)))
        angle = 2 * jnp.pi * jax.random.uniform(key_angle, (sample_shape,))
        return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle)], axis=-1)

    def log_prob(self, value):
        return jnp.where(jnp.sum(value**2, axis=-1) <= 1, -jnp.log(jnp.pi), jnp.nan)


@functools.cache
def bounded():
    """The Gaussian task with that prior."""
    return dataclasses.replace(PLAIN, prior=Disc())


PLAIN_PAIRS = [(restriction, "none") for restriction in RESTRICTIONS]
# Draws from the prior itself need no correction, and settings with one are refused.
WEIGHTED_PAIRS = [
    pytest.param(restriction, "importance", marks=pytest.mark.slow)
    for restriction in RESTRICTIONS
    if restriction != "prior"
]


@pytest.mark.parametrize(("restriction", "correction"), [*PLAIN_PAIRS, *WEIGHTED_PAIRS])
def test_nothing_is_proposed_where_the_prior_is_zero(restriction, correction, key):
    """Half of one mixture and all of another lie where the prior is zero; every correction passes."""
    drawn = settings(inflation=2.0, restriction=restriction, correction=correction, simulation_budget=500)
    for shift in (0.0, 8.0):
        belief = BELIEF.replace(mixture=BELIEF.mixture.affine(jnp.ones(2), jnp.full(2, shift)))
        theta = np.asarray(_propose(jax.random.clone(key), bounded().inference.prior, drawn, belief))
        assert theta.shape == (500, 2) and (np.sum(theta**2, axis=1) <= 1).all()
        assert len(np.unique(theta, axis=0)) > 400


@pytest.mark.slow
@pytest.mark.parametrize("method", ["bayessim", "snle"])
def test_a_run_stays_where_its_prior_is_not_zero(method):
    """Proposals, draws and the mode are inside the disc, and the density over it integrates to one."""
    small = METHODS[method](QUICK)
    estimator = small.estimator.replace(hidden=(16,), epochs=0, steps=100, ensemble_size=2)
    quick = small.replace(estimator=estimator, rounds=3, min_rounds=0, predictive=False)
    observed = gaussian_linear.MIXING @ np.array([1.5, 0.5], np.float32)  # beyond the disc
    run = infer(jax.random.key(0), bounded(), observed, support="ok", heuristic=Fixed(), settings=quick)
    proposed = run.history["theta"][np.asarray(run.history["counted"], bool)]
    draws = np.asarray(run.posterior.sample(jax.random.key(1), 2000))
    for theta in (proposed, draws, run.posterior.map()[None]):
        assert (np.sum(np.asarray(theta) ** 2, axis=1) <= 1 + 1e-6).all()
    axis = np.linspace(-1.05, 1.05, 301, dtype=np.float32)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    density = np.exp(np.asarray(run.posterior.log_prob(grid), float))
    assert density.sum() * (axis[1] - axis[0]) ** 2 == pytest.approx(1, abs=0.1)
    assert (density[np.sum(grid**2, axis=-1) > 1] == 0).all()
