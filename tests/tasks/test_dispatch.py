"""Simulations one by one: the same bits wherever they are made, and no failure does anything to another."""

import collections
import dataclasses
import multiprocessing
import os
import subprocess
import sys
import threading
import time
import types
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor

import cloudpickle
import jax
import numpy as np
import pytest

from jaxlfi.tasks.errors import ExecutorError, SimulatorError
from jaxlfi.tasks.executors import one_by_one, workers
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.simulation import simulate_batch, simulate_in_waves
from jaxlfi.tasks.supervisor import Supervisor, simulate_supervised
from jaxlfi.tasks.trials import repeated
from jaxlfi.tasks.worker import Request, Trials, generator, simulated
from tests.small import gaussian
from tests.troubled import WAYS, Troubled, calls

THETA = gaussian().support("ok").sample(jax.random.key(1), 250)
KEY = jax.random.key(2)
MILD = (0.1, 0.1, 0.0, 0.0, 0.1)
AS_OBSERVED = " (the observation has shape [2])"


def troubled(*rates, **changes):
    """The Gaussian task with that simulator."""
    simulate = HostSimulator(Troubled(*rates, **changes), each=True)
    return dataclasses.replace(gaussian(), simulate=simulate)


def made(task, wanted=40, journal=None):
    """A round's simulations."""
    return simulate_in_waves(KEY, task, THETA, wanted, (2,), journal)


def befallen(rates, attempted):
    """What befalls the first simulations of the round, by the generators alone."""
    words = np.asarray(jax.random.key_data(KEY)).tolist()
    return collections.Counter(Troubled(rates).way(generator(words, i)) for i in range(attempted))


class LastFirst(Executor):
    """Makes the newest of all that was submitted first."""

    def __init__(self):
        self.waiting, self.submitted = [], threading.Semaphore(0)
        threading.Thread(target=self.work, daemon=True).start()

    def submit(self, function, *arguments):
        future = Future()
        self.waiting.append((future, function, arguments))
        self.submitted.release()
        return future

    def work(self):
        while self.submitted.acquire():
            future, function, arguments = self.waiting.pop()
            future.set_result(function(*arguments))


def test_the_same_bits_for_any_number_of_workers_and_any_order_of_arrival():
    task = troubled(MILD)
    here = made(task)
    assert int(here.succeeded) == 40 and int(here.attempted) > 45
    for count in (1, 2, 4):
        with workers(count) as executor:
            assert_same(made(one_by_one(task, executor)), here)
    assert_same(made(one_by_one(task, LastFirst())), here)
    with ThreadPoolExecutor(3) as executor:
        assert_same(made(one_by_one(task, executor)), here)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        assert_same(made(one_by_one(task, executor)), here)


def test_processes_for_simulations_import_no_jax():
    script = "import sys, jaxlfi.tasks.supervisor, jaxlfi.tasks.command; assert not {'jax', 'flax'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


def assert_same(a, b):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def test_each_way_to_fail_is_counted_and_the_rest_is_unharmed():
    rates = (0.06, 0.06, 0.03, 0.06, 0.06)
    task = troubled(rates)
    with workers(4) as executor:
        found = made(one_by_one(task, executor, timeout=1.0), wanted=60)
    assert int(found.succeeded) == 60
    expected = befallen(rates, int(found.attempted))
    assert all(expected[way] for way in WAYS)
    reasons = dict(zip(task.reasons, found.failed(len(task.reasons)).tolist(), strict=True))
    assert reasons == {"failed": 0, **{way: expected[way] for way in WAYS}}
    calm = np.asarray(made(troubled(), wanted=int(found.attempted)).x)  # by the same generators, without troubles
    kept = np.flatnonzero(found.kept)
    np.testing.assert_array_equal(np.asarray(found.x)[kept], calm[kept])


def test_of_simulations_that_crash_now_and_then_none_is_lost(tmp_path):
    rates = (0.0, 0.0, 0.0, 0.05, 0.0)
    with workers(2) as executor:
        found = made(one_by_one(troubled(rates, folder=str(tmp_path)), executor), wanted=200)
    crashes = befallen(rates, int(found.attempted))["crash"]
    assert int(found.succeeded) == 200 and int(found.attempted) == 200 + crashes == calls(tmp_path) and crashes >= 3


