"""Moments, quantiles, marginals and conditionals of a posterior: closed forms, quadrature and plain rejection."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import posterior as posteriors
from jaxlfi.estimators.density import EnsembleDensity
from jaxlfi.estimators.posterior import STATISTICS_DRAWS, Posterior, truncated
from tests import strategies

NAMES = ("a", "b", "c")
PLAIN, LOGS = Space(NAMES, (False,) * 3), Space(NAMES, (True, False, True))
MIXTURE = GaussianMixture(
    logits=jnp.asarray(np.log([0.7, 0.3]), jnp.float32),
    means=jnp.asarray([[0.2, -0.3, 0.5], [-0.6, 0.8, 0.1]]),
    scale_tril=jnp.asarray(
        [[[0.5, 0, 0], [0.4, 0.3, 0], [-0.2, 0.3, 0.4]], [[0.3, 0, 0], [-0.5, 0.4, 0], [0.1, 0.1, 0.6]]], jnp.float32
    ),
)
BOX = Support([-0.9, -1.0, -0.2], [0.9, 0.6, 1.1])
"""A box that cuts off half of the mixture, more in one dimension than in others."""
_truncated = jax.jit(truncated, static_argnums=3)


def posterior(mixture=MIXTURE, box=BOX, space=PLAIN) -> Posterior:
    return _truncated(mixture, mixture, box, space)


@functools.cache
def cut() -> Posterior:
    """The mixture in that box."""
    return posterior()


def components(mixture: GaussianMixture) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Weights, means and covariances in double precision."""
    factors = np.asarray(mixture.scale_tril, float)
    weights = np.exp(np.asarray(mixture.logits, float))
    return list(zip(weights / weights.sum(), np.asarray(mixture.means, float), factors @ factors.mT, strict=True))


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    """A large number of draws of the truncated mixture, by NumPy and plain rejection."""
    rng = np.random.default_rng(0)
    parts = components(MIXTURE)
    counts = rng.multinomial(2_000_000, [weight for weight, *_ in parts])
    draws = np.concatenate(
        [rng.multivariate_normal(mean, cov, n) for n, (_, mean, cov) in zip(counts, parts, strict=True)]
    )
    inside = np.all((draws >= np.asarray(BOX.low)) & (draws <= np.asarray(BOX.high)), axis=1)
    return draws[inside]


def test_the_box_cuts_much_off(drawn):
    assert 0.4 < len(drawn) / 2_000_000 < 0.6
    assert float(cut().mass_inside) == pytest.approx(len(drawn) / 2_000_000, abs=0.003)


@pytest.mark.parametrize("space", [PLAIN, LOGS], ids=["plain", "logs"])
def test_moments_are_those_of_plain_rejection(drawn, space):
    natural = np.where(np.array(space.log), np.exp(drawn), drawn)
    found = posterior(space=space)
    deviation, n = natural.std(axis=0), len(natural)
    # The lattice is within a few thousandths of a standard deviation; the draws within 5 of their own errors.
    np.testing.assert_allclose(found.mean(), natural.mean(axis=0), atol=deviation.max() * (0.003 + 5 / np.sqrt(n)))
    np.testing.assert_allclose(found.std(), deviation, rtol=0.006)
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(found.covariance() / scale, np.cov(natural.T) / scale, atol=0.01)
    np.testing.assert_allclose(found.std("inference"), drawn.std(axis=0), rtol=0.006)


@pytest.mark.parametrize("space", [PLAIN, LOGS], ids=["plain", "logs"])
def test_quantiles_are_those_of_plain_rejection(drawn, space):
    levels = np.array([0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99])
    inner = np.asarray(posterior(space=space).quantile(levels, "inference"), float)
    held = np.stack([(drawn[:, None, d] <= inner[:, d]).mean(axis=0) for d in range(3)], axis=1)
    np.testing.assert_allclose(held, np.tile(levels[:, None], 3), atol=0.002 + 5 * np.sqrt(0.25 / len(drawn)))
    natural = np.where(np.array(space.log), np.exp(inner), inner)
    np.testing.assert_allclose(posterior(space=space).quantile(levels), natural, rtol=1e-5)


