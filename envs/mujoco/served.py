"""A stand-in for a real machine: a model simulated differently from inference and training, served as a driver.

    jaxlfi mujoco serve examples/mujoco/furuta.toml --port 5005

It has another integrator (Runge-Kutta, a tenth of the step), the true parameters of the task's file, the sensor noise
of its table `noise`, and effects that no parameter describes:

- friction in the joints that falls with speed, a hundredth of what the actuators can do there,
- drag that grows with the square of the speed, a tenth of the damping at a speed of 1,
- actuators that do 2 % less than they are commanded.

It runs in the time of the loop that controls it, as fast as the loop does, or by the system's clock.
"""

import argparse
import contextlib
import dataclasses
import itertools
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco import goal as goals
from jaxlfi.envs.mujoco import starts
from jaxlfi.envs.mujoco.effects import STATE, built, effects, state_place
from jaxlfi.envs.mujoco.measured import add_sensors, places
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.envs.mujoco.quiet import quietly
from jaxlfi.envs.mujoco.reading import Reading, add_signals
from jaxlfi.rl.deployment import ControlLimits
from jaxlfi.robots import driving, server, wire
from jaxlfi.robots.clock import Clock, Monotonic, Simulated
from jaxlfi.robots.robot import Observation

FINER = 10
"""Number of simulation steps in a step of the model."""
STICTION, SLOW, DRAG, LOSS = 0.01, 0.3, 0.1, 0.02
"""Sizes of the unmodelled effects; the speed above which friction falls is in rad/s or m/s."""


@dataclasses.dataclass(frozen=True)
class Machine:
    """A machine to be simulated.

    Attributes:
        config: of its task.
        truth: its parameters by name.
        unmodelled: size of the effects that no parameter describes; 1 is as above.
        seed: of the sensors' noise, and of initial states.
        scattered: whether episodes begin as in training, and not in the task's initial state.

    Raises:
        ValueError: for a task without truths, and inconsistent arguments, in one line.
    """

    config: Path
    truth: Mapping[str, float]
    unmodelled: float = 1.0
    seed: int = 0
    scattered: bool = False

    @staticmethod
    def of(config: Path, truth: Mapping[str, float] | None = None, **others: Any) -> "Machine":
        """The machine of a task, with the true parameters of its file except for those given."""
        own = {one.name: one.truth for one in tables.parameters_of(tables.load(config))} | dict(truth or {})
        if missing := [name for name, value in own.items() if value is None]:
            raise ValueError(f"truth: expected one of each parameter, as --truth NAME=VALUE, got none of {missing[0]}")
        return Machine(config, {name: float(value) for name, value in own.items() if value is not None}, **others)

    def __post_init__(self):
        names = [one.name for one in tables.parameters_of(self.table)]
        if unknown := [name for name in self.truth if name not in names]:
            known = ", ".join(names)
            raise ValueError(f"truth: expected parameters of {self.config}: {known}; got {', '.join(unknown)}")
        if not 0 <= self.unmodelled < math.inf:
            raise ValueError(f"unmodelled: expected a number of at least 0, got {self.unmodelled:g}")
        if self.scattered and "policy" not in self.table:
            raise ValueError(f"{self.config}: expected a table [policy] that says where episodes begin, got none")
        self.limits()

    @property
    def table(self) -> dict[str, Any]:
        """The tables of its file."""
        return tables.load(self.config)

    def limits(self) -> ControlLimits:
        """Limits of the controls: those of the task's policies, or else of the model's actuators."""
        if "policy" in self.table:
            goal = goals.of_table(self.table["policy"])
            spec = specification(self.config.parent / self.table["model"])
            add_signals(spec, goal)
            return driving.limits_of(Reading(compile_spec(spec), goal).preparation)
        model = compile_spec(specification(self.config.parent / self.table["model"]))
        names = [model.actuator(i).name or f"actuator/{i}" for i in range(model.nu)]
        free = [not limited for limited in model.actuator_ctrllimited]
        ranges = zip((-math.inf, math.inf), model.actuator_ctrlrange.T, strict=True)
        low, high = (np.where(free, far, column) for far, column in ranges)
        return ControlLimits(tuple(names), tuple(low), tuple(high), (math.inf,) * model.nu)

    def driver(self, clock: Clock, episode: int = 0) -> "MachineDriver":
        """A driver of the machine, by a clock, for one of its episodes."""
        return MachineDriver(self, clock, episode)


