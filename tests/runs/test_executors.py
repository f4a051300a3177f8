"""Whole runs through executors: the same bits as without, also after a kill or the loss of a cluster."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.io import files as atomic
from jaxlfi.tasks import failures
from jaxlfi.tasks.executors import workers
from tests.small import FLAGS, SETTINGS, command, read_ledger, whole_runs  # noqa: F401 - a fixture
from tests.troubled import calls, task

ROOT = Path(__file__).parents[2]
SLOW = 0.05
"""Seconds of a simulation, so that a run can be stopped between two."""
WANTED = 20
"""Successes of a round."""


def arguments(folder, crash=0.05):
    """The command line of a run whose simulations leave files in a folder."""
    folder.mkdir()
    name = f"tests.troubled:task,folder={folder},seconds={SLOW},crash={crash}"
    return ("infer", name, *FLAGS, "--simulation-timeout", "30")


def results(out):
    """A run's arrays but for times, as bytes."""
    found = {}
    for name in ("posterior.npz", "dataset.npz", "history.npz"):
        arrays = atomic.read_arrays(out / name)
        found |= {(name, key): value.tobytes() for key, value in arrays.items() if key != "seconds"}
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nobody stopped: its results, how often its simulator was called, and its folder."""
    root = tmp_path_factory.mktemp("whole")
    assert command(*arguments(root / "calls"), "--workers", "4", "--out", root / "run") == 0
    return results(root / "run"), calls(root / "calls"), root / "run"


@pytest.mark.slow
def test_infer_takes_an_executor_and_gives_the_same_run_without():
    infer = lambda **how: jaxlfi.infer(jax.random.key(0), task(), settings=SETTINGS, simulation_timeout=30.0, **how)
    alone = infer()
    with workers(2) as executor:
        through = infer(executor=executor)
    np.testing.assert_array_equal(alone.dataset.x, through.dataset.x)
    np.testing.assert_array_equal(alone.belief.mixture.means, through.belief.mixture.means)
    np.testing.assert_array_equal(alone.history["failed"], through.history["failed"])


REASONS = ("error", "wrong_shape", "timeout", "crash", "non_finite")


def test_failures_are_in_the_ledger_by_reason(whole):
    lines = read_ledger(whole[2])
    assert all(set(line["failed"]) == {"failed", *REASONS} for line in lines)
    assert sum(line["failed"]["crash"] + line["failed"]["error"] for line in lines) >= 1
    assert all(line["attempted"] == line["succeeded"] + sum(line["failed"].values()) for line in lines)
    said = {(one.round, one.reason): one.count for one in failures.read(whole[2])}  # each reason has one message here
    counts = {(line["round"], reason): line["failed"][reason] for line in lines for reason in ("error", "crash")}
    assert said == {place: count for place, count in counts.items() if count}


@pytest.mark.slow
def test_a_run_that_was_killed_repeats_no_finished_simulation(whole, tmp_path):
    out, folder = tmp_path / "run", tmp_path / "calls"
    words = [sys.executable, "-m", "jaxlfi", *map(str, arguments(folder)), "--workers", "2", "--out", str(out)]
    process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(ROOT)})
    until(lambda: calls(folder) >= WANTED // 2 or process.poll() is not None)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (out / "checkpoint" / "simulations.bin").stat().st_size > 0
    time.sleep(10 * SLOW)  # its workers end by themselves
    began = calls(folder)
    assert WANTED // 2 <= began < WANTED
    assert command("resume", out, "--workers", "3", "--no-figures") == 0
    assert results(out) == whole[0]
    assert (out / failures.FILE).read_text() == (whole[2] / failures.FILE).read_text()
    assert whole[1] <= calls(folder) <= whole[1] + 2  # those that were under way as it was killed
    assert not (out / "checkpoint" / "simulations.bin").exists()


def until(condition, seconds=120.0):
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def cluster():
    """A Dask scheduler and two workers, each a process of its own, on loopback."""
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    start = lambda *words: subprocess.Popen(
        [sys.executable, "-m", *words, "--no-dashboard"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    host = start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0")
    address = next(line for line in host.stderr if "Scheduler at:" in line).split()[-1]
    drain(host)
    members = [start("distributed.cli.dask_worker", address, "--nthreads", "1") for _ in range(2)]
    for member in members:
        next(line for line in member.stderr if "Registered to:" in line)
        drain(member)
    try:
        yield host, address
    finally:
        for process in (*members, host):
            process.terminate()
        for process in (*members, host):
            process.wait(20)


def drain(process):
    """Read on what a process says, so that it never waits."""
    threading.Thread(target=lambda: list(process.stderr), daemon=True).start()


@pytest.mark.slow
def test_a_run_on_a_dask_cluster_survives_the_loss_of_its_scheduler(whole, cluster, tmp_path, capsys):
    (host, address), out, folder = cluster, tmp_path / "run", tmp_path / "calls"
    words = arguments(folder)
    assert command(*words, "--scheduler", address, "--out", tmp_path / "undisturbed") == 0
    assert results(tmp_path / "undisturbed") == whole[0] and calls(folder) == whole[1]
    for path in folder.iterdir():
        path.unlink()
    capsys.readouterr()

    def lose():
        until(lambda: calls(folder) >= WANTED // 2)
        host.kill()

    threading.Thread(target=lose, daemon=True).start()
    assert command(*words, "--scheduler", address, "--out", out) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and message.startswith("jaxlfi: error: executor: connection lost while simulating")
    assert message.endswith(f"continue with: jaxlfi resume {out}\n")
    time.sleep(10 * SLOW)
    assert WANTED // 2 <= calls(folder) < whole[1]
    assert command("resume", out, "--no-figures") == 0
    assert f"simulations: in {len(os.sched_getaffinity(0))} processes on this machine" in capsys.readouterr().out
    assert results(out) == whole[0]
    assert calls(folder) <= whole[1] + 6  # what the workers had begun, and what they went on with


def test_the_way_of_simulating_is_kept_with_the_run(whole, tmp_path):
    config = json.loads((whole[2] / "config.json").read_text())
    assert (config["one_by_one"], config["simulation_timeout"], config["executor"]) == (True, 30.0, True)
    run = jaxlfi.load(whole[2])
    assert run.task.reasons == ("failed", *REASONS) and run.task.simulate.timeout == 30.0
    again = run.save(tmp_path / "again")
    assert read_ledger(again)[0]["failed"] == read_ledger(whole[2])[0]["failed"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("gaussian_linear", "--workers", "2"), "executor: expected a task with a host simulator, got gaussian_linear"),
        (("tests.troubled:task", "--workers", "0"), "workers: expected at least 1, got 0"),
        (("tests.troubled:task", "--workers", "2", "--scheduler", "x"), "workers, scheduler: expected one of them"),
        (("tests.troubled:task", "--simulation-timeout", "0"), "timeout: expected a number of seconds above 0"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(words, message, tmp_path, capsys):
    assert command("infer", *words, *FLAGS, "--out", tmp_path / "run") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and message in said and not (tmp_path / "run").exists()


def test_no_scheduler_is_one_line(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr("jaxlfi.tasks.executors.CONNECT", 0.5)
    assert command("infer", "tests.troubled:task", "--scheduler", "tcp://127.0.0.1:9", "--out", tmp_path / "run") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "scheduler: expected a Dask scheduler at tcp://127.0.0.1:9, got" in said
    assert not (tmp_path / "run").exists()


def test_a_simulator_that_always_fails_says_why(tmp_path, capsys):
    folder = tmp_path / "calls"
    assert command(*arguments(folder, crash=0.98), "--workers", "2", "--out", tmp_path / "run") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "crash: 2" in said and "; crash: its process ended with signal SIGSEGV" in said
    assert not (tmp_path / "run").exists()
