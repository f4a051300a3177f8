"""Folders for one process at a time."""

import subprocess
import sys

import pytest

from jaxlfi.io.locks import locked

pytest.importorskip("fcntl")

HOLDS = """
import sys, time
from pathlib import Path
from jaxlfi.io.locks import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_held_by_one_and_let_go_of_however_it_ends(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    other = subprocess.Popen([sys.executable, "-c", HOLDS, str(folder)], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    with pytest.raises(BlockingIOError, match="no other process works in, got one that another works in") as error:
        locked(folder).__enter__()
    assert str(folder) in str(error.value) and "\n" not in str(error.value)
    moved = folder.rename(tmp_path / "moved")
    with pytest.raises(BlockingIOError):
        locked(moved).__enter__()
    other.kill()
    other.wait()
    for _ in range(2):  # the second time after it was let go of
        with locked(moved):
            pass
    assert not list(moved.iterdir())


def test_a_file_system_without_locks_has_none(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError("no locks available")

    monkeypatch.setattr("jaxlfi.io.locks.fcntl.flock", refused)
    with locked(tmp_path), locked(tmp_path):
        pass
