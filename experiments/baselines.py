"""EDGE compared with other remedies for a wrong support, truncation and tailed priors, on Lotka-Volterra.

    python -m experiments.baselines --seeds 20 --out experiments/results/baselines

Every row has the same budget of simulations, the same seeds and, for each seed, the same observation. The seeds of a
row are runs of one program, sharded over the CPU cores. A row whose array file exists is not run again; table and
figure are made from the saved arrays. `--seeds 2 --rounds 2 --steps 20` is a trial.
"""

import argparse
import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import numpy as np
from rich.console import Console

from experiments.ablation import CLIPPED, PAPER_EDGE
from jaxlfi.bayessim.batch import BatchEngine, RunSpec, stack_inputs
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.record import theta_error, trajectory_error
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.envs.lotka_volterra import task as lotka_volterra
from jaxlfi.figures import seeds as strips
from jaxlfi.figures import style
from jaxlfi.heuristics import Fixed, Heuristic, Truncate
from jaxlfi.io import files as atomic
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.provenance import environment
from jaxlfi.runs.describe import heuristic_to_json, settings_to_json
from jaxlfi.tasks.observation import simulate_observation
from jaxlfi.tasks.tailed_uniform import with_tails
from jaxlfi.tasks.task import Task

REFERENCE = "misspecified+edge"
"""The row that all others are compared with, seed by seed."""


def in_one_round(settings: Settings) -> Settings:
    """All simulations, and all attempts, in a single round; the training of a round is unchanged."""
    return settings.replace(
        rounds=1,
        simulations_per_round=settings.rounds * settings.simulations_per_round,
        simulation_budget=settings.rounds * settings.simulation_budget,
    )


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        what: description in words.
        support: name of the first support, in the changed task.
        heuristic: heuristic that adapts it.
        task: function that changes the task.
        settings: function that changes the settings.
    """

    what: str
    support: str
    heuristic: Heuristic = Fixed()
    task: Callable[[Task], Task] = lambda task: task
    settings: Callable[[Settings], Settings] = lambda settings: settings


def tailed(tail: float) -> Callable[[Task], Task]:
    """Add tails to the misspecified support, with this scale in units of its width."""
    return lambda task: with_tails(task, "misspecified", tail)


TAILS = (0.1, 0.2, 0.3)

ROWS: dict[str, Row] = {
    "ok": Row("holds the truth, kept", "ok"),
    "misspecified": Row("excludes it in theta_1 and theta_2, kept", "misspecified"),
    "broad": Row("as wide as Phi, kept", "broad"),
    "broadest": Row("wider than Phi, kept", "broadest"),
    REFERENCE: Row("misspecified, moved by EDGE", "misspecified", PAPER_EDGE),
    "misspecified+truncate": Row("misspecified, truncated: proposals from the prior", "misspecified", Truncate()),
    **{
        f"tails-{tail:g}-static": Row(
            f"misspecified with tails of {tail:g}, one round", "tailed", task=tailed(tail), settings=in_one_round
        )
        for tail in TAILS
    },
    **{
        f"tails-{tail:g}": Row(f"misspecified with tails of {tail:g}, the first round", "tailed", task=tailed(tail))
        for tail in TAILS
    },
}
"""The rows by name, in the table's order."""


def run_row(row: Row, task: Task, settings: Settings, seeds: int) -> dict[str, np.ndarray]:
    """All seeds of one row.

    Args:
        row: the row.
        task: the unchanged task; its observations are those of all rows.
        settings: settings of a sequential run.
        seeds: number of seeds, from 0.

    Returns:
        Arrays with a leading axis of seeds: theta_error, theta_error_by_parameter, trajectory_error, attempted and
        succeeded (trailing axis: rounds), support_low and support_high at the end; and the seconds of all seeds
        together.
    """
    observed = np.stack([simulate_observation(run_keys(key_of(seed)).observe, task) for seed in range(seeds)])
    x = np.asarray(jax.vmap(task.summary)(observed))
    task, settings = row.task(task), row.settings(settings)
    specs = [RunSpec(row.support, row.support, task.support(row.support), row.heuristic, seed) for seed in range(seeds)]
    inputs, _ = stack_inputs(specs, observed, x)
    engine, seen, times = BatchEngine(task, settings, inputs), [], []
    with RoundProgress(Console(), settings.rounds, 0, f"{seeds} seeds") as progress:

        def keep(index, state, line, elapsed):
            seen.append(line)
            times.append(elapsed)
            progress.advance()

        run_rounds(engine, engine.start(), range(settings.rounds), keep, progress.compiled)
    seconds = sum(times)
    last = [{name: value[seed] for name, value in seen[-1].items()} for seed in range(seeds)]
    return {
        "theta_error": np.array([theta_error(line) for line in last]),
        "theta_error_by_parameter": np.stack([line["sample_theta_error"].mean(axis=0) for line in last]),
        "trajectory_error": np.array([trajectory_error(line) for line in last]),
        "attempted": np.stack([line["attempted"] for line in seen], axis=1),
        "succeeded": np.stack([line["succeeded"] for line in seen], axis=1),
        "support_low": seen[-1]["support_low"],
        "support_high": seen[-1]["support_high"],
        "seconds": np.asarray(seconds),
    }


