"""Make the recordings of these examples: the stand-in for reality is simulated differently than in inference.

    python examples/mujoco/record.py

It uses another integrator (Runge-Kutta, with a tenth of the step) and has effects that the models lack: friction that
falls with speed, the pull of a cable, a gear's backlash, air drag. The true parameters are those of the .toml files;
`recorded` accepts others.
"""

import csv
import dataclasses
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from jaxlfi.envs.mujoco.effects import effects, initial_state
from jaxlfi.envs.mujoco.logs import Log

FOLDER = Path(__file__).parent
STEP = 0.0002
"""Time step of the stand-in for reality, in s; a tenth of the models'."""


@dataclasses.dataclass(frozen=True)
class Reality:
    """How an example's recording is made, besides its model.

    Attributes:
        times: times of the samples, in s.
        controls: control signal of each actuator, shape [T].
        act: function that sets the controls and the forces that the model lacks; called before each step with model,
            data and the requested controls.
        units: units of controls and sensors, as in the table's headings.
    """

    times: np.ndarray
    controls: Mapping[str, np.ndarray]
    act: Callable[[mujoco.MjModel, mujoco.MjData, np.ndarray], None]
    units: Mapping[str, str]


def furuta() -> Reality:
    """A torque whose amplitude falls and whose frequency rises; stiction, and a cable that pulls the arm back."""
    times = 0.01 * np.arange(400)
    torque = 0.08 * np.sin(2 * np.pi * times * (1.0 + 0.3 * times)) * np.exp(-0.15 * times)

    def act(model, data, controls):
        speed, angle = data.qvel[0], data.qpos[0]
        data.ctrl[:] = controls
        data.qfrc_applied[0] = -0.0002 * np.tanh(speed / 0.01) * np.exp(-((speed / 0.3) ** 2)) - 0.00005 * angle

    return Reality(times, {"motor": torque}, act, {"motor": "N m", "arm angle": "rad", "pendulum angle": "rad"})


def arm() -> Reality:
    """Two torques of different frequencies; the elbow's gear has backlash, and both joints have a little stiction."""
    times = 0.01 * np.arange(500)
    shoulder = 0.9 * np.sin(2 * np.pi * times * (0.3 + 0.08 * times))
    elbow = 0.5 * np.sin(2 * np.pi * times * (0.9 - 0.05 * times) + 1.0)
    gap, engaged = 0.006, [0.0, 0.0]  # time to cross the gap, in s; the side of the gear, and since when

    def act(model, data, controls):
        side = np.sign(controls[1])
        if data.time == 0.0 or side != engaged[0]:
            engaged[:] = side, data.time
        data.ctrl[:] = controls[0], controls[1] * (data.time - engaged[1] >= gap)
        data.qfrc_applied[:] = -0.01 * np.tanh(data.qvel / 0.02) * np.exp(-((data.qvel / 0.4) ** 2))

    units = {"shoulder": "", "elbow": "", "shoulder angle": "rad", "elbow angle": "rad"}
    return Reality(times, {"shoulder": shoulder, "elbow": elbow}, act, units)


def puck() -> Reality:
    """The puck flies off, slides, and bounces back from the wall; air drag brakes it a little."""

    def act(model, data, controls):
        data.qfrc_applied[:2] = -0.001 * data.qvel[:2] * np.hypot(*data.qvel[:2])

    return Reality(0.01 * np.arange(120), {}, act, {"distance": "m"})


def finger() -> Reality:
    """The cable is pulled and released twice; its friction takes up a little of the pull."""
    times = 0.02 * np.arange(200)
    pull = 8.0 * np.clip(np.sin(2 * np.pi * times / 2.0), 0.0, None) + 2.0 * (times > 2.5)
    loss = 0.02

    def act(model, data, controls):
        data.ctrl[:] = controls * (1 - loss * np.tanh(data.ten_velocity[0] / 0.05))

    return Reality(times, {"pull": pull}, act, {"pull": "N", "bend": "rad"})


def shuffle() -> Reality:
    """A push, and a second one that reaches the puck again; the pusher's rail sticks a little, air brakes the puck."""
    times = 0.01 * np.arange(250)
    push = np.select([times < 0.15, times < 1.2, times < 1.6], [2.5, 0.0, 3.0])

    def act(model, data, controls):
        data.ctrl[:] = controls
        data.qfrc_applied[0] = -0.02 * np.tanh(data.qvel[0] / 0.01) * np.exp(-((data.qvel[0] / 0.3) ** 2))
        data.qfrc_applied[1] = -0.001 * data.qvel[1] * np.abs(data.qvel[1])

    return Reality(times, {"motor": push}, act, {"motor": "N", "pusher place": "m", "puck place": "m"})


