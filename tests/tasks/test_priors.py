"""Priors of a task in either space, and TailedUniform against SciPy."""

import dataclasses
import functools
import itertools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats
from tensorflow_probability.substrates.jax import distributions as tfd

import jaxlfi
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.tasks.observation import simulate_observation
from jaxlfi.tasks.priors import MIN_INSIDE, prior_draws, prior_mass, require_mass
from jaxlfi.tasks.tailed_uniform import TailedUniform, with_tails
from jaxlfi.tasks.task import Task
from tests import small

LOW, HIGH, SIGMA = np.array([-3.0, 0.5, -0.1]), np.array([2.0, 0.6, 4.0]), np.array([1.0, 0.03, 0.41])
"""Three boxes of unlike place, width and tails."""


def prior(*dims: int) -> TailedUniform:
    """The prior over some of the three dimensions."""
    return TailedUniform(*(jnp.asarray(part[list(dims)], jnp.float32) for part in (LOW, HIGH, SIGMA)))


PRIOR = prior(0, 1, 2)
LOG_PROB = jax.jit(PRIOR.log_prob)
SAMPLE = jax.jit(lambda key: PRIOR.sample(seed=key, sample_shape=(20_000,)))


@functools.partial(jax.jit, static_argnums=(1, 3))
def drawn(key, prior, box, n):
    """Draws in a box, as one program."""
    return prior_draws(key, prior, box, n)


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
    log_prob = jax.jit(prior(d).log_prob)
    density = lambda x: np.exp(np.asarray(log_prob(x[:, None].astype(np.float32)), np.float64))
    ends = LOW[d] - 8 * SIGMA[d], LOW[d], HIGH[d], HIGH[d] + 8 * SIGMA[d]
    grids = [np.linspace(*pair, 2001) for pair in itertools.pairwise(ends)]
    masses = [integrate.simpson(density(grid), x=grid) for grid in grids]
    assert sum(masses) == pytest.approx(1, rel=1e-4)
    np.testing.assert_allclose(np.cumsum(masses), [cdf(end, d) for end in ends[1:]], rtol=1e-4)


def test_dimensions_are_independent():
    theta = np.float32([[0.0, 0.55, 1.0], [-5.0, 0.7, 9.0], [3.0, 0.5, -1.0]])
    parts = [jax.jit(prior(d).log_prob)(theta[:, d : d + 1]) for d in range(3)]
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


# ------------------------------------------------------------------------------------------- priors of a task


def simulate(key, theta):
    return theta


def decade(prior=None, prior_space="natural") -> Task:
    """A parameter that is inferred as its logarithm, beside one that is not."""
    box = Support([0.1, -3.0], [20.0, 3.0])
    return Task(simulate, ("rate", "shift"), {"box": box}, box, log=("rate",), prior=prior, prior_space=prior_space)


class _Exp(distrax.Bijector):
    """The exponential of the first of two numbers."""

    def __init__(self):
        super().__init__(event_ndims_in=1)

    def forward_and_log_det(self, x):
        return jnp.stack([jnp.exp(x[..., 0]), x[..., 1]], axis=-1), x[..., 0]

    def inverse_and_log_det(self, y):
        return jnp.stack([jnp.log(y[..., 0]), y[..., 1]], axis=-1), -jnp.log(y[..., 0])


LOCATION, SCALES = np.array([0.7, -0.5]), np.array([0.4, 1.0])
INNER = distrax.MultivariateNormalDiag(jnp.asarray(LOCATION, jnp.float32), jnp.asarray(SCALES, jnp.float32))
"""Over inference space: normal in ln rate and in shift."""
NATURAL = distrax.Transformed(INNER, _Exp())
"""The same distribution over natural units: log-normal in rate."""


def test_a_log_normal_prior_is_the_same_from_either_space(key):
    """The same density over inference space, and the same draws by the same key."""
    natural, inner = decade(NATURAL).inference.prior, decade(INNER, "inference").inference.prior
    assert inner.distribution is INNER and inner.space is None
    theta = jnp.array([[0.7, -0.5], [0.0, 1.0], [2.0, -2.5]])
    np.testing.assert_allclose(jax.jit(natural.log_prob)(theta), jax.jit(inner.log_prob)(theta), rtol=1e-5, atol=1e-5)
    support = decade().support()
    draws, same = (np.asarray(drawn(jax.random.clone(key), prior, support, 4000)) for prior in (natural, inner))
    np.testing.assert_allclose(draws, same, rtol=1e-4, atol=1e-5)
    low, high = (np.asarray(bound) for bound in (support.low, support.high))
    for d in range(2):
        ends = (np.array([low[d], high[d]]) - LOCATION[d]) / SCALES[d]
        assert stats.kstest(draws[:, d], stats.truncnorm(*ends, LOCATION[d], SCALES[d]).cdf).pvalue > 1e-3


