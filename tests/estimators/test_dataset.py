"""Dataset: rows stay in order and compact, storage is never overrun, and rows near the last proposals are found."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.estimators.dataset import FAR, augment, empty
from jaxlfi.tasks.simulation import within_budget

CAPACITY, BUDGET = 8, 5
augmented = jax.jit(augment)
kept_within = jax.jit(within_budget, static_argnums=3)


def attempts(failure, first: int, simulations_per_round: int = 3):
    """Simulations identified by their theta and x; failed ones must not be stored."""
    place = np.arange(first, first + len(failure), dtype=np.float32)
    return kept_within(np.stack([place, -place], axis=1), 10 * place[:, None], np.array(failure), simulations_per_round)


def test_an_empty_dataset_has_no_valid_rows():
    dataset = empty(4, 2, 3)
    assert dataset.theta.shape == (4, 2) and dataset.x.shape == (4, 3)
    assert int(dataset.size) == 0 and not np.asarray(dataset.valid).any()


@given(st.lists(st.lists(st.integers(0, 2), min_size=BUDGET, max_size=BUDGET), min_size=1, max_size=5))
def test_rows_are_the_kept_ones_in_order(rounds):
    """Rows are compared with lists; five rounds of three need more room than there is."""
    dataset, expected = empty(CAPACITY, 2, 1), []
    for round, failure in enumerate(rounds):
        first = 1 + 100 * round
        dataset = augmented(dataset, attempts(failure, first), round)
        kept = [first + place for place, code in enumerate(failure) if code == 0][:3]
        expected += [(place, round) for place in kept]
    expected = expected[:CAPACITY]
    size = int(dataset.size)
    assert size == len(expected) <= CAPACITY
    np.testing.assert_array_equal(dataset.valid, np.arange(CAPACITY) < size)
    np.testing.assert_array_equal(dataset.theta[:size, 0], [place for place, _ in expected])
    np.testing.assert_array_equal(dataset.theta[:size, 1], [-place for place, _ in expected])
    np.testing.assert_array_equal(dataset.x[:size, 0], [10 * place for place, _ in expected])
    np.testing.assert_array_equal(dataset.round[:size], [round for _, round in expected])
    np.testing.assert_array_equal(dataset.theta[size:], 0.0)
    np.testing.assert_array_equal(dataset.x[size:], 0.0)


def test_runs_of_a_batch_fill_at_their_own_pace():
    failures = jnp.array([[0, 1, 0, 0, 0], [1, 1, 1, 0, 1]])
    place = jnp.arange(5.0)[:, None]
    one = lambda failure: augment(empty(CAPACITY, 1, 1), within_budget(place, place, failure, 3), 0)
    both = jax.jit(jax.vmap(one))(failures)
    np.testing.assert_array_equal(both.size, [3, 1])
    np.testing.assert_array_equal(both.theta[:, :4, 0], [[0, 2, 3, 0], [3, 0, 0, 0]])


def test_the_weights_of_given_simulations_are_kept():
    """A run's own simulations have the weight 1; given ones keep theirs, and those of later rounds follow them."""
    given = attempts([0, 1, 0, 0, 0], 1).replace(weight=jnp.array([0.5, 9.0, 2.0, 0.25, 7.0]))
    dataset = augmented(augmented(empty(CAPACITY, 2, 1), given, 0), attempts([0, 0, 1, 1, 1], 101), 1)
    np.testing.assert_array_equal(dataset.weight[:5], [0.5, 2.0, 0.25, 1.0, 1.0])
    np.testing.assert_array_equal(dataset.round[:5], [0, 0, 0, 1, 1])


def rounds_of(*widths: float, each: int = 20, spare: int = 7):
    """Rounds of evenly spaced simulations, each of some width in two parameters, and empty rows."""
    theta = np.concatenate([width * np.linspace(-0.5, 0.5, each) for width in widths])
    size = len(theta)
    filled = lambda values: jnp.asarray(np.pad(values, (0, spare)))
    return empty(size + spare, 2, 1).replace(
        theta=jnp.stack([filled(theta), filled(0.3 * theta)], axis=1),
        x=filled(theta)[:, None],
        round=filled(np.repeat(np.arange(len(widths), dtype=np.int32), each)),
        weight=filled(np.arange(size, dtype=np.float32)),
        size=jnp.asarray(size, jnp.int32),
    )


def test_rows_are_near_within_five_spans_of_the_last_round():
    """None of the first round, a thousand times as wide as the last, is near, and only the middle two of the second."""
    dataset = rounds_of(1000.0, 90.0, 4.0, 1.0, 1.0)
    theta = np.asarray(dataset.theta[:100, 0], float)
    near = np.asarray(dataset.near)
    np.testing.assert_array_equal(near[:100], np.abs(theta) <= 0.5 + FAR)
    assert near[:20].sum() == 0 and near[20:40].sum() == 2 and near[40:100].all()
    assert not near[100:].any()


def test_the_nearest_half_is_near_in_any_case():
    """All but the last of five rounds are far, so the nearest half of the rows counts as near."""
    dataset = rounds_of(1000.0, 1000.0, 100.0, 100.0, 1e-3)
    near = np.asarray(dataset.near[:100])
    assert near.sum() in (50, 51, 52) and near[80:].all()  # half, or one more, and rows at the same distance
    theta = np.abs(np.asarray(dataset.theta[:100, 0]))
    assert theta[near].max() <= theta[~near].min()


@given(st.floats(0.01, 100.0), st.floats(-3.0, 3.0), st.sampled_from([1.0, -1.0]))
def test_what_is_near_does_not_depend_on_units(scale, shift, sign):
    dataset = rounds_of(1000.0, 87.0, 4.1, 1.0, 1.3)
    first, second = dataset.theta.T
    moved = dataset.replace(theta=jnp.stack([first, sign * scale * (second + shift)], axis=1))
    np.testing.assert_array_equal(dataset.near, moved.near)


def test_one_round_is_near_and_so_is_all_of_rounds_that_are_not_much_wider():
    for widths in [(5.0,), (10.9, 5.0, 1.0), (1.0, 1.0, 3.0)]:
        dataset = rounds_of(*widths)
        np.testing.assert_array_equal(dataset.near, dataset.valid)
    assert not np.asarray(empty(4, 2, 3).near).any()


def test_some_rows_come_first_and_in_order():
    dataset = rounds_of(1000.0, 90.0, 4.0, 1.0, 1.0)
    kept, places = jax.jit(lambda dataset: dataset.only(dataset.near))(dataset)
    expected = np.flatnonzero(np.asarray(dataset.near))
    size = int(kept.size)
    assert size == len(expected) and kept.capacity == dataset.capacity
    np.testing.assert_array_equal(places[:size], expected)
    for name in ("theta", "x", "round", "weight"):
        np.testing.assert_array_equal(getattr(kept, name)[:size], np.asarray(getattr(dataset, name))[expected])
    np.testing.assert_array_equal(np.sort(places), np.arange(dataset.capacity))
