"""Products, quotients, unions and reductions of mixtures against their densities and moments."""

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import logsumexp

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import FLOOR, POLICIES, pool, product, quotient, reduce
from tests.strategies import mixtures, shapes, vectors

PRODUCT = jax.jit(product)
QUOTIENT = jax.jit(quotient, static_argnames="policy")
REDUCE = jax.jit(reduce, static_argnames="components")

A = GaussianMixture(
    jnp.log(jnp.array([0.6, 0.3, 0.1])),
    jnp.array([[0.0, 1.0], [1.5, -0.5], [-1.0, 0.3]]),
    jnp.array([[[0.5, 0.0], [0.3, 0.4]], [[0.3, 0.0], [-0.2, 0.6]], [[0.7, 0.0], [0.0, 0.2]]]),
)
WIDE = GaussianMixture(jnp.zeros(1), jnp.array([[0.5, -1.0]]), jnp.array([[[2.0, 0.0], [-0.8, 1.5]]]))
"""One Gaussian wider than every component of A in every direction."""

NARROW_IN_ONE = GaussianMixture(jnp.zeros(1), jnp.array([[0.4, 0.2]]), jnp.array([[[0.45, 0.0], [0.0, 9.0]]]))
"""Narrower in some direction than components 0 and 2 of A, but in none than component 1."""

GRID = jnp.stack(jnp.meshgrid(jnp.linspace(-2.0, 2.5, 9), jnp.linspace(-2.0, 2.0, 9)), axis=-1).reshape(-1, 2)


def gaussian(mean, covariance) -> GaussianMixture:
    """One Gaussian as a mixture."""
    tril = np.linalg.cholesky(np.asarray(covariance, float))
    return GaussianMixture(jnp.zeros(1), jnp.asarray([mean], jnp.float32), jnp.asarray(tril[None], jnp.float32))


_log_prob = jax.jit(GaussianMixture.log_prob)
moments = jax.jit(lambda mixture: (mixture.mean, mixture.covariance))


def log_prob(mixture: GaussianMixture, theta) -> np.ndarray:
    """The library's log-densities, as a NumPy array."""
    return np.asarray(_log_prob(mixture, theta))


def total(mixture: GaussianMixture) -> float:
    """The log of the mixture's unnormalised mass."""
    return float(logsumexp(np.asarray(mixture.logits, np.float64)))


def is_density_of(mixture: GaussianMixture, expected, theta, **tolerance):
    """Check the unnormalised mixture against log-densities, constant included."""
    np.testing.assert_allclose(log_prob(mixture, theta) + total(mixture), expected, **tolerance)


@given(
    shapes().flatmap(
        lambda kd: st.tuples(mixtures(*kd, spread=1.5), mixtures(3, kd[1], spread=1.5), vectors(-2.0, 2.0, 5, kd[1]))
    )
)
def test_product_is_the_product_of_densities(drawn):
    a, b, theta = drawn
    both, pairing = PRODUCT(a, b)
    assert both.means.shape == (a.means.shape[0] * 3, a.means.shape[1])
    assert not np.asarray(pairing.indefinite).any()
    is_density_of(both, log_prob(a, theta) + log_prob(b, theta), theta, rtol=1e-3, atol=2e-2)
    chex.assert_tree_all_finite(both)


@given(
    shapes().flatmap(lambda kd: st.tuples(mixtures(*kd, spread=1.5), mixtures(1, kd[1]), vectors(-2.0, 2.0, 5, kd[1])))
)
def test_quotient_by_a_wide_gaussian_is_the_quotient_of_densities(drawn):
    a, b, theta = drawn
    # No component's standard deviation exceeds 1.5 + sqrt(2) in any direction.
    wide = GaussianMixture(
        b.logits, b.means, jnp.asarray(b.scale_tril + 6.0 * np.eye(b.means.shape[1], dtype=np.float32))
    )
    ratio, pairing = QUOTIENT(a, wide, policy="drop")
    assert int(pairing.not_positive_definite) == 0 and not bool(pairing.fell_back)
    is_density_of(ratio, log_prob(a, theta) - log_prob(wide, theta), theta, rtol=1e-3, atol=2e-2)


