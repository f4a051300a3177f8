"""Coverage of 90 % regions for truths near a bound of their box, from the arrays saved by experiments.widths.

    python -m experiments.near_bounds --folder experiments/results/widths

Truths are drawn again with the same key. They are sorted by the distance from the nearest bound, as a fraction of the
box's width, and divided into four parts of equal size.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from experiments.widths import DRAWS
from jaxlfi.io import files
from jaxlfi.registry import TASKS
from jaxlfi.studies.calibration.truths import simulated_truths
from jaxlfi.tasks.observation import simulator_shapes

TRUTHS = 100
"""Number of truths of each configuration, the first ones."""
PARTS = 4


def distances(name: str, box: str, first_seed: int = 0) -> np.ndarray:
    """Distances from the nearest bound of the truths that `experiments.widths` draws from a box, shape [`TRUTHS`]."""
    task = TASKS.load(name)
    support, key = task.support(box), jax.random.key(first_seed + 500_000)
    theta = simulated_truths(key, task, support, TRUTHS, simulator_shapes(task))["theta"]
    place = (theta - np.asarray(support.low)) / np.asarray(support.width)
    return np.minimum(place, 1 - place).min(axis=1)


def table(folder: Path, distance: np.ndarray) -> str:
    """Coverage of each configuration with saved arrays, as Markdown."""
    parts = np.array_split(np.argsort(distance), PARTS)
    cells = [f"up to {distance[part].max():.3f}" for part in parts]
    lines = [f"| configuration | {' | '.join(cells)} |", "|" + "---|" * (1 + PARTS)]
    for path in sorted(folder.glob("*/quick-drawn.npz")):
        held = files.read_arrays(path)["density_rank"][:TRUTHS] < 0.9 * (DRAWS + 1)
        cells = [f"{held[part].mean():.2f}" for part in parts]
        lines.append(f"| `{path.parent.name}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="lotka_volterra")
    parser.add_argument("--box", default="ok")
    parser.add_argument("--folder", type=Path, default=Path("experiments/results/widths"))
    arguments = parser.parse_args()
    found = table(arguments.folder / arguments.task, distances(arguments.task, arguments.box))
    (arguments.folder / arguments.task / "near_bounds.md").write_text(found)
    print(found)


if __name__ == "__main__":
    main()
