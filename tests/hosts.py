"""Commands in several processes, as on several hosts, joined by jax.distributed over the loopback."""

import socket
import subprocess
import sys


def started(count, *words) -> list[subprocess.Popen]:
    """A command of jaxlfi in `count` processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        joined = ["--coordinator", f"127.0.0.1:{free.getsockname()[1]}", "--processes", str(count)]
    return [
        subprocess.Popen(
            [sys.executable, "-m", "jaxlfi", *map(str, words), *joined, "--process-id", str(index)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(count)
    ]


def done(processes) -> str:
    """Wait for the processes to end, and return the output of the first; the others print nothing."""
    said = [process.communicate(timeout=150) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), said
    assert [text for _, text in said] == [""] * len(said)
    assert [text for text, _ in said[1:]] == [""] * len(said[1:])
    return said[0][0]