def test_product_and_quotient_are_their_densities_on_a_grid():
    b = GaussianMixture(
        jnp.log(jnp.array([0.8, 0.2])),
        WIDE.means + jnp.array([[0.0], [2.0]]),
        0.3 * jnp.concatenate([WIDE.scale_tril] * 2),
    )
    is_density_of(PRODUCT(A, b)[0], log_prob(A, GRID) + log_prob(b, GRID), GRID, rtol=1e-4, atol=1e-3)
    is_density_of(QUOTIENT(A, WIDE)[0], log_prob(A, GRID) - log_prob(WIDE, GRID), GRID, rtol=1e-4, atol=1e-3)


def test_pairs_are_ordered_a_first():
    both, _ = PRODUCT(
        A,
        GaussianMixture(jnp.zeros(2), jnp.array([[9.0, 9.0], [0.0, 0.0]]), 1e-3 * jnp.eye(2)[None].repeat(2, 0)),
    )
    # The second factor is so narrow that each pair's mean is its own.
    np.testing.assert_allclose(both.means, [[9.0, 9.0], [0.0, 0.0]] * 3, atol=1e-2)


def test_one_dimension_by_hand():
    """N(1, 1/4) N(3, 1) = c N(1.4, 1/5) and N(1, 1/4) / N(3, 1) = c N(1/3, 1/3)."""
    a, b = gaussian([1.0], [[0.25]]), gaussian([3.0], [[1.0]])
    both, ratio = PRODUCT(a, b)[0], QUOTIENT(a, b)[0]
    np.testing.assert_allclose(both.means, [[1.4]], rtol=1e-6)
    np.testing.assert_allclose(both.covariances, [[[0.2]]], rtol=1e-6)
    np.testing.assert_allclose(both.logits, [stats.norm(3.0, 1.25**0.5).logpdf(1.0)], rtol=1e-5)
    np.testing.assert_allclose(ratio.means, [[1 / 3]], rtol=1e-5)
    np.testing.assert_allclose(ratio.covariances, [[[1 / 3]]], rtol=1e-5)
    expected = stats.norm(1, 0.5).logpdf(0) - stats.norm(3, 1).logpdf(0) - stats.norm(1 / 3, 3**-0.5).logpdf(0)
    np.testing.assert_allclose(ratio.logits, [expected], rtol=1e-5)


def test_weights_by_hand():
    """Asymmetric weights of two components times, and divided by, one Gaussian (with signs that others got wrong)."""
    a = GaussianMixture(jnp.log(jnp.array([0.5, 0.5])), jnp.array([[0.0], [2.0]]), jnp.array([[[0.5]], [[0.4]]]))
    b = gaussian([3.0], [[4.0]])
    evidence = np.array([stats.norm(3, np.sqrt(4.0 + s**2)).pdf(m) for m, s in ((0.0, 0.5), (2.0, 0.4))])
    np.testing.assert_allclose(PRODUCT(a, b)[0].weights, evidence / evidence.sum(), rtol=1e-5)
    theta = np.linspace(-6.0, 8.0, 20_001)
    over = [
        np.trapezoid(stats.norm(m, s).pdf(theta) / stats.norm(3, 2).pdf(theta), theta) for m, s in ((0, 0.5), (2, 0.4))
    ]
    np.testing.assert_allclose(QUOTIENT(a, b)[0].weights, over / np.sum(over), rtol=1e-4)


def test_quotient_undoes_product():
    both, _ = PRODUCT(A, WIDE)
    again, pairing = QUOTIENT(both, WIDE, policy="drop")
    assert int(pairing.not_positive_definite) == 0
    np.testing.assert_allclose(again.weights, A.weights, rtol=1e-4)
    np.testing.assert_allclose(again.means, A.means, atol=1e-5)
    np.testing.assert_allclose(again.scale_tril, A.scale_tril, atol=1e-5)
    # The constants cancel, too: the mass of the quotient is the inverse of the product's.
    np.testing.assert_allclose(total(again) + total(both), 0.0, atol=1e-4)