def test_one_dimension_is_scipys_truncated_normal():
    for mean, scale in ((0.3, 0.5), (-2.0, 0.4), (0.0, 1e-4)):
        one = GaussianMixture(jnp.zeros(1), jnp.array([[mean]]), jnp.array([[[scale]]]))
        found, law = (
            posterior(one, Support([-0.5], [1.0]), Space(("a",), (False,))),
            stats.truncnorm((-0.5 - mean) / scale, (1.0 - mean) / scale, mean, scale),
        )
        levels = np.array([0.001, 0.05, 0.5, 0.95, 0.999])
        np.testing.assert_allclose(found.quantile(levels)[:, 0], law.ppf(levels), atol=1e-3 * law.std())
        np.testing.assert_allclose(found.mean(), law.mean(), atol=0.002 * law.std())
        np.testing.assert_allclose(found.std(), law.std(), rtol=0.004)
        np.testing.assert_allclose(found.interval(0.9)[:, 0], law.ppf([0.05, 0.95]), atol=1e-3 * law.std())


def bivariate(d: int, values: np.ndarray, mixture: GaussianMixture, box: Support) -> np.ndarray:
    """The marginal density of one of two parameters before it is normalised, in closed form."""
    other, total = 1 - d, 0.0
    for weight, mean, cov in components(mixture):
        slope = cov[other, d] / cov[d, d]
        law = stats.norm(mean[other] + slope * (values - mean[d]), np.sqrt(cov[other, other] - slope * cov[other, d]))
        share = law.cdf(float(box.high[other])) - law.cdf(float(box.low[other]))
        total = total + weight * stats.norm(mean[d], np.sqrt(cov[d, d])).pdf(values) * share
    return total


@pytest.mark.parametrize("d", [0, 1])
def test_a_bivariate_marginal_is_the_closed_form(d):
    two, box = MIXTURE.marginal((0, 1)), Support([-0.9, -0.2], [0.5, 0.6])
    found = posterior(two, box, Space(("a", "b"), (False, False)))
    low, high = float(box.low[d]), float(box.high[d])
    cells = low + (high - low) * (np.arange(20000) + 0.5) / 20000
    density = bivariate(d, cells, two, box)
    cdf = np.cumsum(density) / density.sum()
    levels = np.array([0.01, 0.1, 0.5, 0.9, 0.99])
    np.testing.assert_allclose(found.quantile(levels)[:, d], np.interp(levels, cdf, cells), atol=5e-4 * (high - low))
    marginal, points = found.marginal("ab"[d]), cells[::2000]
    expected = np.log(bivariate(d, points, two, box) / (density.sum() * (high - low) / 20000))
    np.testing.assert_allclose(marginal.log_prob(points[:, None]), expected, atol=0.02)  # the mass inside, on a lattice
    assert np.isneginf(marginal.log_prob([high + 0.1]))


def test_a_marginal_of_three_integrates_the_joint_density():
    cells, grid = 24, []
    for low, high in zip(np.asarray(BOX.low), np.asarray(BOX.high), strict=True):
        grid.append(low + (high - low) * (np.arange(cells) + 0.5) / cells)
    theta = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
    joint = np.exp(np.asarray(cut().log_prob(theta.astype(np.float32)), float))
    widths = np.asarray(BOX.width, float) / cells
    for names, axes in ((("a",), (1, 2)), (("c", "a"), (1,))):
        kept = [NAMES.index(name) for name in names]
        expected = joint.sum(axis=axes) * widths[list(axes)].prod()
        expected = expected if len(kept) == 1 else expected.T
        points = np.stack(np.meshgrid(*(grid[d] for d in kept), indexing="ij"), axis=-1).astype(np.float32)
        marginal = cut().marginal(names)
        np.testing.assert_allclose(np.exp(marginal.log_prob(points)), expected, rtol=0.05, atol=0.01)
        assert marginal.space.names == names and marginal.support.low.tolist() == [float(BOX.low[d]) for d in kept]