def test_a_prior_over_natural_units_is_transformed_with_its_jacobian():
    """A normal one over natural units, in ln rate: density times rate; it integrates to the same mass."""
    normal = distrax.MultivariateNormalDiag(jnp.array([3.0, 0.0]), jnp.array([1.0, 1.0]))
    inner = decade(normal).inference.prior
    theta = np.array([[np.log(2.5), 0.3], [0.0, -1.0]], np.float32)
    expected = stats.norm(3, 1).logpdf(np.exp(theta[:, 0])) + theta[:, 0] + stats.norm.logpdf(theta[:, 1])
    np.testing.assert_allclose(jax.jit(inner.log_prob)(theta), expected, rtol=1e-4)
    # Without any logarithm there is nothing to transform.
    plain = dataclasses.replace(decade(normal), log=())
    assert plain.inference.prior.distribution is normal and plain.inference.prior.space is None


def test_draws_that_have_no_logarithm_are_in_no_support(key):
    """Half of this prior's rates are negative: they are rejected, not moved."""
    half = distrax.MultivariateNormalDiag(jnp.array([0.0, 0.0]), jnp.array([5.0, 1.0]))
    task = decade(half)
    draws = np.asarray(drawn(key, task.inference.prior, task.support(), 2000))
    assert np.isfinite(draws).all() and (draws >= task.support().low).all() and (draws <= task.support().high).all()
    assert stats.kstest(np.exp(draws[:, 0]), stats.truncnorm(0.02, 4.0, scale=5.0).cdf).pvalue > 1e-3
    expected = np.diff(stats.norm.cdf([0.02, 4.0]))[0] * np.diff(stats.norm.cdf([-3, 3]))[0]
    mass = jax.jit(functools.partial(prior_mass, task.inference.prior))
    assert float(mass(task.support())) == pytest.approx(expected, abs=0.025)


def test_draws_of_a_prior_are_kept_in_the_support():
    """Half of the prior's mass is outside in one dimension, nearly all of it in another box."""
    normal = distrax.MultivariateNormalDiag(jnp.array([0.0, 2.0]), jnp.array([1.0, 0.5]))
    for box in (Support([0.0, -2.0], [1.0, 3.0]), Support([-2.0, -5.0], [-1.9, -4.0])):
        for seed in range(5):
            draws = np.asarray(drawn(jax.random.key(seed), normal, box, 20))
            assert draws.shape == (20, 2) and (draws >= box.low).all() and (draws <= box.high).all()


def test_without_a_prior_draws_are_uniform(key):
    box = Support([0.0, -2.0], [1.0, 3.0])
    draws = np.asarray(prior_draws(key, None, box, 4000))
    for d, (low, width) in enumerate([(0.0, 1.0), (-2.0, 5.0)]):
        assert stats.kstest(draws[:, d], stats.uniform(low, width).cdf).pvalue > 1e-3
    assert float(prior_mass(None, box)) == 1.0 and require_mass(None, box, "box") == 1.0


def test_a_prior_with_next_to_no_mass_inside_is_refused():
    """As one in natural units is where it counts as one over logarithms; all draws would be uniform."""
    box = decade().support()
    elsewhere = distrax.MultivariateNormalDiag(jnp.array([40.0, 800.0]), jnp.array([0.05, 0.05]))
    for prior_space in ("natural", "inference"):
        prior = decade(elsewhere, prior_space).inference.prior
        with pytest.raises(
            ValueError, match=r"^prior: expected some of its mass inside the support 'box', got 0 of it"
        ):
            require_mass(prior, box, "'box'")
    mass = require_mass(INNER, box, "'box'")
    assert mass == pytest.approx(0.99, abs=0.02) and mass > MIN_INSIDE


def test_a_run_does_not_start_on_a_prior_outside_its_box():
    elsewhere = distrax.MultivariateNormalDiag(jnp.array([40.0, 800.0]), jnp.array([0.05, 0.05]))
    with pytest.raises(ValueError, match=r"^prior: expected some of its mass inside the support") as caught:
        jaxlfi.infer(jax.random.key(0), decade(elsewhere), jnp.array([1.0, 0.0]), settings=small.SETTINGS)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------- where a prior has no mass


class Disc:
    """Uniform over the unit disc; NaN beyond it, as by a user's own arithmetic."""

    def sample(self, *, seed, sample_shape):
        key_radius, key_angle = jax.random.split(seed)
        radius = jnp.sqrt(jax.random.uniform(key_radius, (sample_shape,)))
        angle = 2 * jnp.pi * jax.random.uniform(key_angle, (sample_shape,))
        return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle)], axis=-1)

    def log_prob(self, value):
        return jnp.where(jnp.sum(value**2, axis=-1) <= 1, -jnp.log(jnp.pi), jnp.nan)


