"""What simulators and users hand over: copied as it comes, NaN where it is masked, and with a clear outcome."""

import ctypes
import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.tasks import own_arrays
from jaxlfi.tasks.command import Command
from jaxlfi.tasks.errors import SimulatorError
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.observation import observe, simulator_shapes, trials_of
from jaxlfi.tasks.presimulated import presimulated
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated
from jaxlfi.tasks.worker import OneOfBatch, Request, Trials, simulated

THETA = np.float32([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0], [6.0, 7.0]])
KEY = jax.random.key(0)
BOX = Support([-9.0, -9.0], [9.0, 9.0])


class Engine:
    """The identity, by one work array; it also spoils the parameters that it was given."""

    def __init__(self, hand_out=lambda state: state):
        self.state, self.hand_out = np.zeros(2), hand_out

    def __call__(self, rng, theta):
        self.state[:] = theta
        theta[...] = np.nan
        return self.hand_out(self.state)


def of_ctypes(state):
    return (ctypes.c_double * 2).from_buffer(state)


HAND_OUTS = [
    lambda state: state,
    lambda state: state[:],
    lambda state: state[None],
    lambda state: (state, np.bool_(True)),
    lambda state: types.SimpleNamespace(__array_interface__=state.__array_interface__),
    of_ctypes,
    memoryview,
]
"""Ways to give the same memory every time."""


@pytest.mark.parametrize("hand_out", HAND_OUTS)
def test_a_work_array_that_is_handed_out_again_is_copied(hand_out):
    simulator = HostSimulator(Engine(hand_out), each=True)
    for _ in range(2):  # its parameters are its own, so that nothing of ours was spoilt
        got, _ = simulator.batch(KEY, THETA, (2,))
        np.testing.assert_array_equal(got, THETA)


def test_batches_of_a_work_array_are_copied():
    state = np.zeros((4, 2))

    def simulate(rng, theta):
        state[: len(theta)] = theta
        theta[...] = np.nan
        return state[: len(theta)]

    simulator = HostSimulator(simulate)
    first, second = (simulator.batch(KEY, theta)[0] for theta in (THETA[:2], THETA[2:]))
    np.testing.assert_array_equal(np.concatenate([first, second]), THETA)
    read_only = np.asarray(jnp.asarray(THETA))  # as what JAX gives is
    np.testing.assert_array_equal(simulator.batch(KEY, read_only)[0], THETA)


def test_trials_by_a_work_array_are_copied_before_the_next():
    state, outcome, numbers = np.zeros(2), np.array(0), itertools.count()

    def simulate(rng, theta):
        state[:] = theta + next(numbers)
        outcome[...] = 0
        theta[...] = np.nan
        return state, outcome

    trajectory, code = Trials(simulate, 3)(None, np.array([1.0, 2.0]))
    assert trajectory.tolist() == [1.0, 2.0, 2.0, 3.0, 3.0, 4.0] and code == 0


def as_list(make):
    """A simulator of batches that collects what `make(state)` gives of its one work array."""

    def simulate(rng, theta):
        state, rows = np.zeros(2), []
        for row in theta:
            state[:] = row
            rows.append(make(state))
        return rows

    return simulate


@pytest.mark.parametrize("make", [lambda state: state, lambda state: state[:], of_ctypes])
def test_one_array_for_several_simulations_is_refused(make):
    with pytest.raises(SimulatorError, match=r"^simulate: expected a separate array for each simulation.* a copy$"):
        HostSimulator(as_list(make)).batch(KEY, THETA)


def test_a_ring_of_arrays_is_refused_and_copies_are_taken():
    ring = np.zeros((3, 2))

    def simulate(rng, theta):
        rows = []
        for place, row in enumerate(theta):
            ring[place % 3] = row
            rows.append(ring[place % 3])
        return rows

    np.testing.assert_array_equal(HostSimulator(simulate).batch(KEY, THETA[:3])[0], THETA[:3])
    with pytest.raises(SimulatorError, match="got the same one for rows 0 and 3"):
        HostSimulator(simulate).batch(KEY, THETA)
    got, _ = HostSimulator(as_list(np.copy)).batch(KEY, THETA)
    np.testing.assert_array_equal(got, THETA)


def test_one_array_may_stand_for_all_that_failed():
    failed = np.full(2, np.nan)
    got, _ = HostSimulator(lambda rng, theta: [failed, theta[1], failed, theta[3]]).batch(KEY, THETA)
    np.testing.assert_array_equal(got[[1, 3]], THETA[[1, 3]])
    zero = np.zeros(2)
    simulator = HostSimulator(lambda rng, theta: ([zero, theta[1], zero, theta[3]], [1, 0, 1, 0]))
    assert simulator.batch(KEY, THETA)[1].tolist() == [1, 0, 1, 0]