@pytest.mark.slow
def test_a_marginals_draws_and_statistics_are_those_of_the_whole(key):
    logs = posterior(space=LOGS)
    marginal = logs.marginal(["c", "a"])
    np.testing.assert_array_equal(marginal.sample(key, 50), logs.sample(jax.random.clone(key), 50)[:, [2, 0]])
    np.testing.assert_allclose(marginal.mean(), np.asarray(logs.mean())[[2, 0]])
    np.testing.assert_allclose(marginal.std(), np.asarray(logs.std())[[2, 0]])
    np.testing.assert_allclose(marginal.quantile([0.2, 0.9]), logs.quantile([0.2, 0.9])[:, [2, 0]])
    assert marginal.space == Space(("c", "a"), (True, True))
    again = marginal.marginal("a")
    np.testing.assert_allclose(again.interval(), logs.interval()[:, :1])
    np.testing.assert_allclose(logs.marginal(0).log_prob([1.1]), again.log_prob([1.1]))
    moved = marginal.on(Support([0.0, -0.5], [0.5, 0.5]))
    whole = logs.on(Support([-0.5, -1.0, 0.0], [0.5, 0.6, 0.5]))
    np.testing.assert_allclose(moved.mean(), np.asarray(whole.mean())[[2, 0]], rtol=1e-5)
    np.testing.assert_allclose(
        cut().marginal(NAMES).log_prob([0.1, 0.2, 0.3]), cut().log_prob([0.1, 0.2, 0.3]), rtol=1e-5
    )


def test_a_conditional_is_the_slice_of_the_joint_density():
    value = 0.3
    found = posterior(space=LOGS).conditional(b=value)
    assert found.space == Space(("a", "c"), (True, True)) and isinstance(found.density, GaussianMixture)
    a, c = (np.exp(np.linspace(float(BOX.low[d]) + 0.01, float(BOX.high[d]) - 0.01, 7)) for d in (0, 2))
    points = np.stack(np.meshgrid(a, c, indexing="ij"), axis=-1)
    joint = np.insert(points, 1, value, axis=-1).astype(np.float32)
    ratio = np.asarray(posterior(space=LOGS).log_prob(joint) - found.log_prob(points.astype(np.float32)))
    np.testing.assert_allclose(ratio, ratio[0, 0], atol=1e-4)  # equal to a slice, up to a constant
    # That constant is the marginal density of the value.
    np.testing.assert_allclose(ratio[0, 0], posterior(space=LOGS).marginal("b").log_prob([value]), atol=0.01)


def test_a_conditional_of_a_gaussian_is_the_textbooks():
    mean, covariance = np.array([0.2, -0.1, 0.4]), np.array([[0.5, 0.3, -0.1], [0.3, 0.6, 0.2], [-0.1, 0.2, 0.7]])
    one = GaussianMixture(jnp.zeros(1), jnp.asarray(mean[None]), jnp.asarray(np.linalg.cholesky(covariance)[None]))
    wide = posterior(jax.tree.map(jnp.float32, one), Support([-9.0] * 3, [9.0] * 3))
    given, left = [0, 2], [1]
    slope = covariance[np.ix_(left, given)] @ np.linalg.inv(covariance[np.ix_(given, given)])
    found = wide.conditional({"a": 1.0, "c": -0.5})
    expected = mean[left] + slope @ (np.array([1.0, -0.5]) - mean[given])
    deviation = np.sqrt(covariance[1, 1] - (slope @ covariance[np.ix_(given, left)])[0, 0])
    np.testing.assert_allclose(found.mixture.means[0], expected, rtol=1e-5)
    np.testing.assert_allclose(found.mean(), expected, atol=0.003 * deviation)
    np.testing.assert_allclose(found.std(), deviation, rtol=0.005)


def test_conditional_and_marginal_commute():
    points = jnp.array([[-0.2], [0.0], [0.4]])
    one, other = cut().marginal(["a", "b"]).conditional(b=0.1), cut().conditional(b=0.1).marginal("a")
    np.testing.assert_allclose(one.log_prob(points), other.log_prob(points), atol=1e-5)
    np.testing.assert_allclose(one.quantile([0.1, 0.6]), other.quantile([0.1, 0.6]), atol=1e-5)


@contextlib.contextmanager
def optimised():
    """Compile with optimisations: these programs run for longer than they take to compile."""
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", True)


