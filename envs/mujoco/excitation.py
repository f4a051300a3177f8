"""A loop's recordings without a policy, the signals that recordings need, and a policy's performance in a recording.

A machine is excited by sines, three for each actuator, within the limits of its policies. Their frequencies range from
one cycle per episode of a policy to a quarter of its control rate.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco import goal as goals
from jaxlfi.envs.mujoco import logs, machine, starts
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.envs.mujoco.measured import add_sensors, unit
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.envs.mujoco.reading import Reading, add_signals
from jaxlfi.rl.preparation import Preparation, Signal
from jaxlfi.robots import driving, recording
from jaxlfi.robots.driver import Driver
from jaxlfi.robots.driving import Drive
from jaxlfi.robots.recording import Recording
from jaxlfi.robots.settings import Settings, of_table

SINES, PART = 3, 0.8
"""Number of sines for each actuator, and the fraction of its limits that they use."""


def record(driver: Driver, config: Path, path: Path, duration: float | None = None, seed: int = 0) -> None:
    """Excite a machine by sines, and record it.

    Args:
        driver: of the machine.
        config: of its task.
        path: a new recording.
        duration: in s; by default that of an episode.
        seed: of frequencies and phases.

    Raises:
        RobotError: for a robot that failed, or had to be stopped.
    """
    table = tables.load(config)
    goal = goals.of_table(table["policy"])
    duration = goal.duration if duration is None else duration
    step = compile_spec(specification(config.parent / table["model"])).opt.timestep
    interval = step * max(round(0.2 * goal.interval / step), 1)
    steps = max(round(duration / interval), 2)
    wave = lambda names, bounds: sines(np.random.default_rng(seed), bounds, interval, steps, goal.duration)
    _recorded(driver, config, path, interval, steps, wave, "excitation")


def play(driver: Driver, config: Path, path: Path, controls: Path) -> None:
    """Let a machine play planned controls, as `jaxlfi design` writes them, and record it.

    Controls beyond the limits of policies are clipped; the recording has the controls that were sent.

    Args:
        driver: of the machine.
        config: of its task.
        path: a new recording.
        controls: file of the controls, with a sample of each actuator at each time.

    Raises:
        RobotError: for a robot that failed, or had to be stopped.
        ValueError: for controls of actuators that policies do not have.
    """
    log = logs.read(controls)
    interval = float(np.median(np.diff(log.times)))

    def planned(names: Sequence[str], bounds: np.ndarray) -> np.ndarray:
        if missing := [name for name in names if name not in log.signals]:
            raise ValueError(f"{controls}: expected controls of {', '.join(names)}, got none of {', '.join(missing)}")
        if others := [name for name in log.signals if name not in names and np.ptp(log.samples(name)[1])]:
            raise ValueError(f"{controls}: expected controls that policies have, {', '.join(names)}, got {others[0]}")
        samples = np.column_stack([log.held(name, log.times) for name in names])
        allowed = np.clip(samples, *bounds)
        for name, far, ends in zip(names, np.abs(samples - allowed).max(axis=0), bounds.T.tolist(), strict=True):
            if far > 1e-6 * (ends[1] - ends[0]):
                print(f"{name} is cut off at the limits of policies, {ends}: by up to {far:.3g}")
        return allowed

    _recorded(driver, config, path, interval, len(log.times), planned, "design")


def _recorded(
    driver: Driver,
    config: Path,
    path: Path,
    interval: float,
    steps: int,
    played: Callable[[Sequence[str], Float[np.ndarray, "2 act"]], Float[np.ndarray, "steps act"]],
    mode: str,
) -> None:
    """Let a machine play the controls that `played` makes from their names and bounds, and record it."""
    table, (goal, reading) = tables.load(config), _goal(config)
    names = measured_of(table, goal)
    spec = specification(config.parent / table["model"])
    add_sensors(spec, names)
    model = compile_spec(spec)
    controls = reading.preparation.controls
    signals = tuple(Signal(name, unit(model, name).removeprefix("1")) for name in names)
    plain = tuple(dataclasses.replace(one, displacing=False, begins=None) for one in controls)
    preparation = Preparation(signals, plain, interval, steps, terminations=reading.preparation.terminations)
    settings = of_table(machine.carried(table.get("robot", {}), config.parent / table["model"], preparation))
    limits = driving.limits_within(preparation, settings)
    samples = iter(played([one.name for one in controls], np.array([limits.low, limits.high])))
    loop = Drive(
        preparation,
        limits,
        (*names, *(name for name in settings.further if name not in names)),
        settings.limits,
        units=settings.units,
        rate=1 / interval,
        steps=preparation.steps,
        watchdog=settings.watchdog or driving.WATCHDOG,
    )
    robot, loop, about = driving.connected(loop, driver, settings)

    def ended(log: Any) -> None:
        sent = np.isfinite(log.lateness)
        given = np.flatnonzero(sent) * log.period + log.lateness[sent]
        columns = {one.name: log.targets[sent, place] for place, one in enumerate(controls)}
        known = {name: loop.asked[name] for name in names} | {one.name: one.unit for one in controls}
        kept = Recording(log.times, dict(zip(names, log.observations.T, strict=False)), given, columns, known)
        report = {"mode": mode, "stopped": log.stopped, "failed": log.failed, "controls": len(log.targets)}
        report |= {"timing": recording.timing(log), "robot": about}
        for left in (path, path.with_suffix(".loop.npz")):
            left.unlink(missing_ok=True)  # an incomplete recording's files
        recording.write(path, kept, log, report, loop.signals)
        print(f"{recording.timing_line(log)}; wrote {path}")

    log = loop.run(robot, lambda seen: next(samples), on_end=ended)
    if log.stopped:
        print(f"the robot was stopped after {len(log.targets)} of {loop.steps} controls: {log.stopped}")


def sines(
    rng: np.random.Generator, bounds: Float[np.ndarray, "2 act"], interval: float, steps: int, episode: float
) -> Float[np.ndarray, "steps act"]:
    """Controls that excite: sums of sines about the middle of the bounds, which begin there and stay within them.

    Args:
        rng: of frequencies and phases.
        bounds: least and largest controls.
        interval: between two controls, in s.
        steps: number of controls.
        episode: duration in s, whose inverse is the lowest frequency.
    """
    middle, half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
    frequencies = np.exp(rng.uniform(np.log(1 / episode), np.log(0.05 / interval), (SINES, bounds.shape[1])))
    phases = rng.uniform(0, 2 * np.pi, frequencies.shape)
    times = interval * np.arange(steps)
    angles = 2 * np.pi * times[:, None, None] * frequencies
    waves = (np.sin(angles + phases) - np.sin(phases) * np.exp(-times / interval / 10)[:, None, None]).mean(axis=1)
    return middle + PART * half * np.clip(waves, -1.0, 1.0)


def measured_of(table: Mapping[str, Any], goal: Goal) -> list[str]:
    """Signals that inference needs: those that the task measures, whose noise it states, or that policies see."""
    return list(table.get("measured") or table.get("noise") or goal.observed)


def says_its_start(config: Path) -> bool:
    """Whether inference takes the start of an episode from its recording (`jaxlfi.envs.mujoco.starts`)."""
    table = tables.load(config)
    begins, numbers = tables.initial(table)
    inferred = any(one.name.startswith(("initial/", "episode/")) for one in tables.parameters_of(table))
    if begins not in (None, "log") or numbers or inferred:
        return False
    names = measured_of(table, goals.of_table(table["policy"]))
    spec = specification(config.parent / table["model"])
    add_sensors(spec, names)
    return not starts.unmeasured(compile_spec(spec), names, [])


def measuring(settings: Settings, config: Path) -> Settings:
    """Settings with which a policy's recordings have all signals that inference and the goal need."""
    table, (goal, _) = tables.load(config), _goal(config)
    names = dict.fromkeys((*settings.record, *measured_of(table, goal), *goal.signals))
    return dataclasses.replace(settings, record=tuple(names))


