"""Embeddings of raw observations compared with hand-crafted summaries.

    python -m experiments.embedding --task lotka_volterra --configuration misspecified+edge --box ok
    python -m experiments.embedding --task whip --configuration initial+edge --box initial

Lotka-Volterra's 151 x 2 populations are compared with its nine summaries, and the whip's 16 x 30 states and actions
with its 112 cross-correlations and moments. With the same settings except for the embedding, each candidate infers (a)
the task's own truth from `--seeds` observations, and (b) `--truths` truths drawn from a box, each from its own
observation; the observations are the same for all candidates (`experiments.widths`). (a) gives the error, (b) error and
coverage.

A candidate whose arrays are there is not run again; the table is made from the arrays.
"""

import argparse
import dataclasses
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import numpy as np
from rich.console import Console

from experiments.widths import DRAWS, FLOOR, RULES, TUNING, drawn_cases, infer_all, own_cases, save
from jaxlfi.bayessim.presets import settings_for
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.io import files as atomic
from jaxlfi.registry import TASKS
from jaxlfi.tasks.task import Task

NAMES = ("summaries", "raw", "mlp", "series")
"""Candidates: the task's summaries, or its trajectories without an embedding and with each of two."""


def candidate(name: str, task: Task) -> tuple[Task, Settings]:
    """The task as a candidate observes it, and the settings of its inference."""
    quick = settings_for(task).replace(predictive=False)
    if name == "summaries":
        return task, quick
    raw = dataclasses.replace(task, summary="identity", summary_names=())
    if name == "raw":
        return raw, quick
    return raw, quick.replace(estimator=quick.estimator.replace(embedding=name))


def table(folder: Path) -> str:
    """The comparison as Markdown, from the saved arrays; errors are means over parameters, in widths of the box."""
    lines = [
        "| candidate | error, own truth | 90 % covers it | error, drawn truths | 50 % | 90 % | log-density | s a run |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in NAMES:
        path = folder / f"{name}-own.npz"
        if not path.exists():
            continue
        own = atomic.read_arrays(path)
        cells = [f"`{name}`", _error(own), f"{_held(own, 0.9):.2f}"]
        drawn = folder / f"{name}-drawn.npz"
        if drawn.exists():
            arrays = atomic.read_arrays(drawn)
            density = np.mean(np.maximum(arrays["log_prob"], FLOOR))
            cells += [_error(arrays), *(f"{_held(arrays, level):.2f}" for level in (0.5, 0.9)), f"{density:.2f}"]
        else:
            cells += [""] * 4
        cells.append(f"{float(own['seconds']) / len(own['error']):.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _error(arrays: dict[str, np.ndarray]) -> str:
    """Mean distance of posterior draws from the truth with its interval, and the median over runs."""
    error = (arrays["parameter_error"] / arrays["width"]).mean(axis=1)
    low, high = bootstrap_interval(error)
    return f"{error.mean():.3f} [{low:.3f}, {high:.3f}] ({np.median(error):.3f})"


def _held(arrays: dict[str, np.ndarray], level: float) -> float:
    """The fraction of truths inside highest-density regions of that level."""
    return float(np.mean(arrays["density_rank"] < level * (DRAWS + 1)))


def main() -> None:
    """Run the candidates that are missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="lotka_volterra")
    parser.add_argument("--configuration", default="misspecified+edge", help="support, or support+heuristic")
    parser.add_argument("--box", default="ok", help="support that truths are drawn over")
    parser.add_argument("--candidates", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--seeds", type=int, default=10, help="observations of the task's own truth")
    parser.add_argument("--truths", type=int, default=40, help="truths drawn over the box; 0: none")
    parser.add_argument("--first-seed", type=int, default=TUNING, help="0 to report, from 1000 to choose")
    parser.add_argument("--rounds", type=int, help="in place of the task's")
    parser.add_argument("--runs-per-batch", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("runs/embedding"))
    arguments = parser.parse_args()
    folder = arguments.out / arguments.task.replace(",", "-") / arguments.configuration
    folder.mkdir(parents=True, exist_ok=True)
    named, console = TASKS.load(arguments.task), Console()
    support, _, rule = arguments.configuration.partition("+")
    box = named.support(arguments.box)
    for name in arguments.candidates:
        task, settings = candidate(name, named)
        settings = settings if arguments.rounds is None else settings.replace(rounds=arguments.rounds)
        for kind, count in (("own", arguments.seeds), ("drawn", arguments.truths)):
            path = folder / f"{name}-{kind}.npz"
            if path.exists() or not count:
                continue
            console.print(f"{name}, {kind}", highlight=False)
            first = arguments.first_seed
            cases = own_cases(task, first, count) if kind == "own" else drawn_cases(task, arguments.box, first, count)
            batch = min(arguments.runs_per_batch, count)
            found = infer_all(
                task, settings, task.support(support), RULES[rule or "none"], cases, arguments.box, batch, console
            )
            save(path, found | {"width": np.asarray(box.width)}, settings, box=arguments.box)
    (folder / "table.md").write_text(table(folder))
    print(table(folder))


if __name__ == "__main__":
    main()