@pytest.mark.slow
@settings(max_examples=15)
@given(
    strategies.mixtures(*strategies.SHAPES[1], spread=2.0),
    st.lists(strategies.floats(0.001, 0.999), min_size=4, max_size=4),
)
def test_quantiles_are_monotone_and_invert_the_distribution_function(mixture, levels):
    """If nothing is cut off, the mixture's distribution function has a closed form."""
    levels = np.sort(levels)
    wide = posterior(mixture, Support([-40.0] * 3, [40.0] * 3))
    narrow = posterior(mixture, Support([-1.0] * 3, [1.5] * 3))
    with optimised():
        found, narrow = wide.quantile(levels), narrow.quantile(levels)
    assert (np.diff(found, axis=0) >= 0).all()
    held = np.stack([mixture.marginal_cdf(row) for row in found])
    np.testing.assert_allclose(held, np.tile(levels[:, None], 3), atol=0.004)
    assert (np.diff(narrow, axis=0) >= 0).all() and (narrow >= -1).all() and (narrow <= 1.5).all()


@pytest.mark.slow
@settings(max_examples=15)
@given(
    strategies.mixtures(*strategies.SHAPES[0], spread=1.0),
    strategies.vectors(0.2, 5.0, 2),
    strategies.vectors(-3.0, 3.0, 2),
)
def test_statistics_follow_a_change_of_units(mixture, scale, shift):
    box, space = Support([-1.0, -2.0], [2.0, 1.0]), Space(("a", "b"), (False, False))
    moved = Support(scale * box.low + shift, scale * box.high + shift)
    one, other = (
        posterior(mixture, box, space),
        posterior(mixture.affine(jnp.asarray(scale), jnp.asarray(shift)), moved, space),
    )
    reach = 2e-3 * scale * np.asarray(box.width)
    np.testing.assert_allclose(other.mean() - shift, scale * one.mean(), atol=reach.max())
    for level in (0.05, 0.5):
        assert (np.abs(other.quantile(level) - shift - scale * one.quantile(level)) <= reach).all()
    np.testing.assert_allclose(other.std(), scale * one.std(), rtol=0.02, atol=1e-3)


def flow(space=PLAIN) -> Posterior:
    """The mixture behind another class of densities, like a flow's posterior."""
    each = jax.tree.map(lambda leaf: leaf[None], MIXTURE)
    density = EnsembleDensity(each, jnp.zeros(3), jnp.ones(3), jnp.zeros(1))
    return _truncated(density, MIXTURE, BOX, space)


@pytest.mark.slow
def test_without_a_closed_form_statistics_are_of_draws(drawn):
    found, again = flow(), flow()
    np.testing.assert_array_equal(found.quantile([0.1, 0.5]), again.quantile([0.1, 0.5]))  # the same every time
    error = 5 / np.sqrt(STATISTICS_DRAWS)
    deviation = drawn.std(axis=0)
    np.testing.assert_allclose(found.mean(), drawn.mean(axis=0), atol=error * deviation.max())
    np.testing.assert_allclose(found.std(), deviation, rtol=error)
    held = [(drawn[:, d] <= float(found.quantile(0.5)[d])).mean() for d in range(3)]
    np.testing.assert_allclose(held, 0.5, atol=0.5 * error)
    np.testing.assert_array_equal(found.marginal("b").quantile(0.5), found.quantile(0.5)[1:2])
    with pytest.raises(
        ValueError, match=r"^log_prob: expected the marginal of a mixture of Gaussians on a box, with a"
    ):
        found.marginal("b").log_prob([0.0])
    with pytest.raises(ValueError, match=r"^conditional: expected a mixture of Gaussians .* got a EnsembleDensity"):
        found.conditional(b=0.0)


class Everywhere:
    """A prior that is zero nowhere, or zero below a line."""

    def __init__(self, cut: bool):
        self.cut = cut

    def sample(self, *, seed, sample_shape):
        return jax.random.normal(seed, (sample_shape, 3))

    def log_prob(self, theta):
        log_prob = -0.5 * jnp.sum(theta**2, axis=-1)
        return jnp.where(theta[..., 0] < theta[..., 1], -jnp.inf, log_prob) if self.cut else log_prob


