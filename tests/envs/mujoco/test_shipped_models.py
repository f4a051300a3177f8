"""The models that MuJoCo's own tests of system identification identify: their numbers are found."""

import ast
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco.least_squares import best_fits
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter

FOLDER = Path(mujoco.__file__).parent / "sysid/tests"
if not FOLDER.is_dir():
    pytest.skip("this MuJoCo ships no tests of system identification", allow_module_level=True)

MOTION = 1.5
"""s."""


def model(file, name):
    """The text of a model among a file's constants."""
    for one in ast.parse((FOLDER / file).read_text()).body:
        if isinstance(one, ast.Assign) and one.targets[0].id == name:
            return ast.literal_eval(one.value)
    raise LookupError(name)


def recorded(xml, edit, signals, push, start=()):
    """What a plain loop of steps measures every 10 ms of an edited model."""
    spec = mujoco.MjSpec.from_string(xml)
    edit(spec)
    own = spec.compile()
    data, rows = mujoco.MjData(own), []
    data.qpos[: len(start)] = start
    every = round(0.01 / own.opt.timestep)
    times = 0.01 * np.arange(round(MOTION / 0.01))
    controls = np.stack([push(times, number) for number in range(own.nu)]) if own.nu else np.zeros((0, len(times)))
    for row in range(len(times)):
        mujoco.mj_forward(own, data)
        rows.append([read(data) for read in signals.values()])
        data.ctrl[:] = controls[:, row]
        for _ in range(every):
            mujoco.mj_step(own, data)
    names = [own.actuator(i).name for i in range(own.nu)]
    measured = dict(zip(signals, np.array(rows).T, strict=True))
    return Log(times, dict(zip(names, controls, strict=True)) | measured)


def joint(name):
    return lambda data: data.joint(name).qpos[0]


def spring(spec):
    spec.joint("slide").stiffness[0], spec.joint("slide").damping[0] = 130.0, 3.0


def oscillator(spec):
    spec.joint("j1").stiffness[0], spec.joint("j1").damping[0] = 7.0, 0.4


def arm(spec):
    for number in range(1, 6):
        spec.joint(f"joint{number}").armature = 0.55 - 0.07 * number


def box(spec):
    spec.pair("box_floor").friction[1] = 0.2  # along the push


CASES = {
    "spring": (
        "test_integration.py", "SPRING_MASS_XML", spring, {"position": joint("slide")},
        lambda times, _: 20 * np.sin(3 * times) + 10 * times, {},
        {"joint/slide/stiffness": (20, 500, 130), "joint/slide/damping": (1, 20, 3)},
    ),
    "oscillator": (
        "conftest.py", "OSCILLATOR_XML", oscillator, {"joint/j1/qpos": joint("j1")},
        None, {"j1/qpos": 0.3}, {"joint/j1/stiffness": (1, 30, 7), "joint/j1/damping": (0.1, 3, 0.4)},
    ),
    "arm": (
        "test_integration.py", "ARM_XML", arm, {f"joint{i}_pos": joint(f"joint{i}") for i in range(1, 6)},
        lambda times, number: (2 - 0.3 * number) * np.sin((2 + number) * times + number), {},
        {f"joint/joint{i}/armature": (0.05, 1.0, 0.55 - 0.07 * i) for i in range(1, 6)},
    ),
    "box": (
        "conftest.py", "BOX_XML", box, {"body/box/pos[0]": lambda data: data.body("box").xpos[0]},
        lambda times, _: np.where(times < 0.8, 18.0, 0.0), {},
        {"pair/box_floor/friction[1]": (0.05, 0.32, 0.2)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_its_numbers_are_found(name):
    file, constant, edit, signals, push, initial, numbers = CASES[name]
    xml = model(file, constant)
    log = recorded(xml, edit, signals, push, list(initial.values()))
    parameters = [Parameter(key, (low, high), log=True, truth=truth) for key, (low, high, truth) in numbers.items()]
    own = mujoco_task(xml, parameters, log, list(signals), dict.fromkeys(signals, 1e-4), initial)
    # Contacts have local minima: from the best of a few starts on either side.
    starts = [[low ** (1 - side) * high**side for low, high, _ in numbers.values()] for side in (0.2, 0.4, 0.65, 0.8)]
    found, *_ = best_fits(own, np.array(starts), keep=2)
    np.testing.assert_allclose(found.theta, np.asarray(own.truth), rtol=0.02)
    assert found.misfit < 1 and not found.at_bound.any()