class Triangle:
    """Uniform over positive numbers of a sum below 1; plus infinity elsewhere, which is no density either."""

    def sample(self, *, seed, sample_shape):
        ordered = jnp.sort(jax.random.uniform(seed, (sample_shape, 2)), axis=-1)
        return jnp.stack([ordered[:, 0], ordered[:, 1] - ordered[:, 0]], axis=-1)

    def log_prob(self, value):
        return jnp.where(jnp.all(value >= 0, axis=-1) & (jnp.sum(value, axis=-1) <= 1), jnp.log(2.0), jnp.inf)


def each(distribution) -> distrax.Distribution:
    """Independent ones as one over vectors."""
    return distrax.Independent(distribution, 1)


ONE = jnp.ones(1)
WIDE = Support([-1.0], [2.0])
PLANE = Support([-2.0, -2.0], [2.0, 2.0])
BOUNDED = {
    "gamma": (each(distrax.Gamma(2 * ONE, 4 * ONE)), WIDE, stats.gamma(2, scale=0.25)),
    "beta": (each(distrax.Beta(2 * ONE, 3 * ONE)), WIDE, stats.beta(2, 3)),
    "flat beta": (each(tfd.Beta(ONE, ONE)), WIDE, stats.uniform()),  # its log-density is 0 everywhere
    "exponential": (each(tfd.Exponential(4 * ONE)), WIDE, stats.expon(scale=0.25)),  # its density is largest below 0
    "log-normal": (each(tfd.LogNormal(0 * ONE, 0.5 * ONE)), WIDE, stats.lognorm(0.5)),
    "half-normal": (tfd.Independent(tfd.HalfNormal(ONE), 1), WIDE, stats.halfnorm()),
    "truncated normal": (
        each(tfd.TruncatedNormal(0.2 * ONE, ONE, 0 * ONE, ONE)),
        WIDE,
        stats.truncnorm(-0.2, 0.8, 0.2),
    ),
    "disc": (Disc(), PLANE, None),
    "triangle": (Triangle(), PLANE, None),
}