def saved(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """The saved arrays of finished rows, in the table's order."""
    return {name: atomic.read_arrays(path) for name in ROWS if (path := folder / f"{name}.npz").exists()}


def table(rows: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """The comparison as Markdown: means with 95 % bootstrap intervals over seeds, medians in parentheses."""
    reference = rows.get(REFERENCE)
    dim = max(arrays["theta_error_by_parameter"].shape[1] for arrays in rows.values())
    by_parameter = [f"theta_{d + 1}" for d in range(dim)]
    header = ["row", "what it is", "summed error", f"paired difference to {REFERENCE}", *by_parameter]
    header += ["trajectory error", "success", "seconds per run"]
    lines = [header, ["---"] * len(header)]
    for name, arrays in rows.items():
        errors = arrays["theta_error"]
        paired = reference is not None and name != REFERENCE
        lines.append(
            [
                f"`{name}`",
                ROWS[name].what,
                f"{_with_interval(errors)} ({np.median(errors):.2f})",
                _with_interval(errors - reference["theta_error"]) if paired else "",
                *(f"{mean:.2f}" for mean in arrays["theta_error_by_parameter"].mean(axis=0)),
                f"{np.nanmean(arrays['trajectory_error']):.2f}",
                f"{np.mean(arrays['succeeded'].sum(axis=1) / arrays['attempted'].sum(axis=1)):.0%}",
                f"{arrays['seconds'] / len(errors):.1f}",
            ]
        )
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _with_interval(values: np.ndarray) -> str:
    low, high = bootstrap_interval(values)
    return f"{values.mean():.2f} [{low:.2f}, {high:.2f}]"


def draw(rows: Mapping[str, Mapping[str, np.ndarray]], path: Path) -> None:
    """Draw the summed errors, one strip per row."""
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 3.0)
        strips.draw(
            figure,
            {name: arrays["theta_error"] for name, arrays in rows.items()},
            "parameter error (sum over four log-rates)",
        )
        style.save(figure, path, dpi=200)


def main(argv: list[str] | None = None) -> None:
    """Run the rows that are missing, and write table and figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="ROW")
    parser.add_argument("--rounds", type=int, default=CLIPPED.rounds)
    parser.add_argument("--steps", type=int, default=CLIPPED.estimator.steps, help="gradient steps each round")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/baselines"))
    arguments = parser.parse_args(argv)
    estimator = CLIPPED.estimator.replace(steps=arguments.steps)
    settings = CLIPPED.replace(rounds=arguments.rounds, estimator=estimator).check()
    arguments.out.mkdir(parents=True, exist_ok=True)
    configs = {
        name: {
            "what": row.what,
            "seeds": arguments.seeds,
            "settings": settings_to_json(row.settings(settings)),
            "heuristic": heuristic_to_json(row.heuristic),
        }
        for name, row in ROWS.items()
    }
    for name in saved(arguments.out):  # before anything is run
        there = json.loads((arguments.out / f"{name}.json").read_text())
        if different := [field for field, value in configs[name].items() if there.get(field) != value]:
            parser.error(f"{name}: expected a row of the same {' and '.join(different)}; choose another --out")
    for name in arguments.rows:
        path = arguments.out / f"{name}.npz"
        if path.exists():
            print(f"{name}: {path} is there already")
            continue
        print(f"{name}: {ROWS[name].what}", flush=True)
        arrays = run_row(ROWS[name], lotka_volterra(), settings, arguments.seeds)
        atomic.write_json(path.with_suffix(".json"), configs[name] | environment())
        atomic.write_arrays(path, arrays)
    rows = saved(arguments.out)
    (arguments.out / "table.md").write_text(table(rows))
    draw(rows, arguments.out / "seeds.png")
    print(f"wrote {arguments.out / 'table.md'} and {arguments.out / 'seeds.png'}")
    print(table(rows))


if __name__ == "__main__":
    main()