def servo() -> Reality:
    """Targets that change in steps, then a chirp; the hinge has a little stiction, and air drag brakes the link."""
    times = 0.01 * np.arange(400)
    steps = np.select([times < 0.3, times < 1.0, times < 1.8], [0.0, 0.8, -0.5])
    swing = 0.6 * np.sin(2 * np.pi * (times - 1.8) * (0.8 + 0.5 * (times - 1.8)))

    def act(model, data, controls):
        speed = data.qvel[0]
        data.ctrl[:] = controls
        stiction = 0.01 * np.tanh(speed / 0.02) * np.exp(-((speed / 0.4) ** 2))
        data.qfrc_applied[0] = -stiction - 0.002 * speed * abs(speed)

    target = np.where(times < 1.8, steps, swing)
    return Reality(times, {"servo": target}, act, {"servo": "rad", "angle": "rad", "rate": "rad/s"})


EXAMPLES: Mapping[str, Callable[[], Reality]] = {
    "furuta": furuta,
    "arm": arm,
    "puck": puck,
    "finger": finger,
    "shuffle": shuffle,
    "servo": servo,
}


def recorded(name: str, truth: Mapping[str, float] | None = None, seed: int | None = 0, backwards: bool = False) -> Log:
    """A recording of an example.

    Args:
        name: name of the example.
        truth: true parameters by name; by default those of its .toml file.
        seed: seed of the sensors' noise; None for no noise.
        backwards: whether the controls run backwards and with the opposite sign.
    """
    with (FOLDER / f"{name}.toml").open("rb") as file:
        config = tomllib.load(file)
    reality, noise = EXAMPLES[name](), config["noise"]
    truth = truth or {key: table["truth"] for key, table in config["parameters"].items()}
    spec = mujoco.MjSpec.from_file(str(FOLDER / config["model"]))
    supports = [tuple(table["support"]) for table in config["parameters"].values()]
    nominal = spec.compile()
    does = effects(spec, nominal, list(truth), supports, list(noise))
    numbers = list(truth.values())
    for edit, d in does.edits:
        edit.apply(spec, numbers[d])
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model = spec.compile()
    start = initial_state(nominal, config.get("initial", {}))
    for place, d in does.starts:
        start[place] = numbers[d]
    delay = 0.0 if does.delay is None else numbers[does.delay]
    order = (lambda values: -values[::-1]) if backwards else (lambda values: values)
    asked = {actuator: order(values) for actuator, values in reality.controls.items()}
    controls = Log(reality.times, asked)
    late = np.zeros(len(noise))
    for signal, d in does.lags:
        late[signal] = numbers[d]
    measured = _simulated(model, start, reality, controls, delay, dict(zip(noise, late, strict=True)))
    if seed is not None:
        measured += list(noise.values()) * np.random.default_rng(seed).standard_normal(measured.shape)
    return Log(reality.times, asked | dict(zip(noise, measured.T, strict=True)), name)


def _simulated(model, start, reality: Reality, controls: Log, delay: float, late: dict[str, float]) -> np.ndarray:
    """The readings of the sensors without noise, each with its own delay, shape [T, C]."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    steps = round((reality.times[1] - reality.times[0]) / STEP)
    when = STEP * np.arange(steps * len(reality.times)) - delay
    asked = np.stack([controls.mean_held(own, when, STEP) for own in reality.controls] or [[]] * len(when), axis=-1)
    asked = asked.reshape(len(when), model.nu)
    places = [int(model.sensor(own).adr[0]) for own in late]
    rows = []
    for step, now in enumerate(asked):
        if step % steps == 0:
            mujoco.mj_forward(model, data)
        reality.act(model, data, now)
        mujoco.mj_step(model, data)  # sensors are those of the state before the step
        rows.append(data.sensordata[places].copy())
    fine = STEP * np.arange(len(rows))
    delayed = (np.interp(fine - own, fine, row) for own, row in zip(late.values(), np.array(rows).T, strict=True))
    return np.stack([*delayed], axis=1)[::steps]


def write(name: str) -> None:
    """Write an example's recording as a table, on a clock that does not begin at zero."""
    log, units = recorded(name), EXAMPLES[name]().units
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time [s]", *(f"{signal} [{unit}]" if unit else signal for signal, unit in units.items())])
        columns = [12.5 + log.times, *(log.signals[signal] for signal in units)]
        writer.writerows([f"{number:.6g}" for number in row] for row in zip(*columns, strict=True))


if __name__ == "__main__":
    for one in EXAMPLES:
        write(one)
