"""A few kills by `python -m tests.reliability`, in a process of its own, as it forks."""

import csv
import subprocess
import sys

import pytest

pytest.importorskip("brax")
pytest.importorskip("distributed")

pytestmark = pytest.mark.slow


def test_killed_runs_end_in_the_same_bits(tmp_path):
    words = ["--kills", "3", "--commands", "infer", "grid", "--adversities"]
    folders = ["--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-m", "tests.reliability", *words, *folders], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out" / "kills.csv").open(newline="") as file:
        kills = list(csv.DictReader(file))
    assert {row["command"] for row in kills} == {"infer", "grid"}
    assert {row["how"] for row in kills} == {"in a window", "at a moment"}
    assert {row["result"] for row in kills} == {"same bits"}
