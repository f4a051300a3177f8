"""Trainings shared out among several processes, joined over the loopback."""

import json
import os
import time

import numpy as np
import pytest

pytest.importorskip("brax")

from jaxlfi.io import files
from tests.hosts import done, started
from tests.small import command

WORDS = ["train", "rl.toy:Line", "--domain", "uniform", "--seeds", 3, "--no-figures", "--environments", 4,
         "--unroll", 5, "--segments", 2, "--minibatches", 4, "--epochs", 3, "--hidden", 8, 8]  # fmt: skip


@pytest.fixture(autouse=True)
def the_tests_environment(monkeypatch):
    """The processes that are started find rl.toy, as this one does, and have two devices each."""
    folders = [os.path.dirname(os.path.dirname(__file__)), os.environ.get("PYTHONPATH")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2")


def arrays(folder):
    """All arrays of a folder but the seconds, by file and name."""
    return {
        (str(path.relative_to(folder)), name): value
        for path in sorted(folder.rglob("*.npz"))
        for name, value in files.read_arrays(path).items()
        if name != "seconds"
    }


@pytest.mark.slow
def test_two_processes_of_two_devices_train_what_one_trains(tmp_path):
    words = [*WORDS, "--total-steps", 80, "--out"]
    said = done(started(2, *words, tmp_path / "two"))
    assert "update 2 of 2" in said and said.count("uniform") >= 3
    assert command(*words, tmp_path / "one") == 0
    two, one = arrays(tmp_path / "two"), arrays(tmp_path / "one")
    assert two.keys() == one.keys() and ("uniform/seed_002/policy.npz", "weight_0") in one
    for name, value in one.items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(two[name], value, rtol=1e-3, atol=1e-3, err_msg=str(name))
    config = json.loads((tmp_path / "two" / "config.json").read_text())
    assert (config["devices"], config["processes"]) == (3, 2)


@pytest.mark.slow
def test_more_processes_than_trainings_are_refused(tmp_path):
    processes = started(2, *WORDS, "--seeds", 1, "--total-steps", 80, "--out", tmp_path / "out")
    _, said = processes[0].communicate(timeout=60)
    assert said == "jaxlfi train: error: processes: expected at most one per run, got 2 for 1\n"
    processes[1].communicate(timeout=60)
    assert [process.returncode for process in processes] == [2, 2] and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_training_whose_process_was_lost_goes_on_to_the_same_bits(tmp_path):
    whole, lost = tmp_path / "whole", tmp_path / "lost"
    words = [*WORDS, "--total-steps", 40 * 2000, "--out"]
    processes = started(2, *words, lost)
    deadline = time.monotonic() + 120
    while not (lost / "checkpoint.npz").exists():
        assert time.monotonic() < deadline and all(process.poll() is None for process in processes)
        time.sleep(0.01)
    processes[1].kill()
    began = time.monotonic()
    _, said = processes[0].communicate(timeout=60)
    assert time.monotonic() - began < 30
    assert (
        said == f"jaxlfi train: error: another process of this command was lost; continue with: jaxlfi resume {lost}\n"
    )
    assert "warning" not in done(started(2, "resume", lost, "--no-figures"))
    done(started(2, *words, whole))
    expected, resumed = arrays(whole), arrays(lost)
    assert expected.keys() == resumed.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(value, resumed[name], err_msg=str(name))
