"""Which components of an ensemble's mixtures are kept, against a plain NumPy reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.estimators import pruning
from jaxlfi.estimators.pruning import AGREEMENT, CONFIRMED

agreement, pruned = jax.jit(pruning.agreement), jax.jit(pruning.pruned)
EQUAL = np.zeros(2, np.float32)


def ensemble(weights, means, deviations):
    """One-dimensional mixtures of an ensemble; all arguments have the shape [E, K]."""
    weights, means, deviations = (np.asarray(one, np.float32) for one in (weights, means, deviations))
    with np.errstate(divide="ignore"):
        return GaussianMixture(np.log(weights), means[..., None], deviations[..., None, None])


def exact_agreement(weights, means, deviations, shares):
    """Agreement by integrals on a fine grid, given the `shares` of the networks."""
    weights, means, deviations = (np.asarray(one, float)[..., None] for one in (weights, means, deviations))
    theta = np.linspace(-60, 60, 200_001)
    components = stats.norm.pdf(theta, means, deviations)
    own = np.sum(weights * components, axis=1)
    found = np.zeros(means.shape[:2])
    for member in range(len(own)):
        rest = np.delete(np.asarray(shares, float), member)
        others = np.average(np.delete(own, member, axis=0), axis=0, weights=rest)
        smaller = np.minimum(others / np.maximum(own[member], 1e-300), 1.0)
        found[member] = np.sum(components[member] * smaller, axis=-1) * (theta[1] - theta[0])
    return found


def test_agreement_is_the_integral():
    """Three networks have unlike shapes and weights: one has a tail to the right, one a shorter one, one none."""
    parts = (
        [[0.9, 0.1], [0.8, 0.2], [0.5, 0.5]],
        [[0.0, 4.0], [0.2, 2.5], [-0.1, 0.4]],
        [[1.0, 3.0], [0.9, 2.0], [0.8, 1.2]],
    )
    shares = [0.2, 0.5, 0.3]
    found = agreement(ensemble(*parts), np.log(np.float32(shares)))
    np.testing.assert_allclose(found, exact_agreement(*parts, shares), atol=0.06)


def test_agreement_at_its_ends():
    """It is 1 if all networks are the same, 0 if they are far apart, and 0 for a single one."""
    same = ensemble([[0.95, 0.05]] * 2, [[0.0, 6.0]] * 2, [[1.0, 3.0]] * 2)
    np.testing.assert_allclose(agreement(same, EQUAL), 1.0, atol=1e-5)
    apart = ensemble([[0.95, 0.05]] * 2, [[-200.0, -220.0], [200.0, 220.0]], [[1.0, 3.0]] * 2)
    np.testing.assert_allclose(agreement(apart, EQUAL), 0.0, atol=1e-6)
    np.testing.assert_array_equal(agreement(jax.tree.map(lambda leaf: leaf[:1], same), EQUAL[:1]), 0.0)


def test_networks_that_do_not_count_do_not_confirm():
    """The second has the first one's tail, the third does not: it depends on which of them counts."""
    three = ensemble([[0.95, 0.05]] * 3, [[0.0, 8.0], [0.0, 8.0], [0.0, -8.0]], [[1.0, 2.0]] * 3)
    second, third = np.float32([0, 0, -np.inf]), np.float32([0, -np.inf, 0])
    assert agreement(three, second)[0, 1] > 0.99
    assert agreement(three, third)[0, 1] < 0.05
    # If no other network counts, all others count equally.
    np.testing.assert_allclose(
        agreement(three, np.float32([0, -np.inf, -np.inf]))[0], agreement(three, np.zeros(3, np.float32))[0], rtol=1e-5
    )


@pytest.mark.parametrize(
    ("weight", "place", "kept"),
    [
        (0.05, 8.0, True),
        (0.05, -8.0, False),  # no other network has it there
        (0.005, 8.0, False),  # less than a tenth of what a component needs by itself
        (0.2, -8.0, True),
    ],
)
def test_small_components_stay_where_others_confirm_them(weight, place, kept):
    parts = [[1 - weight, weight], [0.9, 0.1]], [[0.0, place], [0.0, 8.5]], [[1.0, 2.0], [1.0, 2.5]]
    found = pruned(ensemble(*parts), 0.1, EQUAL)
    assert bool(found.weights[0, 1] > 0) is kept
    assert np.all(found.weights[:, 0] > 0)


def test_nothing_is_dropped_at_zero_and_the_heaviest_never():
    spread = ensemble([[0.3, 0.3, 0.4], [0.2, 0.5, 0.3]], [[0, 50, -50], [90, -90, 20]], np.ones((2, 3)))
    assert np.all(pruned(spread, 0.0, EQUAL).weights > 0)
    np.testing.assert_array_equal(pruned(spread, 0.5, EQUAL).weights > 0, [[False, False, True], [False, True, False]])


finite = st.floats(-3, 3, width=32)


@settings(max_examples=30)
@given(data=st.data(), shift=finite, scale=st.floats(0.25, 8, width=32))
def test_laws(data, shift, scale):
    """Shifts, scales, reflections, and the order of networks and of components change nothing."""
    numbers = lambda low, high: np.float32(
        data.draw(st.lists(st.floats(low, high, width=32), min_size=6, max_size=6))
    ).reshape(3, 2)
    parts = numbers(0.125, 1), numbers(-3, 3), numbers(0.25, 2)
    shares = np.float32(data.draw(st.lists(st.floats(-2, 0, width=32), min_size=3, max_size=3)))
    found = np.asarray(agreement(ensemble(*parts), shares))
    close = lambda other, expected: np.testing.assert_allclose(other, expected, atol=2e-4)
    close(agreement(ensemble(parts[0], scale * parts[1] + shift, scale * parts[2]), shares), found)
    close(agreement(ensemble(parts[0], -parts[1], parts[2]), shares), found)  # points lie in pairs
    order = np.array([2, 0, 1])
    close(agreement(ensemble(*(part[order] for part in parts)), shares[order]), found[order])
    close(agreement(ensemble(*(part[:, ::-1] for part in parts)), shares), found[:, ::-1])
    assert np.all((found >= 0) & (found <= 1 + 1e-5))
    kept = np.asarray(pruned(ensemble(*parts), 0.4, shares).weights) > 0
    weights = parts[0] / parts[0].sum(axis=1, keepdims=True)
    sure = np.abs(found - AGREEMENT) > 1e-3
    wanted = (weights >= 0.4) | ((weights >= CONFIRMED * 0.4) & (found >= AGREEMENT))
    wanted |= weights == weights.max(axis=1, keepdims=True)
    np.testing.assert_array_equal(kept[sure], wanted[sure])


def test_in_many_parameters_and_under_vmap():
    """The result is the same for each member of a batch, and finite in twenty dimensions."""
    key = jax.random.key(0)
    means = 0.1 * jax.random.normal(key, (3, 4, 2, 20))
    batch = GaussianMixture(jnp.zeros((3, 4, 2)), means, jnp.broadcast_to(jnp.eye(20), (3, 4, 2, 20, 20)))
    shares = jnp.zeros((3, 4))
    together = jax.jit(jax.vmap(pruning.agreement))(batch, shares)
    assert np.all(np.isfinite(together)) and np.all(together > 0.3)
    each = [agreement(jax.tree.map(lambda leaf, place=place: leaf[place], batch), shares[place]) for place in range(3)]
    np.testing.assert_allclose(together, np.stack(each), rtol=1e-4)