ALIKE = ("gamma", "beta", "log-normal", "half-normal", "truncated normal")
"""Those that say minus infinity or NaN where they are zero, as "exponential", "disc" and "triangle" do not."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ALIKE)) for name in BOUNDED])
def test_no_draw_lies_where_a_prior_is_zero(name, key):
    prior, box, law = BOUNDED[name]
    task = Task(simulate, ("a", "b")[: box.dim], {"box": box}, box, prior=prior)
    log_prob = jax.jit(task.inference.prior.log_prob)
    grid = np.random.default_rng(0).uniform(box.low, box.high, (2000, box.dim)).astype(np.float32)
    density = np.asarray(log_prob(grid))
    assert not np.isnan(density).any() and not np.isposinf(density).any() and np.isneginf(density).any()
    draws = np.asarray(drawn(key, task.inference.prior, box, 2000))
    assert np.isfinite(log_prob(draws)).all()
    if law is not None:
        inside = law.cdf(2.0)
        np.testing.assert_allclose(density, law.logpdf(grid[:, 0]), rtol=1e-4, atol=1e-4)
        assert stats.kstest(draws[:, 0], lambda x: law.cdf(x) / inside).pvalue > 1e-3


def test_a_tenth_of_a_percent_of_a_prior_is_drawn_from_by_its_density(key):
    """Where rejection finds nothing: neither uniform, nor where the prior is zero."""
    gamma = each(distrax.Gamma(2 * ONE, 4 * ONE))
    law = stats.gamma(2, scale=0.25)
    box = Support([2.5], [3.5])
    draws = np.asarray(drawn(key, gamma, box, 4000))[:, 0]
    inside = law.cdf(3.5) - law.cdf(2.5)
    assert inside < 1e-3
    assert stats.kstest(draws, lambda x: (law.cdf(x) - law.cdf(2.5)) / inside).statistic < 0.05
    below = drawn(jax.random.clone(key), gamma, Support([-1000.0], [0.02]), 4000)
    assert (np.asarray(below) > 0).all()


class Drawn:
    """A prior by a function of a key and a number of draws, of any density."""

    def __init__(self, draw, dim=1):
        self.draw, self.dim = draw, dim

    def sample(self, *, seed, sample_shape):
        return self.draw(seed, (sample_shape, self.dim))

    def log_prob(self, value):
        return jnp.sum(-0.5 * value**2, axis=-1)


def spiked(key, shape):
    """Standard normal, but for one draw in twenty."""
    key_choice, key_value = jax.random.split(key)
    return jnp.where(jax.random.uniform(key_choice, shape) < 0.05, 0.25, jax.random.normal(key_value, shape))


def half_whole(key, shape):
    """A continuous number beside a whole one."""
    key_whole, key_value = jax.random.split(key)
    whole = jax.random.randint(key_whole, shape[:1], 0, 4).astype(jnp.float32)
    return jnp.stack([jax.random.normal(key_value, shape[:1]), whole], axis=-1)


@pytest.mark.parametrize(
    ("prior", "why"),
    [
        (Drawn(lambda key, shape: jax.random.randint(key, shape, 1, 21) / 1.0), r"whole numbers for a:.*\[0.5, 20.5\]"),
        (Drawn(lambda key, shape: jax.random.randint(key, shape, 1, 21)), r"whole numbers for a"),
        (Drawn(lambda key, shape: 0.1 * jax.random.randint(key, shape, 0, 11)), r"again and again for a"),
        (Drawn(spiked), r"draws 0.25 again and again for a"),
        (Drawn(lambda key, shape: jnp.full(shape, 0.5)), r"always draws 0.5 for a"),
        (Drawn(half_whole, 2), r"whole numbers for b"),
        (Drawn(lambda key, shape: jax.random.uniform(key, shape, minval=-1.0)), r"-inf where it never draws.* at a = "),
        (each(tfd.Poisson(3 * ONE)), r"whole numbers for a"),
    ],
    ids=["whole", "integers", "steps", "spike", "constant", "mixed", "elsewhere", "poisson"],
)  # fmt: skip
def test_what_has_no_density_over_the_parameters_is_refused(prior, why):
    dim = getattr(prior, "dim", 1)
    box = Support([-6.0] * dim, [20.0] * dim)
    with pytest.raises(ValueError, match=f"^prior: .*{why}") as caught:
        Task(simulate, ("a", "b")[:dim], {"box": box}, box, prior=prior)
    assert "\n" not in str(caught.value)


def test_draws_without_a_density_of_their_own_are_refused():
    elsewhere = Drawn(lambda key, shape: jax.random.uniform(key, shape))
    elsewhere.log_prob = lambda value: jnp.where((value > 1) & (value < 2), 0.0, -jnp.inf)[..., 0]
    with pytest.raises(ValueError, match=r"^prior: expected a finite log-density at its own draws"):
        Task(simulate, ("a",), {"box": WIDE}, WIDE, prior=elsewhere)


@pytest.mark.parametrize(
    ("prior", "box"),
    [
        (each(distrax.Normal(0 * ONE, 1e-4 * ONE)), WIDE),
        (each(distrax.Normal(1000 * ONE, 1e-3 * ONE)), Support([900.0], [1100.0])),  # rounding makes many draws equal
        (each(distrax.Uniform(1e9 * ONE, 2e9 * ONE)), Support([1e8], [1e10])),  # every float32 there is whole
        (each(tfd.StudentT(1.5, 0 * ONE, ONE)), Support([-1e3], [1e3])),
    ],
    ids=["narrow", "offset", "large", "heavy"],
)
def test_unusual_continuous_priors_are_taken(prior, box):
    assert Task(simulate, ("a",), {"box": box}, box, prior=prior).prior is prior


def test_an_equal_prior_of_another_task_is_the_same():
    """Or programs would be compiled anew for every task that is made again."""
    twice = jnp.ones(2)
    one, other = (decade(each(distrax.Gamma(2 * twice, twice))).inference.prior for _ in range(2))
    different = decade(each(distrax.Gamma(3 * twice, twice))).inference.prior
    assert one is not other and one == other and hash(one) == hash(other) and one != different


# ------------------------------------------------------------------------------------------------ tailed priors


def test_the_first_round_is_drawn_from_the_box_and_its_tails(key):
    task = with_tails(gaussian_linear.task(), "misspecified", tail=0.2)
    draws = np.asarray(drawn(key, task.inference.prior, task.support(), 4000), np.float64)
    height, sigma = 1 / (3 + 0.6 * np.sqrt(2 * np.pi)), 0.6  # of the first dimension, whose box is [-3, 0]
    beyond = draws[draws[:, 0] > 0, 0]
    assert abs(beyond.size / 4000 - height * sigma * np.sqrt(np.pi / 2)) < 5 * 0.5 / np.sqrt(4000)
    assert stats.kstest(beyond / sigma, stats.halfnorm.cdf).pvalue > 1e-3
    feasible = task.inference.feasible
    assert (draws >= feasible.low).all() and (draws <= feasible.high).all()


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
    np.testing.assert_allclose(
        task.inference.prior.log_prob(theta) - task.inference.prior.log_prob(inside), -2.0, rtol=1e-4
    )
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
    with pytest.raises(ValueError, match=r"^support: expected one of \['guess', 'wide'\] or a box .* got 'x'"):
        with_tails(logarithmic(), "x")