class MachineDriver:
    """A machine as a driver (`jaxlfi.robots.driver`)."""

    def __init__(self, machine: Machine, clock: Clock, episode: int = 0):
        """Nothing is simulated before `connect`. Noise and start depend on the episode's number."""
        self._machine, self._clock, self._number = machine, clock, -1
        self._rng = np.random.default_rng([machine.seed, episode])

    def connect(self, signals: Mapping[str, str], controls: Mapping[str, str]) -> Mapping[str, Any]:
        """Compile the model with a sensor for each signal, in the task's initial state, or scattered as episodes begin.

        Raises:
            ValueError: for signals and actuators that the model does not have.
        """
        machine, table, names = self._machine, self._machine.table, list(signals)
        spec = specification(machine.config.parent / table["model"])
        add_sensors(spec, names)
        nominal = compile_spec(spec)
        actuators = [nominal.actuator(i).name or f"actuator/{i}" for i in range(nominal.nu)]
        if unknown := [name for name in controls if name not in actuators]:
            raise ValueError(f"robot: expected controls among {', '.join(actuators)}, got {', '.join(unknown)}")
        self._places, self._names = places(nominal, names), names
        parameters = tables.parameters_of(table)
        theta = np.array([machine.truth[one.name] for one in parameters])
        sensed = list(dict.fromkeys([*names, *_of_sensors(machine.truth)]))
        supports, ties = ([getattr(one, what) for one in parameters] for what in ("support", "tie"))
        does = effects(spec, nominal, [one.name for one in parameters], supports, sensed, ties)
        spec.option.timestep, spec.option.integrator = nominal.opt.timestep / FINER, mujoco.mjtIntegrator.mjINT_RK4
        self._model = built(spec, does, theta)
        self._data = mujoco.MjData(self._model)
        start = starts.first(nominal, *tables.initial(table))
        if machine.scattered:
            for name, (low, high) in goals.of_table(table["policy"]).initial.items():
                start[state_place(nominal, name, f"initial/{name}")] = self._rng.uniform(low, high)
        mujoco.mj_setState(self._model, self._data, does.started(start, theta, 0), STATE)
        self._gain, self._bias, self._noise = np.ones(len(sensed)), np.zeros(len(sensed)), np.zeros(len(sensed))
        for place, name in enumerate(sensed):
            self._noise[place] = table.get("noise", {}).get(name, 0.0)
        for signal, d in does.gains:
            self._gain[signal] = theta[d]
        for signal, d in does.biases:
            self._bias[signal] = theta[d]
        for signal, d in does.deviations:
            self._noise[signal] = theta[d]
        self._late = np.zeros(len(names))
        for signal, d in does.lags:
            if signal < len(names):
                self._late[signal] = theta[d]
        steps = int(np.ceil(self._late.max(initial=0.0) / self._model.opt.timestep)) + 1
        self._passed: deque[tuple[float, np.ndarray]] = deque(maxlen=steps)
        self._delay = 0.0 if does.delay is None else float(theta[does.delay])
        self._jitter = 0.0 if does.jitter is None else float(theta[does.jitter])
        self._order = [actuators.index(name) for name in controls]
        self._given: list[tuple[float, np.ndarray]] = [(-math.inf, self._rest())]
        self._reach = self._forces()
        self._began: float | None = None
        simulated = isinstance(self._clock, Simulated)
        return {"description": "a simulated machine", "simulated": simulated, "truth": dict(machine.truth)}

    def observe(self) -> Observation:
        """What the sensors read now."""
        self._advance()
        with quietly():
            mujoco.mj_forward(self._model, self._data)
        size = len(self._names)
        values = self._gain[:size] * self._sensed() + self._bias[:size]
        values = values + self._noise[:size] * self._rng.standard_normal(size)
        self._number += 1
        return Observation(dict(zip(self._names, values.tolist(), strict=True)), self._number)

    def act(self, controls: Mapping[str, float]) -> None:
        """Let the controls act from now on, or later by the machine's delay and jitter, but after earlier ones."""
        self._advance()
        control = self._given[-1][1].copy()
        control[self._order] = list(controls.values())
        late = self._delay + (self._jitter * self._rng.standard_normal() if self._jitter else 0.0)
        self._given.append((self._now() + late, control))

    def stop(self) -> None:
        """Do nothing: the simulation advances only on request."""

    def _sensed(self) -> np.ndarray:
        """The current reading of each sensor: what it measured one delay ago, or at first."""
        times, rows = zip(*self._passed, (self._data.time, self._data.sensordata[self._places]), strict=True)
        several = zip(self._late, np.array(rows).T, strict=True)
        return np.array([np.interp(self._data.time - late, times, column) for late, column in several])

    def _now(self) -> float:
        """Seconds since the first request."""
        self._began = self._clock.now() if self._began is None else self._began
        return self._clock.now() - self._began

    def _rest(self) -> np.ndarray:
        """Controls before any are given."""
        low, high = self._model.actuator_ctrlrange.T
        return np.where(self._model.actuator_ctrllimited, np.clip(0.0, low, high), 0.0)

    def _forces(self) -> np.ndarray:
        """The actuators' largest force on each degree of freedom: at their limits, for servos at a tenth of these."""
        data, limits = mujoco.MjData(self._model), self._machine.limits()
        largest = np.zeros(self._model.nv)
        for i in range(self._model.nu):
            servo = self._model.actuator_biastype[i] != mujoco.mjtBias.mjBIAS_NONE
            for control in np.nan_to_num([limits.low[i], limits.high[i]], posinf=1.0, neginf=-1.0):
                data.ctrl[:] = self._rest()
                mujoco.mj_forward(self._model, data)
                before = data.qfrc_actuator.copy()
                data.ctrl[i] = (0.1 if servo else 1.0) * control
                mujoco.mj_forward(self._model, data)
                largest = np.maximum(largest, np.abs(data.qfrc_actuator - before))
        return largest

    def _advance(self) -> None:
        """Simulate up to now."""
        size, model, data = self._machine.unmodelled, self._model, self._data
        steps = round((self._now() - data.time) / model.opt.timestep)
        with quietly():
            for _ in range(steps):
                while len(self._given) > 1 and self._given[1][0] <= data.time + 1e-9:
                    self._given.pop(0)
                speed = data.qvel
                friction = STICTION * self._reach * np.tanh(speed / (0.03 * SLOW)) * np.exp(-((speed / SLOW) ** 2))
                data.qfrc_applied[:] = -size * (friction + DRAG * model.dof_damping * speed * np.abs(speed))
                data.ctrl[:] = (1 - LOSS * size) * self._given[0][1]
                before = data.time
                mujoco.mj_step(model, data)
                self._passed.append((before, data.sensordata[self._places].copy()))


