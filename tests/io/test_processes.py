"""Processes joined by jax.distributed over the loopback: what they exchange, and how they end."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxlfi.io.processes import ALONE

SCRIPT = """
import sys, time
from pathlib import Path
from jaxlfi.cli import multi_process

index, count, address, folder = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], Path(sys.argv[4])

def command():
    import os
    import numpy as np
    from jaxlfi.io import processes

    found = processes.join(address, index, count)
    (folder / f"{index}.pid").write_text(str(os.getpid()))
    large = np.arange(5_000_000.0) + index  # several messages
    whole = found.gather({"own": np.full((2, 3), index), "large": large})
    if found.writes:
        assert whole["own"][:, 0].tolist() == [0, 0, 1, 1], whole
        np.testing.assert_array_equal(whole["large"].reshape(count, -1)[:, [0, -1]], [[0, 4999999], [1, 5000000]])
    else:
        assert whole["large"] is large
    assert found.scatter([np.array([7]), np.array([8])] if found.writes else [np.zeros(0)]).tolist() == [7 + index]
    assert found.broadcast({"x": np.array(index + 5)})["x"] == 5
    (folder / f"{index}.met").touch()
    if sys.argv[5] == "wait":
        if found.writes:
            time.sleep(100)
        found.broadcast(np.zeros(()))
    found.leave()
    return 0

sys.exit(multi_process.work(command, lambda: "; ADVICE", "jaxlfi"))
"""


def started(folder, last: str) -> list[subprocess.Popen]:
    """Two processes of the script."""
    folder.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    return [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(index), "2", address, str(folder), last],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(2)
    ]


def test_a_process_alone_has_all_it_needs():
    tree = {"x": np.arange(3)}
    assert ALONE.writes and ALONE.gather(tree)["x"].tolist() == [0, 1, 2]
    assert ALONE.broadcast(tree) is tree and ALONE.scatter([tree]) is tree
    ALONE.leave()


def test_two_processes_exchange_arrays(tmp_path):
    processes = started(tmp_path / "shared", "leave")
    said = [process.communicate(timeout=60) for process in processes]
    assert said == [("", "")] * 2 and [process.returncode for process in processes] == [0, 0]


@pytest.mark.slow
def test_where_the_coordinator_is_lost_the_other_ends_with_one_line(tmp_path):
    """Another one's loss: tests/runs/test_several_processes.py."""
    folder = tmp_path / "shared"
    first, second = started(folder, "wait")
    deadline = time.monotonic() + 60
    while len(list(folder.glob("*.met"))) < 2:
        assert time.monotonic() < deadline and first.poll() is None and second.poll() is None
        time.sleep(0.05)
    began = time.monotonic()
    os.kill(int((folder / "0.pid").read_text()), signal.SIGKILL)
    said = [process.communicate(timeout=60) for process in (first, second)]
    assert time.monotonic() - began < 30
    assert said == [
        ("", "jaxlfi: error: the process was ended by SIGKILL; ADVICE\n"),
        ("", "jaxlfi: error: another process of this command was lost; ADVICE\n"),
    ]
    assert [process.returncode for process in (first, second)] == [2, 2]