def test_one_array_for_all_records_is_refused():
    def simulate(rng, theta):
        state, records = np.zeros(2), []
        for step in range(3):
            state[:] = theta * step
            records.append(state)
        return records

    answer = simulated(simulate, Request([0, 0], 0, [1.0, 2.0], [3, 2]))
    assert answer.outcome < 0 and "expected a separate array for each record" in answer.message
    with pytest.raises(SimulatorError, match="expected a separate array for each record"):
        HostSimulator(lambda rng, theta: [simulate(rng, row) for row in theta]).batch(KEY, THETA)
    padded = lambda rng, theta: [theta, last := theta * 2, last]  # what ends early stays where it is
    assert simulated(padded, Request([0, 0], 0, [1.0, 2.0], [3, 2])).outcome == 0


def test_a_task_and_its_observation_are_not_changed_from_outside():
    seen, low, truth = np.float32([1.0, 2.0]), np.float32([-1.0, -1.0]), np.float32([0.5, 0.5])
    box = Support(low, low + 2)
    task = Task(lambda key, theta: theta, ("a", "b"), {"box": box}, box, truth=truth, observation=seen, times=seen)
    observed, x = observe(KEY, task, given := np.float32([3.0, 4.0]))
    for array in (seen, low, truth, given):
        array[:] = 99.0
    assert task.observation.tolist() == task.times.tolist() == [1.0, 2.0]
    assert task.truth.tolist() == [0.5, 0.5] and task.support("box").low.tolist() == [-1.0, -1.0]
    assert np.asarray(observed).tolist() == np.asarray(x).tolist() == [3.0, 4.0]


# Outcomes.

UNCLEAR = [1.0, 0.0, float("nan"), 1j, None, "ok", np.float32(1), np.ma.array(1, mask=True)]
CLEAR = [(True, 0), (False, 1), (np.bool_(True), 0), (0, 0), (2, 2), (-7, 1), (np.uint8(0), 0), (np.uint64(2**63), 1)]
CLEAR += [(2**32, 1), (np.int8(2), 2)]
"""Outcomes, and the codes that they stand for in a task of two reasons. Cut to 32 bits, one of them would be 0."""


def failing(simulate):
    return Task(simulate, ("a", "b"), {"box": BOX}, BOX, failures=("slow", "fell"))


@pytest.mark.parametrize("outcome", UNCLEAR)
def test_what_is_no_boolean_and_no_whole_number_is_no_outcome(outcome):
    request = Request([0, 0], 0, [1.0, 2.0], [2])
    of_batch = OneOfBatch(lambda rng, theta: (theta, [outcome]))
    for function in (lambda rng, theta: (theta, outcome), of_batch):
        answer = simulated(function, request)
        assert answer.outcome < 0 and "outcome" in answer.message, answer
    assert simulated(Trials(lambda rng, theta: (theta, outcome), 2), request._replace(shape=[4])).outcome < 0
    for given in ([outcome] * 4, outcome):
        with pytest.raises(SimulatorError, match=r"^simulate: expected an outcome for each of 4 simulations, got "):
            HostSimulator(lambda rng, theta, given=given: (theta, given)).batch(KEY, THETA)


@pytest.mark.parametrize(("outcome", "code"), CLEAR)
def test_outcomes_mean_the_same_to_every_kind_of_simulator(outcome, code):
    one = lambda rng, theta: (theta, outcome)
    many = lambda rng, theta: (theta, np.array([outcome] * len(theta)))
    for simulator in (HostSimulator(one, each=True), HostSimulator(many)):
        for task, shape in ((failing(simulator), (2,)), (repeated(failing(simulator), 2), (4,))):
            _, _, failure = simulate_batch(KEY, task, jnp.asarray(THETA), shape)
            assert failure.tolist() == [code] * 4


@pytest.mark.parametrize("outcome", [1.0, jnp.nan, 1j, None, np.float16(0)])
def test_a_simulator_in_jax_with_another_outcome_is_refused_in_one_line(outcome):
    with pytest.raises(SimulatorError, match=r"^simulate: expected a scalar outcome, a boolean .* got ") as error:
        simulator_shapes(failing(lambda key, theta: (theta, outcome)))
    assert "\n" not in str(error.value)
    with pytest.raises(SimulatorError, match=r"^simulate: expected"):
        simulator_shapes(repeated(failing(lambda key, theta: (theta, outcome)), 2))


def test_programs_say_outcomes_as_booleans_or_whole_numbers(tmp_path):
    for outcome, code in (("true", 0), ("false", 1), ("2", 2), ("1.0", -2), ("null", -2), ('"ok"', -2), ("NaN", -2)):
        said = tmp_path / "said.json"
        said.write_text(f'{{"trajectory": [1, 2], "outcome": {outcome}}}')
        command = Command(f"sh -c 'cat {said}' {{theta}} {{seed}}", ["a"])
        assert simulated(command, Request([0, 0], 0, [0.5], [2])).outcome == code, outcome


# Numbers.


@pytest.mark.parametrize(
    ("trajectory", "message"),
    [
        (
            lambda theta: theta + 1j * theta,
            r"expected real numbers, got complex64 \(stack its real and imaginary parts\)",
        ),
        (lambda theta: jnp.zeros((0, 2)), "expected one array"),
        (lambda theta: jax.random.wrap_key_data(jnp.zeros((1, 2), jnp.uint32)), "expected real numbers, got key"),
    ],
)
def test_a_simulator_in_jax_gives_real_numbers(trajectory, message):
    with pytest.raises(SimulatorError, match=f"^simulate: {message}"):
        simulator_shapes(failing(lambda key, theta: trajectory(theta)))


