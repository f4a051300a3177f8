"""The commands of the whipping task, whose arguments `jaxlfi.envs.whip.cli` parses."""

import argparse
import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from jaxlfi.cli import interrupts, tables
from jaxlfi.envs.whip import control as controlling
from jaxlfi.envs.whip import formats, planner
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip import render as drawing
from jaxlfi.envs.whip.aftermath import sentence
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.parameters import WhipParameters, check, median
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.reference_objects import objects, repetitions
from jaxlfi.envs.whip.reference_objects.simulation import UnstableError
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.commands import perceptions
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.io import files as atomic
from jaxlfi.robots import wire
from jaxlfi.robots.episode import Log
from jaxlfi.robots.robot import RobotError

POLICIES = ("explore", "random", "plan")


def render(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip render`.

    Raises:
        ValueError: for bad input.
    """
    out, name = arguments.out, arguments.detector
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: expected a new or empty folder, got {out}")
    if name not in DETECTORS:
        raise ValueError(f"detector: expected one of {', '.join(DETECTORS)}, got {name!r}")
    parameters = _parameters(arguments)
    interval = Scene().control_interval / drawing.PIECES
    engine, finer = pick(arguments.engine), pick(arguments.engine, Scene(control_interval=interval))
    key_policy, key_detector = jax.random.split(jax.random.key(arguments.seed))
    actions = _actions(arguments.policy, key_policy, engine, parameters)
    perform = jax.jit(drawing.perform, static_argnums=1)
    rollout = jax.device_get(perform(key_detector, Whip(engine, DETECTORS[name]), parameters, actions))
    out.mkdir(parents=True, exist_ok=True)
    _write_rollout(out / "rollout.npz", drawing.arrays(engine, rollout), arguments)
    title = (f"l = {arguments.length:g} mm, E = {arguments.young:g} Pa", _outcome(rollout))
    pictures = drawing.save_pictures(out, finer, rollout, title)
    print(_outcome(rollout))
    print(f"wrote {', '.join(str(path) for path in (*pictures, out / 'rollout.npz'))}")


def _write_rollout(path: Path, arrays: dict[str, np.ndarray], arguments: argparse.Namespace) -> None:
    """Write a rollout as a recording for inference if it is a valid one, and otherwise only its arrays."""
    scene = WhipParameters(**{name: arrays[f"parameters/{name}"] for name in vars(median())})
    words = f"{arguments.length:g} mm, {arguments.young:g} Pa, policy {arguments.policy}, detector {arguments.detector}"
    try:
        recordings.write(path, recordings.simulated(arrays, side_camera(scene), f"Simulated DLO: {words}"), arrays)
    except ValueError as error:
        atomic.write_arrays(path, arrays)
        print(f"rollout.npz cannot be inferred from, as it is not a recording of an object: {error}")


def plan(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip plan`.

    Raises:
        ValueError: for bad input.
    """
    out = arguments.out
    if out.suffix != ".npz" or out.exists():
        raise ValueError(f"out: expected a new .npz file, got {out}")
    parameters = _parameters(arguments)
    engine = pick(arguments.engine)
    found = _search(jax.random.key(arguments.seed), engine, parameters)
    out.parent.mkdir(parents=True, exist_ok=True)
    scene = {f"parameters/{name}": value for name, value in vars(parameters).items()}
    atomic.write_arrays(out, {**vars(found), **scene})
    left = jax.device_get(jax.jit(planner.left, static_argnums=0)(engine, parameters, jnp.asarray(found.actions)))
    print(f"mean return {found.value:.2f} after {found.history.size} tries; {sentence(left)}; wrote {out}")


def convert(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip convert`.

    Raises:
        ValueError: for bad input.
    """
    out = arguments.out
    several = [formats.read(reference) for reference in arguments.recordings]
    out.parent.mkdir(parents=True, exist_ok=True)
    formats.write(out, several)
    frames = ", ".join(str(one.times.size) for one in several)
    print(f"wrote {out}: {frames} frames at {several[0].frame_rate:g} Hz")


def deploy(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip deploy`.

    Raises:
        ValueError: for bad input.
    """
    out, n = arguments.out, arguments.repetitions
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: expected a new or empty folder, got {out}")
    if n < 1:
        raise ValueError(f"repetitions: expected at least 1, got {n}")
    named = [objects.load(name) for name in dict.fromkeys(arguments.object)]
    begins = {word: repetitions.acting(word) for word in arguments.policies}
    seen_by, console = perceptions(arguments.detector, arguments.renderer, arguments.weights), Console(stderr=True)
    with seen_by as perception_of, Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("episodes", total=len(begins) * len(named) * n)
        advance, key = lambda: progress.advance(bar), jax.random.key(arguments.seed)
        rows = repetitions.repeat(key, begins, named, n, advance, perception_of)
    out.mkdir(parents=True, exist_ok=True)
    repetitions.write(out / "episodes.csv", rows)
    lines = repetitions.summary(rows)
    repetitions.write(out / "table.csv", lines)
    table = Table(*lines[0], title=f"{n} places: the first nominal, the others displaced as in training")
    for line in lines:
        table.add_row(*(escape(value) if isinstance(value, str) else f"{value:.2f}" for value in line.values()))
    tables.show(table)
    print(f"wrote {out / 'table.csv'} and {out / 'episodes.csv'}")


def control(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip control`.

    Raises:
        ValueError: for bad input.
        RobotError: for a robot that failed, or had to be stopped.
    """
    out = arguments.out
    if out.suffix != ".npz" or out.exists() or out.with_suffix(".json").exists():
        raise ValueError(f"out: expected a new .npz file beside which there is no .json, got {out}")
    act = repetitions.acting(arguments.policy)()
    loop = controlling.loop_of(act, arguments)
    token = None if arguments.token is None else wire.token_of(arguments.token)
    seen_by = perceptions(arguments.detector, arguments.renderer, arguments.weights)
    with interrupts.orderly(), seen_by as perception_of:  # an interrupt stops a robot that was found
        perception = perception_of(jax.random.fold_in(jax.random.key(arguments.seed), 2**31 - 1))
        robot, about = controlling.robot_of(arguments.robot, arguments.seed, arguments.remote, perception, token)
        loop = dataclasses.replace(loop, clock=getattr(robot, "simulated_clock", loop.clock))
        try:
            log = loop.run(robot, act, on_end=lambda log: _write_log(out, log, about))
        except UnstableError as error:
            raise RobotError(f"robot: {error}") from error
    if log.stopped:
        raise RobotError(f"robot: stopped after {len(log.actions)} of {loop.steps} steps: {log.stopped}")


def _write_log(out: Path, log: Log, about: Mapping[str, Any]) -> None:
    """Write the log of an episode, as a recording if it is a valid one; write nothing if nothing was commanded."""
    if not len(log.actions):
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    others = controlling.arrays(log)
    try:
        recordings.write(out, controlling.recording_of(log, about), others)
    except ValueError as error:
        atomic.write_arrays(out, others)
        print(f"{out} cannot be inferred from, as it is not a recording of an object: {error}")
    print(f"{controlling.summary(log)}, wrote {out}")


def _parameters(arguments: argparse.Namespace) -> WhipParameters:
    """The scene that the arguments describe; all else is as in mu."""
    try:
        return check(median(arguments.length / 1e3, arguments.young))
    except ValueError as error:
        raise ValueError(f"{error} (m, Pa; --length is in mm)") from error


def _actions(policy: str, key: jax.Array, engine: Engine, parameters: WhipParameters) -> Float[Array, "16 2"]:
    """The actions of a policy."""
    if policy == "explore":
        return exploratory_actions()
    if policy == "plan":
        return jnp.asarray(_search(key, engine, parameters).actions)
    if policy == "random":
        return planner.random_walk(key)
    if not Path(policy).exists():
        raise ValueError(f"policy: expected {', '.join(POLICIES)} or an .npz file, got {policy!r}")
    return jnp.asarray(repetitions.actions_of(policy), jnp.float32)


def _search(key: jax.Array, engine: Engine, parameters: WhipParameters) -> planner.Plan:
    """Plan as `planner.plan` does, with a progress bar; the history has only the iterations that were needed."""
    method, console = planner.CrossEntropy(), Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("planning", total=method.iterations)
        search = functools.partial(planner.plan, method=method, on_iteration=lambda: progress.advance(bar))
        found = jax.device_get(jax.jit(search, static_argnums=1)(key, engine, parameters))
    return found.replace(history=found.history[~np.isnan(found.history).all(axis=1)])


def _outcome(rollout: drawing.Rollout) -> str:
    """The outcome of an episode in a few words."""
    last = int(rollout.length) - 1
    hit = ", ".join(name for name, is_hit in zip(COLOURS, rollout.steps.hit[last], strict=True) if is_hit)
    end = ", left the workspace" if rollout.steps.outside[last] else ""
    end += ", unstable" if rollout.steps.failed[last] else ""
    return f"return {rollout.value:.2f} in {last + 1} steps, hit {hit or 'nothing'}{end}"