def test_products_of_very_different_widths_keep_their_precision():
    for narrow, wide in ((1e-4, 1e4), (1e4, 1e-4)):
        both, _ = PRODUCT(gaussian([1.0], [[narrow**2]]), gaussian([-2.0], [[wide**2]]))
        assert float(both.scale_tril[0, 0, 0]) == pytest.approx(1e-4, rel=1e-5)
        assert float(both.means[0, 0]) == pytest.approx(1.0 if narrow < wide else -2.0, rel=1e-5)


def test_products_of_distant_components_have_finite_logits():
    both, _ = PRODUCT(gaussian([0.0, 0.0], np.eye(2) * 1e-4), gaussian([100.0, -100.0], np.eye(2) * 1e-4))
    np.testing.assert_allclose(both.means, [[50.0, -50.0]], rtol=1e-5)
    np.testing.assert_allclose(both.logits, [-0.5 * 2e4 / 2e-4 - np.log(2 * np.pi * 2e-4)], rtol=1e-5)


def test_pairs_that_are_not_positive_definite_are_reported():
    for policy in POLICIES:
        _, pairing = QUOTIENT(A, NARROW_IN_ONE, policy=policy)
        np.testing.assert_array_equal(pairing.indefinite, [True, False, True])
        assert int(pairing.not_positive_definite) == 2
        assert not bool(pairing.fell_back)


@pytest.mark.parametrize("policy", POLICIES)
def test_definite_pairs_are_exact_under_every_policy(policy):
    ratio, _ = QUOTIENT(A, NARROW_IN_ONE, policy=policy)
    precision = np.linalg.inv(np.asarray(A.covariances[1], float)) - np.diag([1 / 0.45**2, 1 / 81])
    np.testing.assert_allclose(np.linalg.inv(np.asarray(ratio.covariances[1], float)), precision, rtol=1e-3, atol=1e-3)
    alone = jax.tree.map(lambda leaf: leaf[1:2], A)
    exact = log_prob(alone, GRID) + np.log(0.3) - log_prob(NARROW_IN_ONE, GRID)
    kept = GaussianMixture(ratio.logits[1:2], ratio.means[1:2], ratio.scale_tril[1:2])
    is_density_of(kept, exact, GRID, rtol=1e-3, atol=1e-2)


def test_drop_takes_the_weight_away():
    ratio, _ = QUOTIENT(A, NARROW_IN_ONE, policy="drop")
    np.testing.assert_array_equal(ratio.weights, [0.0, 1.0, 0.0])
    chex.assert_tree_all_finite((ratio.means, ratio.scale_tril))


def test_drop_of_everything_gives_back_a():
    narrow = gaussian([0.3, 0.3], 1e-4 * np.eye(2))
    ratio, pairing = QUOTIENT(A, narrow, policy="drop")
    assert bool(pairing.fell_back) and int(pairing.not_positive_definite) == 3
    np.testing.assert_allclose(ratio.weights, A.weights, rtol=1e-5)
    np.testing.assert_allclose(log_prob(ratio, GRID), log_prob(A, GRID), rtol=1e-4, atol=1e-4)


def test_skip_keeps_as_component():
    ratio, pairing = QUOTIENT(A, NARROW_IN_ONE, policy="skip")
    for k in (0, 2):
        np.testing.assert_allclose(ratio.means[k], A.means[k], atol=1e-6)
        np.testing.assert_allclose(ratio.scale_tril[k], A.scale_tril[k], atol=1e-6)
        # It is divided by the divisor's peak, which has the unit of a density, too.
        peak = float(log_prob(NARROW_IN_ONE, NARROW_IN_ONE.means[0]))
        assert float(ratio.logits[k]) == pytest.approx(float(A.logits[k]) - peak, rel=1e-4)
    assert not bool(pairing.fell_back)