def test_what_hangs_is_killed_with_all_it_has_started():
    supervisor, request = Supervisor(cloudpickle.dumps(Troubled((0.0, 0.0, 1.0)))), Request([0, 0], 0, [0.0, 0.0], [2])
    began = time.monotonic()
    with ThreadPoolExecutor(1) as executor:
        future = executor.submit(supervisor.simulate, request, 1.0)
        time.sleep(0.5)
        group = supervisor._process.pid
        os.killpg(group, 0)  # it is there, with the program that it has started
        answer = future.result()
    assert answer.outcome == -3 and answer.message == "took longer than 1 s" and time.monotonic() - began < 8
    assert ended(group)


def ended(group: int, seconds: float = 5.0) -> bool:
    """Whether the processes of a group end within seconds: the system has to collect what was started."""
    until = time.monotonic() + seconds
    while True:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        if time.monotonic() > until:
            return False
        time.sleep(0.1)


def test_what_a_simulation_has_started_ends_with_the_process_that_waits_for_it():
    script = (
        "import cloudpickle, sys, threading, time; from jaxlfi.tasks.supervisor import Supervisor; "
        "from jaxlfi.tasks.worker import Request; from tests.troubled import Troubled; "
        "supervisor = Supervisor(cloudpickle.dumps(Troubled((0.0, 0.0, 1.0)))); "
        "request = Request([0, 0], 0, [0.0, 0.0], [2]); "
        "threading.Thread(target=supervisor.simulate, args=(request, None), daemon=True).start(); time.sleep(1.5); "
        "print(supervisor._process.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        group = int(process.stdout.readline())
        assert not ended(group, 0.0)
        process.kill()
    assert ended(group)


def test_processes_end_with_their_executor_even_in_the_midst_of_simulations():
    task = troubled(seconds=30.0)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), workers(2) as executor:
        requests = [Request([0, 0], place, [0.0, 0.0], [2]) for place in range(9)]
        futures = [executor.submit(simulate_supervised, task.simulate._payload, request, None) for request in requests]
        time.sleep(1.0)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 10
    assert [future.result().outcome for future in futures[:2]] == [-4, -4]
    assert all(future.cancelled() for future in futures[2:])


def test_a_function_that_hangs_needs_no_executor_to_be_ended():
    task = troubled((0.0, 0.0, 1.0))
    limited = one_by_one(task, timeout=0.2)
    _, _, failure = simulate_batch(KEY, limited, THETA[:2], (2,))
    assert [limited.reasons[code - 1] for code in failure] == ["timeout", "timeout"]


def test_a_simulator_of_batches_makes_one_at_a_time():
    def batch(rng, theta):
        assert len(theta) == 1
        return theta + rng.normal(size=theta.shape), np.ones(1, bool)

    task = one_by_one(dataclasses.replace(gaussian(), simulate=HostSimulator(batch)))
    assert task == one_by_one(task) and hash(task.simulate)  # equal tasks share their compiled programs
    assert int(made(task).attempted) == 40


def test_trials_are_made_together():
    task = repeated(troubled((0.0, 0.0, 0.0, 0.0, 0.0)), 3)
    trajectories, _, failure = simulate_batch(KEY, task, THETA[:4], (6,))
    assert trajectories.shape == (4, 6) and not failure.any() and task.one_by_one
    assert task == repeated(troubled(), 3)  # and shares its compiled programs
    later = iter([True, 3, False])
    _, outcome = Trials(lambda rng, theta: (theta, next(later)), 3)(None, np.zeros(2))
    assert outcome == 3  # the first failure's
    own = generator(np.asarray(jax.random.key_data(KEY)).tolist(), 0)
    np.testing.assert_array_equal(trajectories[0, :2], Troubled()(own, np.asarray(THETA[0])))


