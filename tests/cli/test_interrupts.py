"""Ctrl-C ends a command with exit status 130 within a second, whatever it is doing; a closed pipe ends it quietly."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from jaxlfi.cli import interrupts

PATIENCE = 4.0 + interrupts.PATIENCE
"""Seconds that a busy machine may take over what takes a fraction of a second."""
START = "import sys; from jaxlfi.cli import interrupts; ready = lambda: print('ready', flush=True)\n"
LOST = {
    "garbage collector": """
        import gc, time

        def callback(phase, info):
            if phase == "start":
                time.sleep(0.3)

        def work():
            gc.callbacks.append(callback)
            ready()
            gc.collect()
            for _ in range(1000):
                time.sleep(0.05)
        """,
    "finaliser": """
        import time

        class Slow:
            def __del__(self):
                ready()
                time.sleep(0.3)

        def work():
            Slow()
            for _ in range(1000):
                time.sleep(0.05)
        """,
    "native code": """
        import hashlib

        def work():
            ready()
            hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
        """,
    "code that catches everything": """
        import time

        def work():
            ready()
            while True:
                try:
                    time.sleep(60)
                except:
                    pass
        """,
    "code that turns it into another exception": """
        import time

        def work():
            ready()
            try:
                time.sleep(60)
            except BaseException as error:
                raise RuntimeError("native code failed") from error
        """,
    "code that turns it into bad input": """
        import time
        from jaxlfi.cli.exit_status import exit_status

        def load():
            try:
                time.sleep(60)
            except BaseException as error:
                raise ValueError("cannot load") from error

        def work():
            ready()
            return exit_status("jaxlfi", load)
        """,
    "the last acts of Python": """
        import atexit, time

        def last():
            ready()
            time.sleep(60)

        def work():
            atexit.register(last)
            return 0
        """,
    "a thread that never ends": """
        import threading, time

        def work():
            threading.Thread(target=time.sleep, args=(60,)).start()
            ready()
            time.sleep(60)
        """,
}
"""Programs that lose KeyboardInterrupt, or that it does not reach, once they have said that they are ready."""


def started(*words: str) -> subprocess.Popen:
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def interrupted(process: subprocess.Popen) -> tuple[int, str, float]:
    """Exit status, standard error, and seconds from the signal to the end."""
    os.killpg(process.pid, signal.SIGINT)
    begun = time.monotonic()
    try:
        errors = process.communicate(timeout=20)[1]
    finally:
        process.kill()
    return process.returncode, errors, time.monotonic() - begun


def program(body: str, orderly: bool = True) -> subprocess.Popen:
    """A process whose work is watched, when it is ready."""
    end = f"with interrupts.orderly({orderly}):\n    sys.exit(interrupts.watched(work))"
    process = started(sys.executable, "-c", f"{START}{textwrap.dedent(body)}\n{end}")
    assert process.stdout.readline() == "ready\n", process.stderr.read()
    return process


@pytest.mark.parametrize("orderly", [True, False])
@pytest.mark.parametrize("body", LOST.values(), ids=LOST)
def test_no_code_can_lose_an_interrupt(body, orderly):
    status, errors, seconds = interrupted(program(body, orderly))
    assert status == 130 and seconds < PATIENCE
    assert "jaxlfi: interrupted\n" in errors or not errors  # which has said what it had to, in its last acts
    assert "Traceback" not in errors and "ignored" not in errors


def test_what_cleans_up_is_let_do_so_and_the_advice_is_the_outermost(tmp_path):
    body = f"""
        import pathlib, time
        from jaxlfi.cli.exit_status import exit_status

        def inner():
            try:
                ready()
                time.sleep(60)
            finally:
                pathlib.Path({str(tmp_path / "cleaned")!r}).touch()

        def outer():
            if exit_status("jaxlfi inner", inner, advice=lambda: "; no") == interrupts.INTERRUPTED:
                raise KeyboardInterrupt

        def work():
            return exit_status("jaxlfi outer", outer, advice=lambda: "; again")
        """
    assert interrupted(program(body))[:2] == (130, "jaxlfi outer: interrupted; again\n")
    assert (tmp_path / "cleaned").exists()


def test_who_handles_signals_meanwhile_is_left_alone():
    body = """
        import time
        from jaxlfi.robots.interrupts import Interrupts

        def work():
            with Interrupts():
                ready()
                time.sleep(1.5 * interrupts.PATIENCE)  # a robot is being stopped
                print("stopped", file=sys.stderr, flush=True)
        """
    status, errors, _ = interrupted(program(body))
    assert status == 130 and errors == "stopped\njaxlfi: interrupted\n"


def inferring(*words: str) -> subprocess.Popen:
    """A run whose process has come to our program: what Python does before takes seconds on a busy machine."""
    start = "import sys; from jaxlfi.cli.start import main; print('ready', flush=True); sys.exit(main())"
    process = started(sys.executable, "-c", start, "infer", "gaussian_linear", "--no-figures", *words)
    assert process.stdout.readline() == "ready\n", process.stderr.read()
    return process


@pytest.mark.parametrize("seconds", [0.4, pytest.param(1.5, marks=pytest.mark.slow), 3.0])
def test_a_run_is_interrupted_at_any_moment(seconds, tmp_path):
    process = inferring("--no-cache", "--out", str(tmp_path / "out"))
    time.sleep(seconds)
    status, errors, took = interrupted(process)
    assert status == 130 and took < PATIENCE, errors
    (line,) = errors.splitlines()
    assert line.startswith("jaxlfi: interrupted")


@pytest.mark.slow
def test_fifty_of_fifty(tmp_path):
    """The signals come at moments spread over the start, imports, compiling and the rounds."""
    late = []
    for place in range(50):
        process = inferring("--out", str(tmp_path / str(place)))
        time.sleep(0.4 * 1.06**place)
        status, errors, took = interrupted(process)
        if status != 130 or took > PATIENCE:
            late.append((place, status, took, errors))
    assert late == []


@pytest.mark.parametrize("words", [("--help",), ("infer", "--help"), ("tasks", "gaussian_linear")], ids=" ".join)
def test_a_pipe_that_nobody_reads_ends_a_command_quietly(words):
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "jaxlfi", *words], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert done.stderr == "" and done.returncode in (0, interrupts.UNREAD)  # argparse hides what a long help meets
