"""Support: bounds that it accepts, messages of those that it refuses, and its draws."""

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.distributions.support import Support, check_within
from tests.strategies import DIMS, boxes, keys, vectors

PHI = Support([-1.0, 0.0], [4.0, 10.0])


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0.0, 3.0], [1.0, 2.0], r"expected low < high .* \(reversed or empty in dimension \[1\]\)"),
        ([0.0, 2.0], [1.0, 2.0], r"reversed or empty in dimension \[1\]"),
        ([0.0, float("nan")], [1.0, 2.0], r"expected finite bounds, got low=\[0.0, nan\]"),
        ([0.0, 1.0], [1.0, float("inf")], r"expected finite bounds.*high=\[1.0, inf\]"),
        ([0.0], [1.0, 2.0], r"same length, got low of shape \(1,\) and high of shape \(2,\)"),
        ([], [], r"got low of shape \(0,\)"),
        ([[0.0]], [[1.0]], r"expected two vectors .* shape \(1, 1\)"),
        ((0.0, 3.0), np.array([1.0, 2.0]), r"reversed or empty in dimension \[1\]"),
    ],
)
def test_bad_bounds_are_named(low, high, message):
    with pytest.raises(ValueError, match=f"^support: .*{message}"):
        Support(low, high)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (
            [-1.5, 0.0],
            [4.0, 10.0],
            r"inside the feasible domain Phi; in dimension 0 it is \[-1.5, 4\] but Phi allows \[-1, 4\]",
        ),
        ([0.0, 1.0], [4.0, 11.0], r"in dimension 1 it is \[1, 11\] but Phi allows \[0, 10\]"),
        ([0.0, 1.0, 2.0], [1.0, 2.0, 3.0], r"expected bounds for 2 parameters, got 3"),
    ],
)
def test_boxes_outside_phi_are_named(low, high, message):
    with pytest.raises(ValueError, match=f"^guess: .*{message}"):
        check_within(Support(low, high), PHI, "guess")


@pytest.mark.parametrize("bad", [[2.0, 1.0], [np.nan, 1.0]])
def test_arrays_are_checked_where_a_run_starts(bad):
    unchecked = Support(jnp.asarray(bad), jnp.asarray([1.5, 2.0]))
    with pytest.raises(ValueError, match=r"^support: expected"):
        check_within(unchecked, PHI)


def test_a_box_inside_phi_passes_unchanged():
    assert check_within(PHI, PHI) is PHI
    inner = Support([0.0, 1.0], [1.0, 2.0])
    assert check_within(inner, PHI) is inner


def test_sequences_become_float32_arrays():
    box = Support((1, 2), [3, 5.5])
    assert isinstance(box.low, jax.Array) and isinstance(box.high, jax.Array)
    assert box.low.dtype == box.high.dtype == jnp.float32
    assert box.dim == 2
    np.testing.assert_array_equal(box.width, [2.0, 3.5])
    np.testing.assert_array_equal(box.centre, [2.0, 3.75])


def test_pytree_round_trip_keeps_whatever_the_leaves_become():
    leaves, structure = jax.tree.flatten(PHI)
    assert [leaf.tolist() for leaf in leaves] == [[-1.0, 0.0], [4.0, 10.0]]
    chex.assert_trees_all_equal(jax.tree.unflatten(structure, leaves), PHI)
    batched = jax.tree.map(lambda bound: jnp.stack([bound, bound + 1]), PHI)
    on_host = jax.device_get(batched)
    assert isinstance(on_host.low, np.ndarray) and on_host.low.shape == (2, 2)
    assert not jax.tree.map(np.isnan, jax.device_get(PHI)).low.any()
    chex.assert_trees_all_equal(jax.vmap(lambda box: box)(batched), batched)


@pytest.mark.parametrize("dim", DIMS)
@given(st.data())
def test_clip_contains_and_scaling_agree(dim, data):
    box, _ = data.draw(boxes(dim))
    theta = jnp.asarray(data.draw(vectors(-8.0, 8.0, 5, dim)))
    inside = np.asarray(box.contains(theta))
    expected = [all(box.low[d] <= row[d] <= box.high[d] for d in range(dim)) for row in np.asarray(theta)]
    np.testing.assert_array_equal(inside, expected)
    clipped = box.clip(theta)
    assert bool(jnp.all(box.contains(clipped)))
    np.testing.assert_array_equal(np.asarray(clipped)[inside], np.asarray(theta)[inside])
    within_unit = np.abs(np.asarray(box.to_unit(clipped)))
    assert (within_unit <= 1.0 + 1e-4).all()


def test_bounds_belong_to_the_box():
    assert bool(PHI.contains(PHI.low)) and bool(PHI.contains(PHI.high))
    assert not bool(PHI.contains(jnp.array([-1.0, 10.1])))


def test_to_unit_takes_the_bounds_to_plus_and_minus_one():
    np.testing.assert_allclose(PHI.to_unit(jnp.stack([PHI.low, PHI.high, PHI.centre])), [[-1, -1], [1, 1], [0, 0]])
    np.testing.assert_allclose(PHI.to_unit(jnp.array([0.0, 2.5])), [-0.6, -0.5], rtol=1e-6)


def test_draws_are_uniform_over_the_box(key):
    draws = np.asarray(PHI.sample(key, 20_000))
    assert draws.shape == (20_000, 2)
    for d in range(2):
        uniform = stats.uniform(float(PHI.low[d]), float(PHI.width[d]))
        assert stats.kstest(draws[:, d], uniform.cdf).pvalue > 1e-3
    assert abs(np.corrcoef(draws.T)[0, 1]) < 5 / np.sqrt(20_000)


@hypothesis.settings(max_examples=20)
@given(boxes(2), keys())
def test_draws_stay_in_the_box(drawn, key):
    box, _ = drawn
    assert bool(jnp.all(box.contains(box.sample(key, 1000))))


def test_a_box_is_within_itself_in_any_precision():
    box = Support(np.array([0.05, 0.1]) * 1e3, np.array([0.35, 1 / 3]) * 1e3)  # float64, not exact in float32
    assert check_within(box, box) is box
