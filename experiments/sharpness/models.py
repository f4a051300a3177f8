"""Examples of MuJoCo models, on the recordings' controls, with the noise of their sensors and without other errors."""

import copy
import dataclasses
import functools
from pathlib import Path

import numpy as np

from experiments.sharpness.problem import Problem
from jaxlfi.registry import TASKS
from jaxlfi.tasks.host import HostSimulator

FOLDER = Path("examples/mujoco")
INFORMED = {"mujoco_puck": ("geom/puck/friction[0]", "geom/puck/solref[1]")}
"""Where the data leave a parameter's sign open, a box on the wrong side of zero is none that is wrong."""


@functools.cache
def problem(name: str) -> Problem:
    """The problem of an example: "mujoco_" and the example's name.

    The forces that its model lacks are left out, so that the likelihood is that of white noise on the rows that the
    summary keeps; observations are simulated by the model itself.
    """
    example = TASKS.load(f"mujoco,config={FOLDER / name.removeprefix('mujoco_')}.toml")
    simulator = copy.copy(example.simulate.function)
    # What each simulation redraws would have to be integrated out.
    simulator.forces, simulator.discrepancies = None, {}
    box = example.supports["right"]
    task = dataclasses.replace(
        example, simulate=HostSimulator(simulator), supports={"box": box}, observation=None, name=name, settings={}
    )

    def log_likelihood(theta, x):
        clean, outcome = simulator.clean(theta)
        residual = (clean - np.asarray(x, float)) / simulator.noise
        rows = np.asarray(task.summary(np.arange(len(x))[:, None])).astype(int)
        found = -0.5 * np.sum(residual[:, rows] ** 2, axis=(1, 2))
        return np.where(outcome == 0, found, -np.inf)

    natural = lambda bound: tuple(np.asarray(bound, float).tolist())
    return Problem(
        name, simulator, task.names, task.units, natural(task.truth), natural(box.low), natural(box.high),
        log=task.log, host_log_likelihood=log_likelihood, declared=task,
        informed=INFORMED.get(name), kept=True,
    )  # fmt: skip