def achieved(config: Path, path: Path) -> dict[str, Any]:
    """A policy's performance in a recorded episode: the return as in training, and the final distances from targets.

    The reward of a control interval is that of the latest measurement, if there is none at its end.

    Args:
        config: of the task.
        path: of the recording; the files next to it hold the episode's report (`jaxlfi.robots.recording`).

    Returns:
        Also the termination that ended it, and why the robot was stopped early, "" if it was not; the return of a
        stopped episode lacks the rest.
    """
    goal, reading = _goal(config)
    report_path, log_path = recording.beside(path)
    log, report = np.load(log_path), json.loads(report_path.read_text())
    names = [str(name) for name in log["signals"]]
    ends = report["timing"]["period"] * (np.arange(len(log["targets"])) + 1.5)
    last = np.maximum(np.searchsorted(log["times"], ends) - 1, 0)
    rows = log["observations"][np.append(0, last)][:, [names.index(name) for name in goal.signals]]
    commands = np.array([0.5 * (one.low + one.high) for one in reading.preparation.commands])
    controls = np.concatenate([log["targets"][:1], log["targets"]])
    total = 0.0
    for after, before, control in zip(rows[1:], controls[:-1], controls[1:], strict=True):
        total += float(reading.reward(after, control, before, commands, np))
    off = {f"{name} off": abs(float(value)) for name, value in reading.off(rows[-1], commands, np).items()}
    ended = str(report.get("ended", "")).partition(" (")[0]
    return {"return": total, "controls": len(log["targets"]), "ended": ended, "stopped": report["stopped"]} | off


def _goal(config: Path) -> tuple[Goal, Reading]:
    table = tables.load(config)
    goal = goals.of_table(table["policy"])
    spec = specification(config.parent / table["model"])
    add_signals(spec, goal)
    return goal, Reading(compile_spec(spec), goal)
