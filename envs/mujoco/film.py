"""A film of simulations under posterior draws, laid over the recorded motion: `jaxlfi mujoco film`."""

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

import jaxlfi
from jaxlfi.envs.mujoco import figures, scene
from jaxlfi.envs.mujoco.commands import task_of
from jaxlfi.envs.mujoco.poses import recorded_positions, unmeasured_joints
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.runs.run import Run

INTERVAL = 0.04
"""Time between frames, in s: 25 frames per second."""
LONGEST = 1000
"""Largest number of frames of a film."""
MOMENTS = 6
"""Number of frames on the sheet."""
SMALLEST, LARGEST = 160, 1280
"""Bounds on the sides of a film, in pixels."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """The content of a film.

    Attributes:
        times: of its frames, in s, shape [F].
        models: of the simulations, N of them.
        simulated: positions of the joints, shape [N, F, nq].
        recorded: recorded positions, shape [F, nq]; None if the recording does not measure all of them.
        unmeasured: names of the joints that it does not measure.
        failed: how many simulations failed and are not shown.
        traces: of the measured signals.
    """

    times: Float[np.ndarray, " frames"]
    models: Sequence[mujoco.MjModel]
    simulated: Float[np.ndarray, "n frames qpos"]
    recorded: Float[np.ndarray, "frames qpos"] | None
    unmeasured: Sequence[str]
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
        ValueError: for runs of other tasks, an episode that does not exist, films that are too short or too long, and
            draws that all fail.
    """
    task = task_of(run)
    simulator = simulator_of(task)
    if run.observed.shape != simulator.observation.shape:
        expected, got = list(simulator.observation.shape), list(run.observed.shape)
        raise ValueError(f"run: expected a run on the task's own recording, of shape {expected}, got {got}")
    if not 0 <= episode < len(simulator.times):
        raise ValueError(f"episode: expected one of 0 to {len(simulator.times) - 1}, got {episode}")
    times = simulator.times[episode]
    low, high = (INTERVAL * count / times[-1] for count in (1, LONGEST - 1))
    if not low <= slower <= high:
        raise ValueError(
            f"slower: expected {low:.2g} to {high:.2g}, as the recording takes {times[-1]:g} s and a film has 2 to "
            f"{LONGEST} frames; got {slower:g}"
        )
    when = INTERVAL / slower * np.arange(int(times[-1] * slower / INTERVAL + 1e-6) + 1)
    theta = np.asarray(run.draws(draws), float)
    clean, outcome = simulator.clean(theta)
    good = outcome == 0
    if not good.any():
        raise ValueError(f"draws: expected at least one whose simulation succeeds, got {draws} that fail")
    _, grid, states = simulator.states(theta[good], episode)
    models = [simulator.look(row) for row in theta[good]]
    steps = np.abs(grid - when[:, None]).argmin(axis=1)
    first = sum(len(own) for own in simulator.times[:episode])
    rows = slice(first, first + len(times))
    recorded = np.where(simulator.there, np.asarray(run.observed, float), np.nan)[rows]
    unmeasured = unmeasured_joints(models[0], simulator.signals)
    return Motion(
        times=when,
        models=models,
        simulated=states[:, steps, 1 : 1 + models[0].nq],
        recorded=None if unmeasured else recorded_positions(models[0], simulator.signals, times, recorded, when),
        unmeasured=unmeasured,
        failed=int((~good).sum()),
        traces=figures.Traces(
            names=task.channels,
            times=times,
            recorded=recorded,
            simulated=clean[good][:, rows],
            colour=scene.GHOST,
            title=task.name,
            label=f"{good.sum()} draws of the posterior",
            posed=not unmeasured,
        ),
    )


def save(
    path: Path,
    shown: Motion,
    slower: float = 1.0,
    size: tuple[int, int] = (640, 640),
    camera: str | None = None,
    watch: Callable[[Iterable, int], Iterable] = lambda frames, count: frames,
) -> Path:
    """Write a film, and next to it a sheet of some of its frames, whose path is returned.

    Args:
        path: of the .gif file.
        shown: what it shows.
        slower: how many times slower than the recording the film is.
        size: width and height, in pixels.
        camera: of the model, by name; by default a view that shows all of the motion.
        watch: iterates over the frames, given their number, as a progress bar does.

    Raises:
        ValueError: for a camera that the model does not have.
        RuntimeError: if neither EGL nor OSMesa is available.
    """
    width, height = size
    strip = figures.Strip(shown.traces, width, round(min(0.4 * height, 36 + 70 * shown.traces.drawn)))
    captions = figures.Captions(shown.traces, max(round(min(size) / 40), 9))
    speed = "" if slower == 1 else f", {slower:g} times slower" if slower > 1 else f", {1 / slower:g} times faster"
    chosen = np.unique(np.linspace(0, len(shown.times) - 1, MOMENTS).round().astype(int))
    poses = shown.models, shown.simulated, shown.recorded
    with scene.Stage(*poses, width, height - strip.height, camera) as stage:
        moments = [stage.picture(f) for f in chosen]

        def frame(f: int, picture: np.ndarray) -> np.ndarray:
            time = shown.times[f]
            return np.concatenate([captions.on(picture, f"{time:.2f} s{speed}"), strip.at(time)])

        like = [frame(f, picture) for f, picture in zip(chosen, moments, strict=True)]
        count = len(shown.times)
        figures.save_film(path, (frame(f, stage.picture(f)) for f in watch(range(count), count)), like, INTERVAL)
    sheet = path.with_suffix(".png")
    figures.save_sheet(sheet, moments, shown.times[chosen], shown.traces)
    return sheet


def film(arguments: argparse.Namespace) -> None:
    """Run `jaxlfi mujoco film`.

    Raises:
        ValueError: for bad input, and without a renderer.
    """
    out, slower, size = arguments.out, arguments.slower, arguments.size
    if out.suffix != ".gif":
        raise ValueError(f"--out: expected a new .gif file, got {out}")
    if taken := [str(path) for path in (out, out.with_suffix(".png")) if path.exists()]:
        raise ValueError(f"--out: expected a new .gif file and no .png beside it, but there is {' and '.join(taken)}")
    if not all(SMALLEST <= side <= LARGEST for side in size):
        raise ValueError(f"--size: expected sides of {SMALLEST} to {LARGEST} pixels, got {size[0]}x{size[1]}")
    shown = motion(jaxlfi.load(arguments.run), arguments.draws, slower, arguments.episode)
    console = Console(stderr=True)

    def watch(frames: Iterable, count: int) -> Iterable:
        return track(frames, "frames", count, console=console, transient=True, disable=not console.is_terminal)

    try:
        sheet = save(out, shown, slower, size, arguments.camera, watch)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    if shown.unmeasured:
        print(f"the recorded pose is not drawn: the recording does not measure {', '.join(shown.unmeasured)}")
    if shown.failed:
        print(f"{shown.failed} of {arguments.draws} simulations failed and are not drawn")
    print(f"film of {len(shown.times)} frames: {out}\n{min(MOMENTS, len(shown.times))} of them: {sheet}")
