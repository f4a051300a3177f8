"""A film of simulations under posterior draws, laid over the recorded motion: `jaxlfi mujoco film`."""

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import track

import jaxlfi
from jaxlfi.envs.mujoco import figures, scene
from jaxlfi.envs.mujoco.poses import recorded_positions, unmeasured_joints
from jaxlfi.envs.mujoco.simulator import Simulator
from jaxlfi.runs.run import Run

INTERVAL = 0.04
"""Between frames, in s: 25 a second."""
LONGEST = 1500
"""Frames of a film, at most."""
MOMENTS = 6
"""Of the sheet."""
SMALLEST, LARGEST = 160, 2048
"""Sides of a film, in pixels."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """What a film shows.

    Attributes:
        times: of its frames, in s, shape [F].
        models: of the simulations, N of them.
        simulated: positions of the joints, shape [N, F, nq].
        recorded: the same as recorded, shape [F, nq]; None where the recording does not measure all of them.
        unmeasured: names of the joints that it does not measure.
        failed: how many simulations failed and are not shown.
        traces: of the measured signals.
    """

    times: Float[np.ndarray, " frames"]
    models: tuple[mujoco.MjModel, ...]
    simulated: Float[np.ndarray, "n frames qpos"]
    recorded: Float[np.ndarray, "frames qpos"] | None
    unmeasured: tuple[str, ...]
    failed: int
    traces: figures.Traces


def motion(run: Run, draws: int = 12, slower: float = 1.0, episode: int = 0) -> Motion:
    """Simulate posterior draws under the recorded controls.

    Args:
        run: of a task of a MuJoCo model.
        draws: of the posterior.
        slower: how many times slower than the recording the film is.
        episode: its number, from 0.

    Raises:
        ValueError: for runs of other tasks, an episode that is not there, films that are too long, and draws that all
            fail.
    """
    simulator = _simulator(run)
    if not 0 <= episode < len(simulator.times):
        raise ValueError(f"episode: expected one of 0 to {len(simulator.times) - 1}, got {episode}")
    if draws < 1 or not 0 < slower < np.inf:
        raise ValueError(f"expected at least one draw and a film slower by more than 0, got {draws} and {slower:g}")
    times = simulator.times[episode]
    length = times[-1] * slower / INTERVAL
    if not 1 - 1e-6 <= length < LONGEST:
        raise ValueError(
            f"slower: expected a film of 2 to {LONGEST} frames, {INTERVAL:g} s each, got {length + 1:.0f}: "
            f"the recording takes {times[-1]:g} s"
        )
    when = INTERVAL / slower * np.arange(int(length + 1e-6) + 1)
    begin = sum(len(own) for own in simulator.times[:episode])
    rows = slice(begin, begin + len(times))
    theta = np.asarray(run.draws(draws), float)
    clean, outcome = simulator.clean(theta)
    good = outcome == 0
    if not good.any():
        raise ValueError(f"draws: expected some whose simulations do not fail, got {draws} that do")
    models, grid, states = simulator.states(theta[good], episode)
    steps = np.clip(np.searchsorted(grid, when - (grid[1] - grid[0]) / 2), 0, len(grid) - 1)
    recorded = np.where(simulator.there, np.asarray(run.observed, float), np.nan)[rows]
    traces = figures.Traces(
        names=run.task.channels,
        times=times,
        recorded=recorded,
        simulated=clean[good][:, rows],
        colour=scene.GHOST,
        title=run.task.name,
        label=f"{good.sum()} draws of the posterior",
        solid=not unmeasured_joints(models[0], run.task.channels),
    )
    return Motion(
        times=when,
        models=tuple(models),
        simulated=states[:, steps, 1 : 1 + models[0].nq],
        recorded=recorded_positions(models[0], run.task.channels, times, recorded, when),
        unmeasured=tuple(unmeasured_joints(models[0], run.task.channels)),
        failed=int((~good).sum()),
        traces=traces,
    )


def pictures(
    shown: Motion, width: int, height: int, camera: str | None = None, captions: Callable | None = None
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Pictures of all frames of a motion.

    Raises:
        ValueError: for a camera that the model does not have.
        RuntimeError: where neither EGL nor OSMesa can be had.
    """
    motions = list(zip(shown.models, shown.simulated, strict=True))
    if shown.recorded is not None:
        motions.insert(0, (shown.models[0], shown.recorded))
    with scene.Stage(motions, width, height, camera) as stage:
        for f in range(len(shown.times)):
            ghosts = [(model, own[f]) for model, own in zip(shown.models, shown.simulated, strict=True)]
            yield stage.picture(None if shown.recorded is None else shown.recorded[f], ghosts)


