"""Comparison of summaries for recordings of MuJoCo models: which should be the default?

    python -m experiments.mujoco_summaries --recordings 3 --out experiments/results/mujoco-summaries

Each example of examples/mujoco is recorded again as for `experiments.mujoco_sysid`, for truths that lie in its right
box and outside of its wrong one. For both boxes, inference with each summary uses the same settings, `quick` with EDGE;
all recordings of a box are run as one batch. Errors and half-widths are fractions of the right box's width, in
logarithms if those are inferred; the sign of the puck's lateral speed is ignored, as its recording does not identify
it. Existing results are kept.
"""

import argparse
import json
import tomllib
from collections.abc import Sequence
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

import numpy as np

from experiments.mujoco_sysid import BOXES, EXAMPLES, FOLDER, believed, judged, load, recordings
from jaxlfi.bayessim.presets import settings_for
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.registry import TASKS
from jaxlfi.runs.describe import settings_to_json
from jaxlfi.tasks.task import Task

SUMMARIES = ("samples", "cross-correlation", "spectrum", "learnt")
FIRST_SEED = 2000
"""First seed of the recordings, which differ from those that the methods are compared on."""
FOUND = 0.1
"""Error of every parameter below which a truth counts as found."""
ALL = "all"
"""Name of the row of all examples together."""


def summarised(name: str, summary: str) -> Task:
    """The task of an example, with a given summary."""
    return TASKS.load(f"mujoco,config={FOLDER / name}.toml,summary={summary}")


def measured(out: Path, name: str, box: str, summary: str) -> dict[str, np.ndarray] | None:
    """Accuracy of a summary's posteriors (`mujoco_sysid.judged`), and their seconds; None if there are none."""
    own = out / f"{name}-{box}-{summary}.npz"
    if not own.exists():
        return None
    arrays = files.read_arrays(own)
    count = len(arrays["seconds"])
    found = {key: values[:count] for key, values in files.read_arrays(out / f"{name}-recordings.npz").items()}
    return judged(load(name), found, arrays) | {"seconds": arrays["seconds"]}


def row(name: str, box: str, summary: str, several: Sequence[dict[str, np.ndarray]]) -> str:
    """A row of the table, for one example or for several together."""
    pooled = lambda key: np.concatenate([numbers[key].ravel() for numbers in several])
    found = np.concatenate([(numbers["error"] < FOUND).all(axis=1) for numbers in several])
    cells = [
        name, box, f"`{summary}`", str(len(found)),
        f"{np.median(pooled('error')):.3f} ({np.quantile(pooled('error'), 0.9):.3f})",
        f"{np.mean(pooled('held')):.2f}", f"{np.median(pooled('half')):.3f}", f"{np.mean(found):.2f}",
        f"{np.mean(pooled('seconds')):.0f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def table(out: Path) -> str:
    """All results so far, as Markdown."""
    lines = [
        "| example | box | summary | recordings | error, median (worst 10th) | 90 % intervals cover | half-width | "
        "truth found | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    numbers = {
        (name, box, summary): measured(out, name, box, summary)
        for name in EXAMPLES
        for box in BOXES
        for summary in SUMMARIES
    }
    lines += [row(*key, [found]) for key, found in numbers.items() if found is not None]
    for box in BOXES:
        for summary in SUMMARIES:
            several = [numbers[name, box, summary] for name in EXAMPLES]
            if all(found is not None for found in several):
                lines.append(row(ALL, box, summary, several))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", default=EXAMPLES, choices=EXAMPLES)
    parser.add_argument("--boxes", nargs="+", default=tuple(BOXES), choices=tuple(BOXES))
    parser.add_argument("--summaries", nargs="+", default=SUMMARIES, choices=SUMMARIES)
    parser.add_argument("--recordings", type=int, default=3, help="of each example (default: 3)")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/mujoco-summaries"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for summary in arguments.summaries:
        for name in arguments.examples:
            task = summarised(name, summary)
            path = arguments.out / f"{name}-recordings.npz"
            observed = recordings(path, task, name, arguments.recordings, FIRST_SEED)["observed"]
            for box in arguments.boxes:
                own = arguments.out / f"{name}-{box}-{summary}.npz"
                if not own.exists():
                    files.write_arrays(own, believed("edge", task, observed, BOXES[box], FIRST_SEED))
                    print(own, flush=True)
            with (FOLDER / f"{name}.toml").open("rb") as file:
                example = tomllib.load(file)
            settings = settings_to_json(settings_for(task))
            config = {"example": example, "first_seed": FIRST_SEED, "settings": settings, **environment()}
            (arguments.out / f"{name}-{summary}.json").write_text(json.dumps(config, indent=2) + "\n")
    text = table(arguments.out)
    (arguments.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