def _of_sensors(names: Sequence[str] | Mapping[str, float]) -> list[str]:
    """Signals whose sensors have parameters."""
    return [name.removeprefix("sensor/").rpartition("/")[0] for name in names if name.startswith("sensor/")]


def serve(arguments: argparse.Namespace) -> None:
    """Run `jaxlfi mujoco serve` until the process is ended.

    Raises:
        ValueError: for bad input.
    """
    truth = dict(arguments.truth)
    machine = Machine.of(
        arguments.config, truth, unmodelled=arguments.unmodelled, seed=arguments.seed, scattered=arguments.scattered
    )
    MachineDriver(machine, Simulated()).connect({}, dict.fromkeys(machine.limits().names, ""))
    if arguments.first_episode < 0:
        raise ValueError(f"first_episode: expected a number of at least 0, got {arguments.first_episode}")
    if not 0 <= arguments.port < 65536:
        raise ValueError(f"port: expected a number from 0 to 65535, got {arguments.port}")
    token = None if arguments.token is None else wire.token_of(arguments.token)
    journal = server.write_to(arguments.journal) if arguments.journal else lambda event: None
    with contextlib.closing(server.listen(arguments.port, arguments.host)) as listener:
        server.require_token(listener, token)
        if arguments.until_closed:
            threading.Thread(target=_end_with_input, daemon=True).start()
        print(f"listening on socket://{arguments.host}:{listener.getsockname()[1]}", flush=True)
        clock = Monotonic if arguments.real_time else Simulated
        watchdog = server.WATCHDOG if arguments.real_time else PATIENCE
        episodes = itertools.count(arguments.first_episode)
        made = lambda clock: machine.driver(clock, next(episodes))
        server.serve_driver(listener, made, machine.limits(), watchdog, journal, clock, token)


def _end_with_input() -> None:
    """End the process when its standard input ends: its parent has then ended, killed or not."""
    while sys.stdin.buffer.read(4096):
        pass
    os._exit(0)


PATIENCE = 60.0
"""Seconds that a loop may take between two requests, if the machine runs in its time."""
