"""TailedUniform against SciPy, and tasks whose first round is drawn from it."""

import itertools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from envs import gaussian_linear
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.observation import simulate_observation
from jaxlfi.tasks.priors import MIN_INSIDE, TailedUniform, prior_draws, prior_mass, require_mass, with_tails
from jaxlfi.tasks.task import Task

LOW, HIGH, SIGMA = np.array([-3.0, 0.5, -0.1]), np.array([2.0, 0.6, 4.0]), np.array([1.0, 0.03, 0.41])
"""Three boxes of unlike place, width and tails."""


def prior(*dims: int) -> TailedUniform:
    """The prior over some of the three dimensions."""
    return TailedUniform(*(jnp.asarray(part[list(dims)], jnp.float32) for part in (LOW, HIGH, SIGMA)))


PRIOR = prior(0, 1, 2)
LOG_PROB = jax.jit(PRIOR.log_prob)
SAMPLE = jax.jit(lambda key: PRIOR.sample(seed=key, sample_shape=(20_000,)))


def cdf(x, d):
    """The distribution function in closed form: half of a normal, a ramp, and the other half."""
    height = 1 / (HIGH[d] - LOW[d] + SIGMA[d] * np.sqrt(2 * np.pi))
    half = height * SIGMA[d] * np.sqrt(2 * np.pi)
    return (
        half * stats.norm.cdf(np.minimum(x - LOW[d], 0) / SIGMA[d])
        + height * (np.clip(x, LOW[d], HIGH[d]) - LOW[d])
        + half * (stats.norm.cdf(np.maximum(x - HIGH[d], 0) / SIGMA[d]) - 0.5)
    )


@pytest.mark.parametrize("d", range(3))
def test_the_density_integrates_to_the_distribution_function(d):
    density = lambda x: np.exp(np.asarray(prior(d).log_prob(x[:, None].astype(np.float32)), np.float64))
    ends = LOW[d] - 8 * SIGMA[d], LOW[d], HIGH[d], HIGH[d] + 8 * SIGMA[d]
    grids = [np.linspace(*pair, 2001) for pair in itertools.pairwise(ends)]
    masses = [integrate.simpson(density(grid), x=grid) for grid in grids]
    assert sum(masses) == pytest.approx(1, rel=1e-4)
    np.testing.assert_allclose(np.cumsum(masses), [cdf(end, d) for end in ends[1:]], rtol=1e-4)


def test_dimensions_are_independent():
    theta = np.float32([[0.0, 0.55, 1.0], [-5.0, 0.7, 9.0], [3.0, 0.5, -1.0]])
    parts = [prior(d).log_prob(theta[:, d : d + 1]) for d in range(3)]
    np.testing.assert_allclose(LOG_PROB(theta), sum(parts), rtol=1e-5)


def test_the_density_is_continuous_and_its_slope_too():
    for bound, outwards in ((LOW, -1), (HIGH, 1)):
        for d in range(3):
            step = np.zeros(3)
            step[d] = outwards * 1e-3 * SIGMA[d]
            at, inside, outside = (np.asarray(LOG_PROB((bound + k * step).astype(np.float32))) for k in (0, -1, 1))
            np.testing.assert_allclose(inside, at, atol=1e-6)
            np.testing.assert_allclose(outside, at, atol=2e-6)
    slope = jax.jit(jax.grad(PRIOR.log_prob))(jnp.asarray(HIGH + 2 * SIGMA, jnp.float32))
    np.testing.assert_allclose(slope, -2 / SIGMA, rtol=1e-4)


def test_draws_have_the_closed_form_in_every_dimension(key):
    draws = np.asarray(SAMPLE(key), np.float64)
    assert draws.shape == (20_000, 3)
    for d in range(3):
        assert stats.kstest(draws[:, d], lambda x, d=d: cdf(x, d)).pvalue > 1e-3
        for beyond in (LOW[d] - draws[:, d], draws[:, d] - HIGH[d]):
            tail = beyond[beyond > 0] / SIGMA[d]
            share = cdf(LOW[d], d)
            assert abs(tail.size - 20_000 * share) < 5 * np.sqrt(20_000 * share)
            assert stats.kstest(tail, stats.halfnorm.cdf).pvalue > 1e-3
    assert np.abs(np.corrcoef(draws.T)[np.triu_indices(3, 1)]).max() < 5 / np.sqrt(20_000)


