"""Three simulations of a task at the truth, to show how much they differ.

    python -m experiments.trajectories --task lotka_volterra --out experiments/results/trajectories

Needs a task in JAX whose truth is known.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import style
from jaxlfi.io import files as atomic
from jaxlfi.registry import TASKS
from jaxlfi.tasks.task import Task

SEEDS = 3
COLOURS = ("#025358", "#F5A025", "#995FDD", "#E41A1C")


def simulations(task: Task) -> np.ndarray:
    """Simulations at the truth, shape [seeds, T, C]."""
    simulate = lambda key: task.simulate(key, jnp.asarray(task.truth))
    made = jax.vmap(simulate)(jax.random.split(jax.random.key(0), SEEDS))
    trajectories = np.asarray(made[0] if isinstance(made, tuple) else made)
    return trajectories.reshape(*trajectories.shape[:2], -1)


def draw(figure: Figure, task: Task, trajectories: np.ndarray) -> None:
    """A panel for each simulation, a line for each channel.

    Args:
        figure: an empty figure.
        task: the task, for names and times.
        trajectories: the simulations, shape [seeds, T, C].
    """
    records = trajectories.shape[1]
    times = np.arange(records) if task.times is None else task.times
    panels = figure.subplots(1, len(trajectories), sharex=True, sharey=True)
    for axes, trajectory in zip(panels, trajectories, strict=True):
        for channel, colour, name in zip(trajectory.T, COLOURS, task.channels, strict=False):
            axes.plot(times, channel, color=colour, linewidth=0.9, label=name)
        axes.set_xlabel("record" if task.times is None else "time")
        axes.grid(True)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(COLOURS))


def main(arguments: list[str] | None = None) -> None:
    """Write TASK.npz and TASK.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="lotka_volterra", help="a task whose truth is known")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/trajectories"))
    given = parser.parse_args(arguments)
    task = TASKS.load(given.task)
    if task.truth is None or task.on_host:
        parser.error(f"--task: expected one in JAX whose truth is known, got {given.task}")
    trajectories = simulations(task)
    atomic.write_arrays(given.out / f"{task.name}.npz", {"trajectories": trajectories})
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 1.9)
        draw(figure, task, trajectories)
        style.save(figure, given.out / f"{task.name}.png", 200)
    print(f"wrote {given.out / task.name}.png")


if __name__ == "__main__":
    main()
