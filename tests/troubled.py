"""A simulator for tests that fails at random in every possible way; it needs no JAX."""

import dataclasses
import os
import signal
import subprocess
import time
import uuid
from pathlib import Path

import numpy as np

WAYS = ("error", "wrong_shape", "timeout", "crash", "non_finite")


@dataclasses.dataclass(frozen=True)
class Troubled:
    """The Gaussian task's simulator with failures. All instances are equal, so that they share compiled programs.

    Attributes:
        rates: probabilities that a simulation fails in each of `WAYS`.
        folder: folder in which every call leaves a file; none if empty.
        seconds: duration of each simulation, in s.
    """

    rates: tuple[float, ...] = dataclasses.field(default=(0.0,) * 5, compare=False)
    folder: str = dataclasses.field(default="", compare=False)
    seconds: float = dataclasses.field(default=0.0, compare=False)

    def __call__(self, rng, theta):
        """One simulation."""
        way = self.way(rng)
        if self.folder:
            Path(self.folder, uuid.uuid4().hex).touch()
        time.sleep(self.seconds)
        if way == "error":
            raise ZeroDivisionError("bad luck")
        if way == "wrong_shape":
            return np.zeros(7)
        if way == "timeout":
            subprocess.run(["sleep", "1000"], check=False)
        if way == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        return theta * (np.nan if way == "non_finite" else 1.0) + 0.3 * rng.normal(size=2)

    def way(self, rng):
        """How the simulation with this generator fails; None if it does not."""
        place = int(np.searchsorted(np.cumsum(self.rates), rng.uniform(), side="right"))
        return WAYS[place] if place < len(WAYS) else None


def calls(folder) -> int:
    """How often a simulator with this folder was called."""
    return len(list(Path(folder).iterdir()))


def task(folder: str = "", seconds: float = 0.0, crash: float = 0.0):
    """The Gaussian task with this simulator, as the command line finds it."""
    from jaxlfi.envs import gaussian_linear
    from jaxlfi.tasks.host import HostSimulator

    rates = (0.02, 0.0, 0.0, crash, 0.02)
    simulate = HostSimulator(Troubled(rates, folder, seconds), each=True)
    return dataclasses.replace(gaussian_linear.task(), simulate=simulate, observation=np.array([0.5, 0.2], np.float32))