def test_whole_numbers_and_booleans_are_trajectories():
    for kind in (int, bool, np.uint8):
        task = failing(lambda key, theta, kind=kind: jnp.round(theta).astype(kind))
        shape = simulator_shapes(task).trajectory
        got, _, failure = simulate_batch(jax.random.clone(KEY), task, jnp.asarray(THETA), shape)
        np.testing.assert_array_equal(got, THETA.astype(kind))
        assert not failure.any()


def test_a_complex_summary_is_refused():
    task = Task(lambda key, theta: theta, ("a", "b"), {"box": BOX}, BOX, summary=jnp.fft.fft)
    with pytest.raises(SimulatorError, match=r"^summary: expected real numbers, got complex64"):
        simulator_shapes(task)


MASKED = np.ma.array([1.0, 99.0], mask=[False, True])


@pytest.mark.parametrize(
    "row", [MASKED, MASKED.astype(int), [1.0, np.ma.masked], [MASKED[:1], MASKED[1:]], [[1.0], [np.ma.masked]]]
)
def test_what_is_masked_is_missing(row):
    np.testing.assert_array_equal(np.ravel(own_arrays.array(row)), [1.0, np.nan])
    assert own_arrays.missing(row) == 1
    each = HostSimulator(lambda rng, theta: row, each=True)
    many = HostSimulator(lambda rng, theta: [row, *theta[1:, :]] if np.ndim(row) == 1 else [np.reshape(row, 2)] * 4)
    task = Task(each, ("a", "b"), {"box": BOX}, BOX)
    _, _, failure = simulate_batch(KEY, task, jnp.asarray(THETA), (2,))
    assert {task.reasons[code - 1] for code in failure} == {"non_finite"}
    if np.ndim(row) == 1:
        assert np.isnan(many.batch(KEY, THETA)[0][0, 1])
    with pytest.raises(ValueError, match=r"^observation: expected finite numbers"):  # of a task without gaps
        observe(KEY, task, row)
    simulations, _ = presimulated(task, {"theta": THETA, "x": np.ma.array(THETA, mask=THETA == 3.0)}, BOX)
    assert simulations.kept.tolist() == [True, False, True, True]


def test_a_mask_of_nothing_is_none():
    whole = np.ma.array([1.0, 2.0], mask=[False, False])
    task = Task(HostSimulator(lambda rng, theta: np.ma.array(theta)), ("a", "b"), {"box": BOX}, BOX)
    assert observe(KEY, task, whole)[0].tolist() == [1.0, 2.0]
    assert task.simulate.batch(KEY, THETA)[0].tolist() == THETA.tolist()


def test_tables_of_pandas():
    pandas = pytest.importorskip("pandas")
    column = pandas.Series([1, None], dtype="Int64")
    task = Task(HostSimulator(lambda rng, theta: theta), ("a", "b"), {"box": BOX}, BOX)
    for table in (column, pandas.DataFrame({"a": column, "b": [1.0, 2.0]})):
        assert np.isnan(own_arrays.array(table)).sum() == 1
        with pytest.raises(ValueError, match=r"^observation: expected "):
            observe(KEY, task, table)
    assert observe(KEY, task, pandas.Series([1, 2], dtype="Int64"))[0].tolist() == [1.0, 2.0]


# Observations of host simulators, whose shape is not known before they have run.


@pytest.mark.parametrize("empty", [[], (), np.zeros(0), np.zeros((0, 2)), [[]]])
def test_an_empty_observation_is_refused(empty):
    host = Task(HostSimulator(lambda rng, theta: theta), ("a", "b"), {"box": BOX}, BOX)
    for task in (host, failing(lambda key, theta: theta)):
        with pytest.raises(ValueError, match=r"^observation: expected ") as error:
            observe(KEY, *trials_of(task, empty))
        assert "\n" not in str(error.value)


def test_a_list_of_vectors_is_taken_where_it_can_be_one_thing_only():
    simulator = HostSimulator(lambda rng, theta: theta)
    make = lambda **known: Task(simulator, ("a", "b"), {"box": BOX}, BOX, **known)
    vectors = list(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"got a list of 3 of shape \[2\]: pass np.stack.* jaxlfi.repeated\(task, 3\)"):
        trials_of(make(), vectors)
    for known in ({"channels": ("x", "y")}, {"times": np.arange(3.0)}):
        task = make(**known)
        assert trials_of(task, vectors)[0] is task
    for known in ({"channels": ("x",)}, {"times": np.arange(2.0)}):
        task, observed = trials_of(make(**known), vectors)
        assert task.name == "task x 3" and observed.shape == (6,)
    tables = list(np.zeros((3, 4, 2)))
    assert trials_of(make(), tables)[0].name == "task x 3"
    nested = np.zeros((3, 2)).tolist()
    assert trials_of(make(), nested)[1] is nested
