"""What a command does on a full disk, in a read-only or moved folder, by a clock that jumps, and beside another one."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from tests.reliability.comparing import content, files
from tests.reliability.injection import Blow
from tests.reliability.process import Ended, Running, run
from tests.reliability.undisturbed import Undisturbed

COLUMNS = ("command", "adversity", "status", "lines", "said", "then")
DAY = 86400.0
SIZES = (8, 24, 48, 72, 96, 128, 192)
"""KiB of the disks that become full."""


def all_of(undisturbed: Undisturbed, root: Path) -> list[dict[str, Any]]:
    """Every adversity, one row each."""
    rows = []
    for one in (full_disk, read_only, moved, moved_meanwhile, clock, future, two_resumes, resumed_meanwhile):
        folder = root / f"adversity-{one.__name__}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for row in one(undisturbed, folder):
            row["said"] = row["said"].replace(f"{folder}/", "")
            rows.append({"command": undisturbed.command.name, **row})
            print(rows[-1], flush=True)
    return rows


def _row(adversity: str, ended: Ended, then: str) -> dict[str, Any]:
    lines = ended.errors.strip().splitlines()
    return {
        "adversity": adversity,
        "status": ended.status,
        "lines": len(lines),
        "said": lines[-1] if lines else ended.said.strip().splitlines()[-1] if ended.status == 0 and ended.said else "",
        "then": then,
    }


def _gone_on(undisturbed: Undisturbed, folder: Path, name: str = "run") -> str:
    """Go on where it was stopped, to the end; what came of it."""
    command = undisturbed.command
    begun = (folder / name / "config.json").exists()
    words = tuple(name if word == "run" else word for word in (command.resume if begun else command.start))
    ended = run(folder, words)
    if ended.status:
        return f"exit status {ended.status}: {ended.errors.strip()}"
    found = undisturbed.compared(folder / name)
    return ("resumed: " if begun else "begun anew: ") + ("; ".join(found) or "same bits")


def _stop(undisturbed: Undisturbed, folder: Path) -> None:
    """A folder as a kill in the middle of the run leaves it."""
    folder.mkdir(exist_ok=True)
    assert run(folder, undisturbed.command.start, blow=Blow(_middle(undisturbed), "after")).killed


def _middle(undisturbed: Undisturbed) -> int:
    """The window after which there is something to go on from."""
    kept = ("checkpoint/state.npz.part", "chunks/000.npz.part", "run/checkpoint.npz.part")
    windows = enumerate(undisturbed.ended.windows)
    return next(i for i, window in windows if window.operation == "replace" and window.path.endswith(kept))


def _mount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def full_disk(undisturbed: Undisturbed, folder: Path):
    """Disks of some sizes; then there is room again."""
    for size in SIZES:
        disk = folder / f"disk-{size}"
        disk.mkdir()
        _mount(disk, f"size={size}k")
        try:
            ended = run(disk, undisturbed.command.start)
            if ended.status == 0:
                return
            left = sorted(str(path.relative_to(disk)) for path in files(disk) if path.suffix == ".part")
            subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
            then = _gone_on(undisturbed, disk) + (f"; left over: {left}" if left else "")
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        yield _row(f"a disk of {size} KiB", ended, then)


def read_only(undisturbed: Undisturbed, folder: Path):
    """A new run in a read-only folder, and one to go on with."""
    disk = folder / "disk"
    disk.mkdir()
    _mount(disk, "size=64m")
    try:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        ended = run(disk, undisturbed.command.start)
        yield _row("a new run in a read-only folder", ended, "nothing was written")
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
        _stop(undisturbed, disk)
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        ended = run(disk, undisturbed.command.resume)
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
        yield _row("resume in a read-only folder", ended, _gone_on(undisturbed, disk))
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        ended = run(disk, undisturbed.command.resume)
        yield _row("resume of a finished run in a read-only folder", ended, "")
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def moved(undisturbed: Undisturbed, folder: Path):
    """Killed, moved to another place by another name, resumed there."""
    _stop(undisturbed, folder / "here")
    (folder / "there").mkdir()
    (folder / "here" / "run").rename(folder / "there" / "other")
    command = undisturbed.command
    ended = run(folder / "there", tuple("other" if word == "run" else word for word in command.resume))
    then = "; ".join(undisturbed.compared(folder / "there" / "other")) or "same bits"
    yield _row("a folder moved between kill and resume", ended, f"resumed: {then}")


def moved_meanwhile(undisturbed: Undisturbed, folder: Path):
    """Moved while the run goes on, which so comes to an end; resumed where it is now."""
    process = _held_up(undisturbed, folder)
    (folder / "run").rename(folder / "other")
    os.kill(process.pid, signal.SIGCONT)
    ended = process.wait()
    yield _row("a folder moved while its run goes on", ended, _gone_on(undisturbed, folder, "other"))


def _held_up(undisturbed: Undisturbed, folder: Path) -> Running:
    """A run that has stopped itself after its first round."""
    process = Running(folder, undisturbed.command.start, blow=Blow(_middle(undisturbed), "after", signal.SIGSTOP))
    assert process.stopped()
    return process


def clock(undisturbed: Undisturbed, folder: Path):
    """A day back while the run goes on, and while it is resumed."""
    ended = Running(folder, undisturbed.command.start, clock=True).wait()
    then = "; ".join(undisturbed.compared(folder / "run")) or "same bits"
    yield _row("a clock that jumps back by a day in the run", ended, then)
    _stop(undisturbed, folder / "stopped")
    ended = Running(folder / "stopped", undisturbed.command.resume, clock=True).wait()
    then = "; ".join(undisturbed.compared(folder / "stopped" / "run")) or "same bits"
    yield _row("a clock that jumps back by a day in the resumed run", ended, then)


def future(undisturbed: Undisturbed, folder: Path):
    """Files that were written tomorrow."""
    _stop(undisturbed, folder)
    for path in files(folder / "run"):
        os.utime(path, (time.time() + DAY, time.time() + DAY))
    ended = run(folder, undisturbed.command.resume)
    yield _row("files of tomorrow", ended, "; ".join(undisturbed.compared(folder / "run")) or "same bits")


def two_resumes(undisturbed: Undisturbed, folder: Path, times: int = 3):
    """Two processes that resume the same folder at once."""
    _stop(undisturbed, folder / "stopped")
    for number in range(times):
        both = folder / f"both-{number}"
        shutil.copytree(folder / "stopped", both)
        (folder / f"beside-{number}").mkdir()
        (folder / f"beside-{number}" / "run").symlink_to(both / "run")
        processes = [Running(both, undisturbed.command.resume)]
        processes.append(Running(folder / f"beside-{number}", undisturbed.command.resume))
        won, lost = sorted((process.wait() for process in processes), key=lambda ended: ended.status)
        then = "; ".join(undisturbed.compared(both / "run")) or "same bits"
        yield _row("two resumes at once: the other one", lost, f"the first: status {won.status}, {then}")


def resumed_meanwhile(undisturbed: Undisturbed, folder: Path):
    """A resume while the run itself still goes on."""
    process = _held_up(undisturbed, folder)
    before = {path: path.is_file() and path.suffix != ".notes" and content(path) for path in files(folder / "run")}
    ended = run_beside(folder, undisturbed)
    same = before == {path: path.is_file() and content(path) for path in files(folder / "run")}
    os.kill(process.pid, signal.SIGCONT)
    first = process.wait()
    then = "; ".join(undisturbed.compared(folder / "run")) or "same bits"
    then = f"nothing {'' if same else 'not '}changed; the run: status {first.status}, {then}"
    yield _row("resume while the run goes on", ended, then)


def run_beside(folder: Path, undisturbed: Undisturbed) -> Ended:
    """A resume by a process with notes of its own."""
    beside = folder.parent / f"{folder.name}-beside"
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir()
    (beside / "run").symlink_to(folder / "run")
    return run(beside, undisturbed.command.resume)
