"""The physics of the whipping scene: compared with beam theory, over all parameters, at rest, and its speed.

    python -m experiments.whip_physics --out experiments/results/whip-physics

Writes table.csv (one line per chain), results.json (all numbers, with versions and the command), arrays.npz and
figures. Needs the extra `whip` and SciPy.
"""

import argparse
import csv
import importlib.metadata
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.whip_physics import figures, measure, rollouts
from experiments.whip_physics.models import KINDS
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.figures import style
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import command_line, environment

CHAINS = {"ball joints": Chain(planar=False), "planar hinges": Chain()}
"""The chains that a scene can have, by their kind."""
WILD = 4.0
"""Speed of a cube far beyond that of a fall from the stack's top (1.7) and of the gripper (0.5), in m/s."""


def statistics(scenes: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Statistics of random episodes and stacks with one kind of chain."""
    failed, wild = scenes["failed"], scenes["cube"] > WILD
    stacks = {name.removeprefix("stack "): values for name, values in scenes.items() if name.startswith("stack ")}
    measures = ("lateral", "vertical", "drift")
    return {
        "rollouts": len(failed),
        "failed": int(failed.sum()),
        "failed_fraction": float(failed.mean()),
        "failed_saturated": int((failed & scenes["saturated"]).sum()),
        "wild": int((wild & ~failed).sum()),
        "fastest_cube": float(scenes["cube"][~failed].max(initial=0.0)),
        "deepest": float(scenes["depth"][~failed].max(initial=0.0)),
        "greatest_lag": float(scenes["lag"][~failed].max(initial=0.0)),
        "stacks": {name: dict(zip(measures, values.tolist(), strict=True)) for name, values in stacks.items()},
    }


def table(arrays: Mapping[str, np.ndarray], scenes: Mapping[str, dict]) -> list[dict[str, object]]:
    """A row for each kind of chain, at the default number of elements; errors are relative."""
    at = measure.ELEMENTS.index(measure.DEFAULT)
    lines = []
    for i, kind in enumerate(KINDS):
        line = {"chain": kind, "elements": measure.DEFAULT}
        line |= {f"{name}_error": f"{arrays[name][i, at]:.2e}" for name in ("tip", "mass", "length")}
        for mode, name in enumerate(("first", "second")):
            line[f"{name}_frequency_error"] = f"{arrays['frequency'][i, at, mode]:.2e}"
        for name in ("rollouts", "failed", "wild", "steps_per_second"):
            line[name] = round(scenes[kind][name]) if kind in scenes else ""
        lines.append(line)
    return lines


def sag_errors(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, list[float]]]:
    """Errors of the tip of a DLO held horizontally: relative error of its sag, and along the clamp in DLO lengths."""
    exact = arrays["elastica"][:, -1]
    shapes = {"plain cable": "plain", "ball joints": "balls", "planar hinges": f"sag {measure.DEFAULT}"}
    shapes |= {f"planar hinges, N = {elements}": f"sag {elements}" for elements in measure.ELEMENTS}
    tips = {kind: arrays[name][:, -1] for kind, name in shapes.items()}
    return {
        kind: {"sag": (tip[:, 1] / exact[:, 1] - 1).tolist(), "along": (tip[:, 0] - exact[:, 0]).tolist()}
        for kind, tip in tips.items()
    }


THEORY = ("tip", "frequency", "rotary", "mass", "length")
ENERGIES = ("highest", "greatest_rise", "end", "drift")


def results(arrays: Mapping[str, np.ndarray], scenes: Mapping[str, dict]) -> dict[str, object]:
    """All results, and the grids they are measured on."""
    return {
        "errors": {"kinds": KINDS, "elements": measure.ELEMENTS, **{name: arrays[name].tolist() for name in THEORY}},
        "sag": {"numbers": measure.NUMBERS, **sag_errors(arrays)},
        "energy": {
            "swings": measure.SWINGS,
            "timesteps": measure.TIMESTEPS,
            "air": measure.AIR,
            **{name: arrays[name].tolist() for name in ENERGIES},
        },
        "scenes": scenes,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/whip-physics"))
    parser.add_argument("--engine", choices=("native", "mjx", "warp"), default="native", help="of the scenes")
    parser.add_argument("--rollouts", type=int, help="random episodes a chain: 1,000 with native, else 100")
    given = parser.parse_args(arguments)
    count = given.rollouts or (1000 if given.engine == "native" else 100)
    console, started = Console(), time.perf_counter()
    with console.status("beams"):
        arrays = {**measure.against_theory(), **measure.sags(), **measure.energies()}
    engines = {kind: pick(given.engine, Scene(chain=chain)) for kind, chain in CHAINS.items()}
    with console.status("speed"):
        speeds = rollouts.steps_per_second(list(engines.values()), min(count, rollouts.BATCH))
    scenes = {}
    for (kind, engine), speed in zip(engines.items(), speeds, strict=True):
        with console.status(f"{count} random episodes, {kind}"):
            measured = measure.scenes(engine, count)
        arrays |= {f"{kind}/{name}": values for name, values in measured.items()}
        scenes[kind] = {**statistics(measured), "steps_per_second": speed}
    made = environment()
    made["versions"] |= {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "scipy")}
    made["command_line"] = command_line(["python", "-m", "experiments.whip_physics", *(arguments or sys.argv[1:])])
    made |= {"engine": given.engine, "seconds": time.perf_counter() - started}
    lines = table(arrays, scenes)
    given.out.mkdir(parents=True, exist_ok=True)
    atomic.write_arrays(given.out / "arrays.npz", arrays)
    atomic.write_json(given.out / "results.json", results(arrays, scenes) | made)
    with (given.out / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
    draw(given.out)
    console.print((given.out / "table.csv").read_text())
    console.print(f"wrote {given.out}")


def draw(folder: Path) -> None:
    """Draw all pictures, from the arrays in a folder."""
    arrays = atomic.read_arrays(folder / "arrays.npz")
    with style.context():
        for name, (picture, *size) in figures.FIGURES.items():
            figure = style.new_figure(*size)
            picture(figure, arrays)
            style.save(figure, folder / f"{name}.png", 200)


if __name__ == "__main__":
    main()