@pytest.mark.slow
def test_only_a_prior_that_is_zero_in_places_stands_in_the_way(drawn):
    under = lambda cut: jax.jit(lambda mixture: truncated(mixture, mixture, BOX, PLAIN, Everywhere(cut)))(MIXTURE)
    points = jnp.array([[0.1], [0.3]])
    np.testing.assert_allclose(
        under(False).marginal("b").log_prob(points), cut().marginal("b").log_prob(points), atol=1e-3
    )
    assert under(False).conditional(b=0.0).prior is None
    with pytest.raises(ValueError, match=r"got a mixture of 2 Gaussians under a prior$"):
        under(True).conditional(b=0.0)
    above = drawn[drawn[:, 0] >= drawn[:, 1]]
    np.testing.assert_allclose(under(True).mean(), above.mean(axis=0), atol=0.05)
    np.testing.assert_allclose(under(True).std(), above.std(axis=0), rtol=0.08)


def test_wrong_arguments_are_refused():
    for level in (1.5, [-0.1, 0.5], float("nan")):
        with pytest.raises(ValueError, match=r"^level: expected numbers from 0 to 1, got"):
            cut().quantile(level)
    for mass in (0.0, 1.0, 2.0):
        with pytest.raises(ValueError, match=r"^mass: expected a number between 0 and 1, got"):
            cut().interval(mass)
    for names in ("d", [], ["a", "a"], 3, -1):
        with pytest.raises(ValueError, match=r"^names: expected some of \['a', 'b', 'c'\], each once, got"):
            cut().marginal(names)
    with pytest.raises(ValueError, match=r"^b: expected a value inside the support, -1 to 0.6, got 0.7"):
        cut().conditional(b=0.7)
    with pytest.raises(ValueError, match=r"^conditional: expected some of .*, not all, got 3"):
        cut().conditional(a=0.0, b=0.0, c=0.0)
    with pytest.raises(ValueError, match=r"^names: expected some of"):
        cut().conditional()
    with pytest.raises(ValueError, match=r"^conditional: expected one number for each name, got"):
        posteriors._numbers({"b": "much"})  # in tests, type checks refuse it before this


@pytest.mark.slow
def test_statistics_can_be_compiled_and_mapped():
    other = posterior(MIXTURE.affine(jnp.ones(3), jnp.full(3, 0.1)))
    both = jax.tree.map(lambda *parts: jnp.stack(parts), cut(), other)
    found = jax.jit(jax.vmap(lambda one: (one.mean(), one.quantile(0.9), one.marginal("b").std())))(both)
    for i, one in enumerate((cut(), other)):
        np.testing.assert_allclose(found[0][i], one.mean(), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(found[1][i], one.quantile(0.9), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(found[2][i], one.std()[1:2], rtol=1e-4, atol=1e-5)


def test_a_posterior_shows_a_line_for_each_parameter():
    lines = repr(posterior(space=LOGS)).splitlines()
    assert lines[0] == "Posterior of 3 parameters: a mixture of 2 Gaussians, 0.52 of it inside"
    whole = repr(posterior(MIXTURE.affine(jnp.zeros(3), jnp.full(3, 1e-3)), space=LOGS))
    assert whole.startswith("Posterior of 3 parameters: a mixture of 2 Gaussians, all of it inside\n")
    assert len(lines) == 5 and lines[1].split() == ["parameter", "median", "90", "%", "support"]
    middle = float(posterior(space=LOGS).quantile(0.5)[0])
    assert lines[2].split()[:2] == ["a", f"{middle:.4g}"] and lines[2].endswith("[0.4066, 2.46]")
    assert posterior(space=LOGS)._repr_html_().count("<tr>") == 4
    count = posteriors.SHOWN + 1
    many = Space(tuple(f"p{d}" for d in range(count)), (False,) * count)
    wide = GaussianMixture(jnp.zeros(1), jnp.zeros((1, count)), jnp.eye(count)[None])
    shown = repr(posterior(wide, Support([-5.0] * count, [5.0] * count), many))
    assert len(shown.splitlines()) == 2 + posteriors.SHOWN
    assert repr(cut().marginal("a")).startswith("Marginal of a: a marginal of a mixture of 2 Gaussians")
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), cut())
    assert repr(both) == "Posterior of a, b, c; bounds [2, 3]" and both._repr_html_() is None
    assert "Traced" not in str(jax.eval_shape(lambda one: one.mean(), cut()))