@pytest.mark.parametrize(
    ("function", "outcome", "message"),
    [
        (lambda rng, theta: theta, 0, ""),
        (lambda rng, theta: (theta, True), 0, ""),
        (lambda rng, theta: (theta, False), 1, ""),
        (lambda rng, theta: (theta, 7), 7, ""),
        (lambda rng, theta: (theta, -7), 1, ""),
        (lambda rng, theta: 1 / 0, -1, "ZeroDivisionError: division by zero"),
        (lambda rng, theta: sys.exit(3), -1, "SystemExit: 3"),
        (lambda rng, theta: theta[:1], -2, f"expected numbers of shape [2], got float32 of shape [1]{AS_OBSERVED}"),
        (lambda rng, theta: "no", -2, f"expected numbers of shape [2], got <U2 of shape []{AS_OBSERVED}"),
        (lambda rng, theta: (theta, theta), -2, "expected a scalar outcome, got float32 of shape [2]"),
    ],
)
def test_one_simulation_is_checked(function, outcome, message):
    answer = simulated(function, Request([0, 1], 0, [0.5, 0.5], [2]))
    assert (answer.outcome, answer.message) == (outcome, message)
    assert answer.trajectory.shape == ((2,) if outcome >= 0 else (0,))


def test_generators_differ_by_key_and_place():
    draws = {generator(words, place).uniform() for words in ([1, 2], [1, 3], [2, 1]) for place in range(50)}
    assert len(draws) == 150


def test_finished_simulations_are_found_again_and_a_torn_one_is_made_again(tmp_path):
    path, folder = tmp_path / "simulations.bin", tmp_path / "calls"
    folder.mkdir()
    task = troubled(MILD, folder=str(folder))
    whole = made(task, journal=Journal(path))
    attempted = int(whole.attempted)
    assert calls(folder) == attempted
    assert_same(made(task, journal=Journal(path)), whole)
    assert calls(folder) == attempted  # none again
    path.write_bytes(path.read_bytes()[:-5])
    seen = []
    again = Journal(path, lambda *numbers: seen.append(numbers))
    assert_same(made(task, journal=again), whole)
    assert calls(folder) == attempted + 1 and seen[-1] == (attempted, 40)
    assert set(again.failure_messages.split("; ")) == {
        "",
        "error: ZeroDivisionError: bad luck",
        "wrong_shape: expected numbers of shape [2], got float64 of shape [7] (the observation has shape [2])",
    }
    again.clear()
    assert not path.exists()


class Broken(Executor):
    """Loses what it is given."""

    def __init__(self, error):
        self.error = error

    def submit(self, function, *arguments):
        future = Future()
        future.set_exception(self.error)
        return future


def test_the_loss_of_an_executor_is_told_apart_from_a_failing_simulation():
    with pytest.raises(ExecutorError, match=r"^executor: connection lost while simulating \(OSError: gone\)$"):
        made(one_by_one(troubled(), Broken(OSError("gone"))))
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    with pytest.raises(ExecutorError, match="cannot schedule new futures after shutdown"):
        made(one_by_one(troubled(), executor))
    killed = type("KilledWorker", (Exception,), {})  # what Dask says of a task that has outlived several workers
    found = made(one_by_one(troubled(), Broken(killed("thrice"))))
    assert found.failed(6).tolist() == [0, 0, 0, 0, 250, 0]


def test_a_simulator_that_workers_cannot_load_ends_the_run_in_one_line(monkeypatch):
    module = types.ModuleType("only_here")
    exec("def simulate(rng, theta):\n    return theta", module.__dict__)
    module.simulate.__module__ = "only_here"
    monkeypatch.setitem(sys.modules, "only_here", module)
    task = dataclasses.replace(gaussian(), simulate=HostSimulator(module.simulate, each=True))
    with workers(1) as executor, pytest.raises(SimulatorError, match="cannot load the simulator: ModuleNotFoundError"):
        made(one_by_one(task, executor))
    unsendable = HostSimulator(threading.Lock().acquire, each=True)
    with (
        workers(1) as executor,
        pytest.raises(SimulatorError, match="sent to another process, got TypeError"),
    ):
        made(one_by_one(dataclasses.replace(gaussian(), simulate=unsendable), executor))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HostSimulator(print, timeout=1.0), "each: expected True where there is a timeout or an executor"),
        (
            lambda: HostSimulator(print, each=True, timeout=0.0),
            "timeout: expected a number of seconds above 0",
        ),
        (lambda: one_by_one(gaussian()), "executor: expected a task with a host simulator, got gaussian_linear"),
        (lambda: one_by_one(troubled(), 3), "executor: expected a concurrent.futures.Executor, got int"),
        (lambda: workers(0).__enter__(), "workers: expected at least 1, got 0"),
        (
            lambda: dataclasses.replace(troubled(), failures=("crash",)),
            r"failures: expected other names than those of every simulator, got \['crash'\]",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