def test_floor_leaves_a_fraction_of_as_precision():
    ratio, _ = QUOTIENT(A, NARROW_IN_ONE, policy="floor")
    for k in (0, 2):
        whitener = np.asarray(A.scale_tril[k], float)
        precision = whitener.T @ np.linalg.inv(np.asarray(ratio.covariances[k], float)) @ whitener
        eigenvalues = np.linalg.eigvalsh(precision)
        assert eigenvalues[0] == pytest.approx(FLOOR, rel=1e-3)
        assert FLOOR < eigenvalues[1] < 1.0
    # Along the eigenvector that was not floored, the precision is a's minus b's.
    k = 2
    np.testing.assert_allclose(ratio.covariances[k][1, 1], 1 / (1 / 0.04 - 1 / 81), rtol=1e-4)
    # One Gaussian, one dimension: the divisor becomes as wide as a / sqrt(1 - FLOOR), about its own mean.
    one, _ = QUOTIENT(gaussian([1.0], [[4.0]]), gaussian([1.5], [[1.0]]), policy="floor")
    np.testing.assert_allclose(one.covariances, [[[4.0 / FLOOR]]], rtol=1e-3)
    np.testing.assert_allclose(one.means, [[1.0 - 0.5 * (1 - FLOOR) / FLOOR]], rtol=1e-3)


def test_equal_gaussians_are_not_positive_definite():
    """Nearly equal mixtures, whose precisions differ by rounding only, are not divided either."""
    first = jax.tree.map(lambda leaf: leaf[:1], A)
    for wider, indefinite in ((2e-6, 1), (1e-3, 0)):
        divisor = GaussianMixture(first.logits, first.means, (1 + wider) * first.scale_tril)
        assert int(QUOTIENT(first, divisor, policy="drop")[1].not_positive_definite) == indefinite
    for policy in POLICIES:
        ratio, pairing = QUOTIENT(
            jax.tree.map(lambda leaf: leaf[:1], A), jax.tree.map(lambda leaf: leaf[:1], A), policy=policy
        )
        assert int(pairing.not_positive_definite) == 1
        chex.assert_tree_all_finite(ratio)


@pytest.mark.parametrize("policy", POLICIES)
@given(
    shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), mixtures(3, kd[1]))),
    st.lists(st.booleans(), min_size=3, max_size=3),
)
def test_quotients_are_never_nan(policy, drawn, absent):
    """This also holds with absent components on both sides, as long as one is present."""
    a, b = drawn
    hypothesis.assume(not all(absent))
    gone = np.asarray(absent)
    b = GaussianMixture(jnp.asarray(np.where(gone, -np.inf, b.logits)), b.means, b.scale_tril)
    if a.logits.shape[0] > 1:
        logits = np.array(a.logits)
        logits[1] = -np.inf
        a = GaussianMixture(jnp.asarray(logits), a.means, a.scale_tril)
    ratio, pairing = jax.device_get(QUOTIENT(a, b, policy=policy))
    chex.assert_tree_all_finite((ratio.means, ratio.scale_tril))
    assert np.isfinite(np.max(ratio.logits)) and not np.isnan(ratio.logits).any()
    assert (np.diagonal(ratio.scale_tril, axis1=1, axis2=2) > 0).all()
    missing = (np.isneginf(a.logits)[:, None] | gone[None, :]).reshape(-1)
    assert np.isneginf(ratio.logits[missing]).all()
    assert not (pairing.indefinite & missing).any()
    indefinite = int(pairing.indefinite.sum())
    assert bool(pairing.fell_back) == (policy == "drop" and indefinite == (~missing).sum())


def test_a_divisor_in_equal_parts_is_the_divisor():
    """Splitting b's component into two of unequal weight changes only the number of pairs."""
    halves = GaussianMixture(
        jnp.log(jnp.array([0.2, 0.8])),
        *(jnp.concatenate([leaf, leaf]) for leaf in (WIDE.means, WIDE.scale_tril)),
    )
    is_density_of(QUOTIENT(A, halves)[0], log_prob(A, GRID) - log_prob(WIDE, GRID), GRID, rtol=1e-4, atol=1e-3)


def test_a_divisor_of_several_components_bounds_the_quotient_from_above():
    b = GaussianMixture(
        jnp.log(jnp.array([0.3, 0.7])),
        jnp.array([[0.5, -1.0], [0.0, 0.5]]),
        jnp.stack([WIDE.scale_tril[0], 3 * jnp.eye(2)]),
    )
    ratio, _ = QUOTIENT(A, b, policy="drop")
    log_ratio = log_prob(ratio, GRID) + total(ratio)
    assert (log_ratio >= log_prob(A, GRID) - log_prob(b, GRID) - 1e-4).all()
    pairwise = [
        log_prob(A, GRID)
        + b.logits[j]
        - log_prob(GaussianMixture(jnp.zeros(1), b.means[j][None], b.scale_tril[j][None]), GRID)
        for j in range(2)
    ]
    np.testing.assert_allclose(log_ratio, logsumexp(np.stack(pairwise), axis=0), rtol=1e-4, atol=1e-3)