def test_it_is_a_distrax_distribution(key):
    assert isinstance(PRIOR, distrax.Distribution)
    assert PRIOR.event_shape == (3,) and PRIOR.batch_shape == ()
    theta, log_prob = PRIOR.sample_and_log_prob(seed=key, sample_shape=(4, 2))
    assert theta.shape == (4, 2, 3) and log_prob.shape == (4, 2)
    np.testing.assert_allclose(log_prob, LOG_PROB(theta), rtol=1e-6)
    np.testing.assert_allclose(log_prob[1, 1], LOG_PROB(theta[1, 1]), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda prior, x: prior.log_prob(x))(PRIOR, theta), log_prob, rtol=1e-6)


# ------------------------------------------------------------------------------------------------------- tasks


def test_the_first_round_is_drawn_from_the_box_and_its_tails(key):
    task = with_tails(gaussian_linear.task(), "misspecified", tail=0.2)
    draws = np.asarray(prior_draws(key, task.inference.prior, task.support(), 4000), np.float64)
    height, sigma = 1 / (3 + 0.6 * np.sqrt(2 * np.pi)), 0.6  # of the first dimension, whose box is [-3, 0]
    beyond = draws[draws[:, 0] > 0, 0]
    assert abs(beyond.size / 4000 - height * sigma * np.sqrt(np.pi / 2)) < 5 * 0.5 / np.sqrt(4000)
    assert stats.kstest(beyond / sigma, stats.halfnorm.cdf).pvalue > 1e-3
    assert bool(task.inference.feasible.contains(jnp.asarray(draws, jnp.float32)).all())


def test_only_prior_and_support_change():
    plain = gaussian_linear.task()
    task = with_tails(plain, "misspecified")
    assert list(task.supports) == ["tailed"]
    for mine, its in ((task.supports["tailed"], plain.feasible), (task.feasible, plain.feasible)):
        np.testing.assert_array_equal(mine.low, its.low)
        np.testing.assert_array_equal(mine.high, its.high)
    np.testing.assert_array_equal(task.truth, plain.truth)
    for field in ("simulate", "summary", "names", "units", "failures", "channels", "name"):
        assert getattr(task, field) == getattr(plain, field)
    assert plain.prior is None
    np.testing.assert_array_equal(
        simulate_observation(jax.random.key(3), task), simulate_observation(jax.random.key(3), plain)
    )


def logarithmic() -> Task:
    """A parameter of a decade's width that is inferred as a logarithm, beside one that is not."""
    return Task(
        lambda key, theta: theta,
        ("gain", "rate"),
        {"guess": Support([0.0, 1.0], [2.0, 10.0]), "wide": Support([-9.0, 0.01], [2.0, 1e4])},
        Support([-5.0, 0.1], [5.0, 100.0]),
        truth=[0.5, 3.0],
        log=("rate",),
    )


def test_logarithmic_parameters_have_their_tails_in_inference_space():
    plain = logarithmic()
    task = with_tails(plain, "guess", tail=0.1)
    np.testing.assert_allclose(task.inference.feasible.low, [-5.0, np.log(0.1)], rtol=1e-6)
    np.testing.assert_array_equal(task.truth, plain.truth)
    assert task.log == ("rate",) and task.prior_space == "inference"
    decade = np.log(10.0)
    theta = jnp.array([1.0, decade + 0.2 * decade])  # two tails' scales beyond the rate's upper bound
    inside = jnp.array([1.0, 1.0])
    np.testing.assert_allclose(task.inference.prior.log_prob(theta) - task.inference.prior.log_prob(inside), -2.0, rtol=1e-4)
    own = with_tails(plain, plain.supports["guess"], tail=0.1)  # a box of natural units
    np.testing.assert_array_equal(own.prior.log_prob(theta), task.prior.log_prob(theta))


def test_a_box_wider_than_phi_widens_the_support():
    task = with_tails(logarithmic(), "wide")
    np.testing.assert_allclose(task.supports["tailed"].low, [-9.0, 0.01], rtol=1e-5)
    np.testing.assert_allclose(task.support().low, [-9.0, np.log(0.01)], rtol=1e-5)
    np.testing.assert_allclose(task.support().high, [5.0, np.log(1e4)], rtol=1e-5)


@pytest.mark.parametrize("tail", [0.0, -0.1, float("nan")])
def test_a_tail_that_is_none_is_refused(tail):
    with pytest.raises(ValueError, match=r"^tail: expected a positive fraction of the width, got"):
        with_tails(logarithmic(), "guess", tail)


def test_an_unknown_support_is_named():
    with pytest.raises(ValueError, match=r"^support: expected one of \['guess', 'wide'\], got 'x'"):
        with_tails(logarithmic(), "x")
