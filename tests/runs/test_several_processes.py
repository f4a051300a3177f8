"""Commands in several processes, joined by jax.distributed over the loopback."""

import json
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxlfi.cli import multi_process
from jaxlfi.cli import parser as cli
from jaxlfi.io import files as atomic
from tests.hosts import done, started
from tests.small import FLAGS, TASK, command, whole_runs  # noqa: F401

ROUNDS = 12
RUN = ["infer", TASK, "--support", "ok", "--seeds", 3, *FLAGS, "--rounds", ROUNDS, "--out"]


def arrays(folder):
    """All arrays of a folder but the seconds, by file and name."""
    return {
        (str(path.relative_to(folder)), name): value
        for path in sorted(folder.rglob("*.npz"))
        for name, value in atomic.read_arrays(path).items()
        if name != "seconds"
    }


def lost_in_between(folder) -> subprocess.Popen:
    """A run of three seeds in two processes, of which one is killed once there is a checkpoint: the other one."""
    processes = started(2, *RUN, folder)
    deadline = time.monotonic() + 120
    while not (folder / "checkpoint" / "state.npz").exists():
        assert time.monotonic() < deadline and all(process.poll() is None for process in processes)
        time.sleep(0.01)
    processes[1].kill()
    return processes[0]


@pytest.mark.slow
def test_where_a_process_is_lost_the_other_says_so_and_the_run_goes_on_in_one(tmp_path):
    left = lost_in_between(tmp_path)
    began = time.monotonic()
    _, said = left.communicate(timeout=60)
    assert time.monotonic() - began < 30
    assert said == f"jaxlfi: error: another process of this command was lost; continue with: jaxlfi resume {tmp_path}\n"
    assert left.returncode == 2
    assert command("resume", tmp_path, "--no-figures") == 0
    assert json.loads((tmp_path / "config.json").read_text())["status"] == "finished"
    assert len((tmp_path / "seed_002" / "ledger.jsonl").read_text().splitlines()) == ROUNDS


@pytest.mark.slow
def test_a_run_whose_process_was_lost_goes_on_in_as_many_processes_or_one(tmp_path):
    """Bit for bit the same with as many processes, up to rounding with another number."""
    whole, lost, alone = tmp_path / "whole", tmp_path / "lost", tmp_path / "alone"
    lost_in_between(lost).communicate(timeout=60)
    shutil.copytree(lost, alone)
    assert f"{ROUNDS} of {ROUNDS} rounds" in done(started(2, *RUN, whole))

    assert "warning" not in done(started(2, "resume", lost, "--no-figures"))
    expected, resumed = arrays(whole), arrays(lost)
    assert expected.keys() == resumed.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(value, resumed[name], err_msg=str(name))
    ledgers = [(folder / "seed_002" / "ledger.jsonl").read_text().splitlines() for folder in (whole, lost)]
    assert len(ledgers[0]) == len(ledgers[1]) == ROUNDS
    config = json.loads((lost / "config.json").read_text())
    assert (config["status"], config["devices"], config["processes"]) == ("finished", 3, 2)

    assert command("resume", alone, "--no-figures") == 0
    for name, value in arrays(alone).items():
        if name[0].endswith("posterior.npz") and name[1] in ("support_low", "support_high", "means"):
            np.testing.assert_allclose(value, expected[name], rtol=5e-3, atol=5e-3, err_msg=str(name))


@pytest.mark.slow
def test_four_processes_give_what_one_gives(tmp_path):
    """A grid, whose last chunk is filled up."""
    words = ["grid", TASK, "--support", "misspecified", "--seeds", 5, *FLAGS, "--vary", "expansion=0.1"]
    words += ["--runs-per-chunk", 4, "--out"]
    said = done(started(4, *words, tmp_path / "four"))
    assert "5 runs in 2 chunks of 4" in said
    assert command(*words, tmp_path / "one") == 0
    four, one = (atomic.read_arrays(tmp_path / name / "grid.npz") for name in ("four", "one"))
    for name, value in one.items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(four[name], value, rtol=5e-3, atol=5e-3, err_msg=name)


REFUSED = [
    (["--coordinator", "127.0.0.1:1"], "coordinator: expected --coordinator auto, or"),
    (["--coordinator", "here", "--processes", "2", "--process-id", "0"], "coordinator: expected HOST:PORT, got"),
    (["--coordinator", "a:1", "--processes", "2", "--process-id", "2"], "process_id: expected a number from 0 to"),
    (["--coordinator", "auto", "--processes", "2"], "coordinator: expected --coordinator auto, or"),
]


@pytest.mark.parametrize(("flags", "line"), REFUSED)
def test_flags_that_do_not_fit_are_refused(flags, line):
    arguments = cli.parse(["infer", TASK, *flags, "--out", "out"])
    with pytest.raises(ValueError, match=f"^{line}"):
        multi_process.wanted(arguments)


def test_a_command_refuses_them_in_one_line(tmp_path):
    flags, line = REFUSED[0]
    words = ["infer", TASK, *flags, "--out", str(tmp_path / "out")]
    ended = subprocess.run([sys.executable, "-m", "jaxlfi", *words], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1) and line in ended.stderr
