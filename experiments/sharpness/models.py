"""MuJoCo models, with the noise of their sensors and without other errors.

Examples run under the controls of their recordings. A cart that an elastic belt pulls is not one of them.
"""

import copy
import dataclasses
import functools
from pathlib import Path

import mujoco
import numpy as np

from experiments.design import machines
from experiments.sharpness.problem import Problem
from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.registry import TASKS
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

FOLDER = Path("examples/mujoco")
INFORMED = {"mujoco_puck": ("geom/puck/friction[0]", "geom/puck/solref[1]")}
"""If the data leave a parameter's sign open, a box on the wrong side of zero is not wrong."""
CHIRP = (6.0, 0.5, 6.0)
"""The belt motor's amplitude in N, and first and last frequency in Hz."""


@functools.cache
def problem(name: str) -> Problem:
    """The problem of a model: "mujoco_" and the example's name, or `mujoco_belt`.

    Unmodelled forces are left out, so that the likelihood is that of white noise on the whole recording; observations
    are simulated by the model itself.
    """
    declared, box = _belt() if name == "mujoco_belt" else _example(name.removeprefix("mujoco_"))
    simulator = copy.copy(declared.simulate.function)
    # Numbers that each simulation redraws would have to be integrated out.
    simulator.forces, simulator.discrepancies = None, {}
    task = dataclasses.replace(
        declared, simulate=HostSimulator(simulator), supports={"box": box}, observation=None, name=name, settings={}
    )

    def log_likelihood(theta, x):
        clean, outcome = simulator.clean(theta)
        residual = (clean - np.asarray(x, float)) / simulator.noise
        found = -0.5 * np.sum(residual[:, simulator.there] ** 2, axis=1)
        return np.where(outcome == 0, found, -np.inf)

    natural = lambda bound: tuple(np.asarray(bound, float).tolist())
    return Problem(
        name, simulator, task.names, task.units, natural(task.truth), natural(box.low), natural(box.high),
        log=task.log, host_log_likelihood=log_likelihood, declared=task,
        informed=INFORMED.get(name), kept=True,
    )  # fmt: skip


def _example(name: str) -> tuple[Task, Support]:
    task = TASKS.load(f"mujoco,config={FOLDER / name}.toml")
    return task, task.supports["right"]


def _belt() -> tuple[Task, Support]:
    """The cart driven from rest by a chirp; its position is measured to half a millimetre."""
    parameters = [
        Parameter("tendon/belt/stiffness", (500.0, 2000.0), (200.0, 5000.0), unit="N/m", log=True, truth=1000.0),
        Parameter("tendon/belt/damping", (1.0, 10.0), (0.3, 30.0), unit="N s/m", log=True, truth=3.0),
        Parameter("body/cart/mass", (0.5, 2.0), (0.2, 5.0), unit="kg", log=True, truth=1.0),
        Parameter("joint/cart/frictionloss", (0.0, 1.0), (0.0, 2.0), unit="N", truth=0.3),
    ]
    spec = mujoco.MjSpec.from_string(machines.BELT)
    spec.option.timestep = machines.STEP
    amplitude, first, last = CHIRP
    times = machines.INTERVAL * np.arange(round(machines.DURATION / machines.INTERVAL) + 1)
    turns = first * times + 0.5 * (last - first) * times**2 / machines.DURATION
    place = machines.belt_response(np.array([one.truth for one in parameters]), np.array(CHIRP))
    recorded = Log(times, {"motor": amplitude * np.sin(2 * np.pi * turns), "place": np.asarray(place, float)})
    task = mujoco_task(spec, parameters, recorded, ["place"], {"place": 0.0005}, name="belt")
    return task, task.supports["initial"]