def test_an_unknown_policy_is_named():
    with pytest.raises(ValueError, match=r"policy: expected one of \['drop', 'floor', 'skip'\], got 'raise'"):
        quotient(A, WIDE, policy="raise")


def test_pool_is_the_mean_of_its_members():
    other = GaussianMixture(A.logits[::-1] + 5.0, A.means + 1.0, 1.5 * A.scale_tril)
    # Logits are unnormalised: each member counts one half, whatever its sum.
    members = jax.tree.map(lambda *leaves: jnp.stack(leaves), A, other)
    union = pool(members)
    assert union.logits.shape == (6,)
    expected = np.logaddexp(log_prob(A, GRID), log_prob(other, GRID)) - np.log(2.0)
    np.testing.assert_allclose(log_prob(union, GRID), expected, rtol=1e-4, atol=1e-4)


# ------------------------------------------------------------------------------------------- reduction


@pytest.mark.parametrize("components", [1, 3])
@given(mixtures(4, 3))
def test_reduction_keeps_mean_and_covariance(components, mixture):
    reduced = REDUCE(mixture, components=components)
    assert reduced.logits.shape == (components,)
    chex.assert_trees_all_close(moments(reduced), moments(mixture), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.exp(reduced.logits).sum(), 1.0, rtol=1e-5)
    assert (np.diagonal(reduced.scale_tril, axis1=1, axis2=2) > 0).all()


def test_reduction_to_as_many_components_is_the_identity():
    reduced = REDUCE(A, components=3)
    np.testing.assert_allclose(reduced.weights, A.weights, rtol=1e-6)
    np.testing.assert_array_equal(reduced.means, A.means)
    np.testing.assert_array_equal(reduced.scale_tril, A.scale_tril)


