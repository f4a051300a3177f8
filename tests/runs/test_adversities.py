"""A disk that is full, a folder that another process holds, and what a kill leaves behind at the very end."""

import errno
import shutil

import jax
import pytest

import jaxlfi
from jaxlfi.figures import style
from jaxlfi.io import files as atomic
from jaxlfi.io.locks import locked
from jaxlfi.runs import execute as executing
from jaxlfi.runs.checkpoint import Checkpoint
from tests.killed import Killed, kill_at
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, whole_runs  # noqa: F401 - a fixture


def fill_disk(patch, nth):
    """Let the nth write, and all after it, find no room."""
    write_bytes, count = atomic.write_bytes, [0]

    def write(path, content, durable=False):
        count[0] += 1
        if count[0] >= nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        write_bytes(path, content, durable)

    patch.setattr(atomic, "write_bytes", write)


def test_a_full_disk_is_one_line_and_the_run_goes_on(tmp_path, capsys, monkeypatch):
    out, early = tmp_path / "run", tmp_path / "early"
    with monkeypatch.context() as patch:
        fill_disk(patch, 2)
        assert command("infer", TASK, *FLAGS, "--out", early) == 2
    assert capsys.readouterr().err == "jaxlfi: error: [Errno 28] No space left on device\n" and not early.exists()
    with monkeypatch.context() as patch:
        fill_disk(patch, 3)  # before the first round is kept
        assert command("infer", TASK, *FLAGS, "--out", out) == 2
        again = command("resume", out, "--no-figures")
    expected = f"jaxlfi: error: [Errno 28] No space left on device; continue with: jaxlfi resume {out}\n"
    assert again == 2 and capsys.readouterr().err == 2 * expected
    with monkeypatch.context() as patch:
        fill_disk(patch, 4)  # with the record of a round, and without its state
        assert command("resume", out, "--no-figures") == 2
    assert Checkpoint(out).rounds_done() == 1
    with locked(out):
        capsys.readouterr()
        assert command("resume", out, "--no-figures") == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1 and "expected a folder that no other process works in" in message
    assert command("resume", out, "--no-figures") == 0
    shutil.copytree(out, tmp_path / "killed")
    (tmp_path / "killed" / "checkpoint" / "simulations.bin").touch()  # killed after it had said that it is finished
    assert command("resume", tmp_path / "killed") == 0
    left = lambda folder: sorted(path.relative_to(folder) for path in folder.rglob("*"))
    assert left(tmp_path / "killed") == left(out)


def test_a_grid_on_a_full_disk_goes_on(tmp_path, capsys, monkeypatch):
    out = tmp_path / "grid"
    vary = ("--heuristic", "edge", "--vary", "expansion=0.1,0.2", "--seeds", "1", "--runs-per-chunk", "1")
    with monkeypatch.context() as patch:
        fill_disk(patch, 3)
        assert command("grid", TASK, *FLAGS, *vary, "--out", out) == 2
    message = capsys.readouterr().err
    assert message == f"jaxlfi: error: [Errno 28] No space left on device; continue with: jaxlfi resume {out}\n"
    assert (out / "config.json").exists() and not list(out.rglob("*.part"))


def test_python_tidies_a_finished_run_and_respects_another_process(tmp_path, monkeypatch):
    out = tmp_path / "run"
    infer = lambda: jaxlfi.infer(jax.random.key(0), gaussian(), settings=SETTINGS, out=out)
    with monkeypatch.context() as patch:
        patch.setattr(executing, "clean", lambda folder: None)
        infer()
    Checkpoint(out).simulations.write_bytes(b"of a round that is over")
    with locked(out), pytest.raises(BlockingIOError, match="no other process"):
        infer()
    infer()
    assert not Checkpoint(out).simulations.exists() and Checkpoint(out).folder.exists()  # the state, for more rounds


def test_a_picture_is_drawn_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    figure = style.new_figure(1.0, 1.0)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_at(patch, 1, midway=True)
        style.save(figure, tmp_path / "a.png", 50)
    assert not (tmp_path / "a.png").exists()
    style.save(figure, tmp_path / "a.png", 50)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG") and len(list(tmp_path.iterdir())) == 1
