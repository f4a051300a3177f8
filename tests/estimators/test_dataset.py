"""Dataset: rows stay in order and compact, storage is never overrun."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.estimators.dataset import augment, empty
from jaxlfi.tasks.simulation import within_budget

CAPACITY, BUDGET = 8, 5
augmented = jax.jit(augment)
kept_within = jax.jit(within_budget, static_argnums=3)


def attempts(failure, first: int, simulations_per_round: int = 3):
    """Simulations whose theta and x tell which one they are; those of failures must not be stored."""
    place = np.arange(first, first + len(failure), dtype=np.float32)
    return kept_within(np.stack([place, -place], axis=1), 10 * place[:, None], np.array(failure), simulations_per_round)


def test_an_empty_dataset_has_no_valid_rows():
    dataset = empty(4, 2, 3)
    assert dataset.theta.shape == (4, 2) and dataset.x.shape == (4, 3)
    assert int(dataset.size) == 0 and not np.asarray(dataset.valid).any()


@given(st.lists(st.lists(st.integers(0, 2), min_size=BUDGET, max_size=BUDGET), min_size=1, max_size=5))
def test_rows_are_the_kept_ones_in_order(rounds):
    """Compared with lists; five rounds of three need more room than there is."""
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
    """1 for what a run simulates itself; what was given keeps its own weight, behind which the next rounds' follow."""
    given = attempts([0, 1, 0, 0, 0], 1).replace(weight=jnp.array([0.5, 9.0, 2.0, 0.25, 7.0]))
    dataset = augmented(augmented(empty(CAPACITY, 2, 1), given, 0), attempts([0, 0, 1, 1, 1], 101), 1)
    np.testing.assert_array_equal(dataset.weight[:5], [0.5, 2.0, 0.25, 1.0, 1.0])
    np.testing.assert_array_equal(dataset.round[:5], [0, 0, 0, 1, 1])
