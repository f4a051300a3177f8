"""What a command comes to when nobody disturbs it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.reliability.commands import Command
from tests.reliability.comparing import differences
from tests.reliability.injection import Blow
from tests.reliability.process import run


class Undisturbed:
    """A command that ran to its end, and where it can be disturbed."""

    def __init__(self, command: Command, root: Path):
        """Run it in a process of its own, and once more as the trials are, to know its windows and its time."""
        self.command = command
        fresh = root / f"{command.name}-undisturbed"
        self.folder = fresh / "run"
        if not self.folder.exists():
            fresh.mkdir(parents=True, exist_ok=True)
            words, env = [sys.executable, "-m", command.program], os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
            subprocess.run([*words, *command.start], cwd=fresh, check=True, stdout=subprocess.DEVNULL, env=env)
        trial = root / f"{command.name}-forked"
        shutil.rmtree(trial, ignore_errors=True)
        trial.mkdir()
        self.ended = run(trial, command.start, program=command.program)
        if self.ended.status or (found := self.compared(trial / "run")):
            raise RuntimeError(f"{command.name}: {self.ended.errors}{'' if self.ended.status else found}")
        windows = enumerate(self.ended.windows)
        self.blows = [Blow(number, moment) for number, window in windows for moment in window.moments]

    def compared(self, folder: Path) -> list[str]:
        """What differs from it in a folder."""
        return differences(folder, self.folder)