@given(st.permutations(range(6)))
def test_reduction_merges_clusters(order):
    """Three distant clusters of one, two and three unlike components come back with their own moments."""
    sizes, centres = (1, 2, 3), ((0.0, 0.0), (30.0, 5.0), (-5.0, 40.0))
    draw = np.random.default_rng(3)
    weights = draw.uniform(0.5, 2.0, 6)
    means = np.concatenate([centre + draw.normal(0, 0.7, (n, 2)) for n, centre in zip(sizes, centres, strict=True)])
    scales = draw.uniform(0.5, 1.5, 6)
    mixture = GaussianMixture(
        jnp.asarray(np.log(weights), jnp.float32),
        jnp.asarray(means, jnp.float32),
        jnp.asarray(scales[:, None, None] * np.eye(2), jnp.float32),
    )
    mixture = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[list(order)]), mixture)
    reduced = REDUCE(mixture, components=3)
    reduced = jax.device_get(reduced)
    rank = np.argsort(reduced.means @ [1.0, -1.0])
    for k, group in zip(rank, (slice(3, 6), slice(0, 1), slice(1, 3)), strict=True):
        share = weights[group] / weights[group].sum()
        mean = share @ means[group]
        spread = means[group] - mean
        covariance = np.einsum("k,ki,kj->ij", share, spread, spread) + (share @ scales[group] ** 2) * np.eye(2)
        assert np.exp(reduced.logits[k]) == pytest.approx(weights[group].sum() / weights.sum(), rel=1e-5)
        np.testing.assert_allclose(reduced.means[k], mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(reduced.scale_tril[k] @ reduced.scale_tril[k].T, covariance, rtol=1e-3, atol=1e-4)


def reference_reduction(mixture: GaussianMixture, components: int):
    """Runnalls's greedy merging in float64, as published."""
    parts = [
        (float(w), np.asarray(m, float), np.asarray(c, float))
        for w, m, c in zip(mixture.weights, mixture.means, mixture.covariances, strict=True)
    ]

    def merge(p, q):
        w = p[0] + q[0]
        mean = (p[0] * p[1] + q[0] * q[1]) / w
        gap = (p[1] - q[1])[:, None]
        return w, mean, (p[0] * p[2] + q[0] * q[2]) / w + p[0] * q[0] / w**2 * gap @ gap.T

    log_det = lambda part: np.linalg.slogdet(part[2])[1]
    while len(parts) > components:
        cost = {
            (i, j): 0.5
            * (
                (parts[i][0] + parts[j][0]) * log_det(merge(parts[i], parts[j]))
                - parts[i][0] * log_det(parts[i])
                - parts[j][0] * log_det(parts[j])
            )
            for i in range(len(parts))
            for j in range(i + 1, len(parts))
        }
        i, j = min(cost, key=cost.get)
        parts[i] = merge(parts[i], parts.pop(j))
    return parts


@pytest.mark.parametrize("seed", range(10))
def test_reduction_is_runnalls(seed):
    """Not only distances matter, but also weights and widths, from 0.02 to 1."""
    draw = np.random.default_rng(seed)
    tril = np.tril(draw.normal(0, 0.3, (6, 2, 2)), -1)
    tril[:, [0, 1], [0, 1]] = draw.uniform(0.2, 1.5, (6, 2))
    mixture = GaussianMixture(
        jnp.asarray(draw.normal(0, 1.5, 6), jnp.float32),
        jnp.asarray(draw.normal(0, 1.5, (6, 2)), jnp.float32),
        jnp.asarray(tril, jnp.float32),
    )
    reduced = REDUCE(mixture, components=3)
    for k, (weight, mean, covariance) in enumerate(reference_reduction(mixture, 3)):
        assert float(reduced.weights[k]) == pytest.approx(weight, rel=1e-4)
        np.testing.assert_allclose(reduced.means[k], mean, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(reduced.covariances[k], covariance, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("present", "components"), [((0, 3, 4), 3), ((0, 3, 4), 2), ((2, 4), 3), ((1,), 2), ((0, 1), 3)]
)
def test_reduction_drops_absent_components_first(present, components):
    """It does so even before it merges equal ones, which costs nothing either: components 0 and 1 are equal."""
    draw = np.random.default_rng(1)
    logits = np.full(6, -np.inf)
    logits[list(present)] = draw.normal(size=len(present))
    equal = [0, 0, 2, 3, 4, 5]
    mixture = GaussianMixture(
        jnp.asarray(logits, jnp.float32),
        jnp.asarray(draw.normal(size=(6, 2))[equal], jnp.float32),
        jnp.asarray(draw.uniform(0.3, 1.0, (6, 1, 1))[equal] * np.eye(2), jnp.float32),
    )
    reduced = REDUCE(mixture, components=components)
    chex.assert_tree_all_finite((reduced.means, reduced.scale_tril))
    assert int((reduced.weights > 0).sum()) == min(len(present), components)
    chex.assert_trees_all_close(moments(reduced), moments(mixture), atol=1e-5)
    if len(present) <= components:
        np.testing.assert_allclose(log_prob(reduced, GRID), log_prob(mixture, GRID), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("components", [0, 4])
def test_impossible_numbers_of_components_are_named(components):
    with pytest.raises(ValueError, match=f"components: expected between 1 and the mixture's 3, got {components}"):
        reduce(A, components)


def test_vmap_is_a_loop():
    batch = jax.tree.map(
        jnp.asarray, jax.tree.map(lambda a, b: np.stack([a, b]), A, A.replace(logits=2 * A.logits, means=2 * A.means))
    )

    def whole(a):
        ratio, pairing = quotient(a, NARROW_IN_ONE, policy="floor")
        return product(ratio, WIDE), reduce(ratio, 2), pairing

    together = jax.jit(jax.vmap(whole))(batch)
    one = jax.jit(whole)
    one_by_one = [one(jax.tree.map(lambda leaf, i=i: leaf[i], batch)) for i in range(2)]
    chex.assert_trees_all_close(
        together, jax.tree.map(lambda *leaves: jnp.stack(leaves), *one_by_one), rtol=1e-3, atol=1e-4
    )