def save(
    path: Path,
    shown: Motion,
    slower: float,
    width: int,
    height: int,
    camera: str | None,
    watch: Callable[[Iterable, int], Iterable],
) -> tuple[Path, Path]:
    """Write a film, and beside it a sheet of some of its moments."""
    strip = figures.Strip(shown.traces, width, round(min(0.4 * height, 36 + 70 * shown.traces.shown)))
    captions = figures.Captions(shown.traces, max(round(min(width, height) / 40), 9))
    seen = list(watch(pictures(shown, width, height - strip.height, camera), len(shown.times)))
    speed = "" if slower == 1 else f", {slower:g} times slower" if slower > 1 else f", {1 / slower:g} times faster"
    frames = (
        np.concatenate([captions.on(picture, f"{time:.2f} s{speed}"), strip.at(time)])
        for picture, time in zip(seen, shown.times, strict=True)
    )
    figures.save_film(path, frames, INTERVAL)
    chosen = np.unique(np.linspace(0, len(seen) - 1, MOMENTS).round().astype(int))
    sheet = path.with_suffix(".png")
    figures.save_sheet(sheet, [seen[f] for f in chosen], shown.times[chosen], shown.traces)
    return path, sheet


def film(arguments: argparse.Namespace) -> None:
    """`jaxlfi mujoco film`.

    Raises:
        ValueError: for bad input, and where there is no renderer.
    """
    out, slower = arguments.out, arguments.slower
    if out.suffix != ".gif":
        raise ValueError(f"out: expected a new .gif file, got {out}")
    if taken := [str(path) for path in (out, out.with_suffix(".png")) if path.exists()]:
        raise ValueError(f"out: expected a new .gif file, and none beside it, got {', '.join(taken)}")
    width, height = arguments.size
    if not (SMALLEST <= width <= LARGEST and SMALLEST <= height <= LARGEST):
        raise ValueError(f"size: expected sides of {SMALLEST} to {LARGEST} pixels, got {width}x{height}")
    shown = motion(jaxlfi.load(arguments.run), arguments.draws, slower, arguments.episode)
    console = Console(stderr=True)

    def watch(frames: Iterable, count: int) -> Iterable:
        return track(frames, "frames", count, console=console, transient=True, disable=not console.is_terminal)

    try:
        written = save(out, shown, slower, width, height, arguments.camera, watch)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    if shown.unmeasured:
        print(f"the recorded pose is not drawn: the recording does not measure {', '.join(shown.unmeasured)}")
    if shown.failed:
        print(f"{shown.failed} of {arguments.draws} simulations failed and are not drawn")
    print(f"wrote {', '.join(map(str, written))}: {len(shown.times)} frames")


def _simulator(run: Run) -> Simulator:
    if run.task is None:
        raise ValueError("run: expected one whose task can be found, got one of a task made in Python, or that is lost")
    simulator = getattr(run.task.simulate, "function", None)
    if not isinstance(simulator, Simulator):
        raise ValueError(f"run: expected one of a MuJoCo model's task, got one of {run.task.name}")
    if run.observed.shape != simulator.observation.shape:
        raise ValueError(
            f"run: expected one of the task's own recording, of shape {list(simulator.observation.shape)}, "
            f"got {list(run.observed.shape)}"
        )
    return simulator
