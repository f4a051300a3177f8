"""Ablation on Lotka-Volterra: which choices affect the result, one change at a time.

    python -m experiments.ablation --seeds 20 --out experiments/results/ablation

Every variant runs the same configurations (supports and heuristics) on the same seeds, each seed with its own
observation. All runs of a variant are one vmapped program, sharded over the CPU cores. A variant whose array file
exists is not run again; the table is made from the saved arrays.
"""

import argparse
import dataclasses
import json
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.batch import BatchEngine, RunSpec, stack_inputs
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.presets import HYPERPARAMETERS, QUICK
from jaxlfi.bayessim.record import theta_error, trajectory_error
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.envs.lotka_volterra import task as lotka_volterra
from jaxlfi.heuristics import Centre, Edge, Fixed, Heuristic, Mode, paired
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.provenance import environment
from jaxlfi.runs.describe import heuristic_to_json, settings_to_json
from jaxlfi.tasks.observation import simulate_observation

MATRIX: dict[str, tuple[str, str]] = {
    "ok": ("ok", "none"),
    "misspecified": ("misspecified", "none"),
    "broad": ("broad", "none"),
    "misspecified+edge": ("misspecified", "edge"),
    "misspecified+mode": ("misspecified", "mode"),
    "misspecified+centre": ("misspecified", "centre"),
}
"""Configurations: (support, heuristic)."""


CLIPPED = QUICK.replace(
    restriction="clip",
    inflation=1.0,
    rounds=10,
    min_rounds=0,
    correction="none",
    estimator=QUICK.estimator.replace(
        epochs=0, steps=1000, learning_rate=1e-3, schedule="constant", parameters="feasible", reduction="none"
    ),
)
"""Proposals from the posterior itself, clipped, and a thousand gradient steps in every round: the settings of `quick`
before the study of widths, with which most studies were made."""
PAPER_EDGE = Edge(**HYPERPARAMETERS["paper"]["edge"])
"""EDGE with the paper's threshold, which those studies also used."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Attributes:
        change: difference from `single`, in words.
        settings: settings of the runs.
        edge: EDGE with this variant's options.
        configurations: names in `MATRIX` that are run.
    """

    change: str
    settings: Settings
    edge: Edge = PAPER_EDGE
    configurations: tuple[str, ...] = tuple(MATRIX)

    def heuristic(self, name: str) -> Heuristic:
        """A heuristic with its defaults; MODE pairs components if networks are reinitialised."""
        mode = paired(Mode(), self.settings.estimator.warm_start)
        return {"none": Fixed(), "edge": self.edge, "mode": mode, "centre": Centre()}[name]


def variants(quick: Settings = QUICK, clipped: Settings = CLIPPED) -> dict[str, Variant]:
    """The rows of the table, by name.

    `single` is `clipped` with one network instead of four, and every later row changes one setting of `single`. One
    network takes a quarter of the time, and shows effects that an ensemble would average out. Variants of EDGE itself
    do not affect the other configurations, which they leave out.
    """
    base = clipped.replace(estimator=clipped.estimator.replace(ensemble_size=1))

    def estimator(change: str, **fields) -> Variant:
        return Variant(change, base.replace(estimator=base.estimator.replace(**fields)))

    def run(change: str, **fields) -> Variant:
        return Variant(change, base.replace(**fields))

    def edge(change: str, rule: Edge) -> Variant:
        return Variant(change, base, rule, configurations=("misspecified+edge",))

    return {
        "quick": Variant(
            "the preset, ten rounds: wide proposals, training by epochs", quick.replace(rounds=10), Edge()
        ),
        "clipped": Variant("four networks", clipped),
        "single": Variant("one network", base),
        "no-prune": estimator("components of little weight kept", prune=0.0),
        "narrow": estimator("32 units a layer", hidden=(32, 32)),
        "relu": estimator("ReLU instead of tanh", activation="relu"),
        "zscore": estimator("plain z-score of the summaries", normaliser="zscore"),
        "warm": estimator("warm start instead of a fresh network each round (reading C)", warm_start=True),
        "last-weights": estimator("no validation split, last weights", validation=0.0),
        "slow": estimator("learning rate 1e-4", learning_rate=1e-4),
        "decay": estimator("weight decay 0.1", weight_decay=0.1),
        "paper-correction": run("posterior times the reference prior (reading A, paper)", correction="paper"),
        "importance": run("importance-weighted loss (reading A, importance)", correction="importance"),
        "reject": run("draws outside the support rejected (reading E)", restriction="reject"),
        "defensive": run("a tenth of the proposals from the prior over the support", defensive=0.1),
        "zone-only": edge("EDGE: mass in the zone only, no tail (reading G)", PAPER_EDGE.replace(tail=0.0)),
        "zone-width": edge(
            "EDGE: delta as an absolute width (reading F)", PAPER_EDGE.replace(zone_fraction=0.0, zone_width=0.1)
        ),
    }


def run_variant(variant: Variant, seeds: int) -> dict[str, np.ndarray]:
    """All configurations and seeds of one variant.

    Returns:
        Arrays with leading axes [configuration, seed]: theta_error, trajectory_error, attempted and succeeded (trailing
        axis: rounds), final support bounds; and the seconds of all runs together.
    """
    task = lotka_volterra()
    matrix = {label: MATRIX[label] for label in variant.configurations}
    # Seeds are the slow index, so that every device gets all configurations, both fast and slow ones.
    specs = [
        RunSpec(label, support, task.support(support), variant.heuristic(heuristic), seed)
        for seed in range(seeds)
        for label, (support, heuristic) in matrix.items()
    ]
    observed = np.stack([simulate_observation(run_keys(key_of(spec.seed)).observe, task) for spec in specs])
    x = np.asarray(jax.vmap(task.summary)(observed))
    inputs, _ = stack_inputs(specs, observed, x)
    engine, rows, times = BatchEngine(task, variant.settings, inputs), [], []
    with RoundProgress(Console(), variant.settings.rounds, 0, f"{len(specs)} runs in a batch") as progress:

        def keep(index, state, row, elapsed):
            rows.append(row)
            times.append(elapsed)
            progress.advance()

        run_rounds(engine, engine.start(), range(variant.settings.rounds), keep, progress.compiled)
    seconds = sum(times)

    def arranged(values):
        values = np.asarray(values)
        return values.reshape(seeds, len(matrix), *values.shape[1:]).swapaxes(0, 1)

    last = [{name: value[i] for name, value in rows[-1].items()} for i in range(len(specs))]
    return {
        "theta_error": arranged([theta_error(row) for row in last]),
        "theta_error_by_parameter": arranged([row["sample_theta_error"].mean(0) for row in last]),
        "trajectory_error": arranged([trajectory_error(row) for row in last]),
        "attempted": arranged(np.stack([row["attempted"] for row in rows], axis=1)),
        "succeeded": arranged(np.stack([row["succeeded"] for row in rows], axis=1)),
        "support_low": arranged(rows[-1]["support_low"]),
        "support_high": arranged(rows[-1]["support_high"]),
        "seconds": np.asarray(seconds),
    }


def table(folder: Path) -> str:
    """The ablation as Markdown, from the saved arrays: mean [95 % interval] and median of the summed error."""
    lines = [
        "| variant | change | " + " | ".join(MATRIX) + " |",
        "|---|---|" + "---|" * len(MATRIX),
    ]
    for name, variant in variants().items():
        path = folder / f"{name}.npz"
        if not path.exists():
            continue
        with np.load(path) as arrays:
            cells = dict.fromkeys(MATRIX, "")
            for label, errors in zip(arrays["configurations"], arrays["theta_error"], strict=True):
                low, high = bootstrap_interval(errors)
                cells[str(label)] = f"{errors.mean():.2f} [{low:.2f}, {high:.2f}] ({np.median(errors):.2f})"
        lines.append(" | ".join([f"| `{name}`", variant.change, *cells.values()]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the variants that are missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--variants", nargs="+", choices=list(variants()), default=list(variants()))
    parser.add_argument("--out", type=Path, default=Path("experiments/results/ablation"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.variants:
        path = arguments.out / f"{name}.npz"
        if path.exists():
            print(f"{name}: {path} is there already")
            continue
        variant = variants()[name]
        print(f"{name}: {variant.change}", flush=True)
        arrays = run_variant(variant, arguments.seeds)
        np.savez(path, **arrays, configurations=np.array(variant.configurations))
        config = {
            "change": variant.change,
            "seeds": arguments.seeds,
            "settings": settings_to_json(variant.settings),
            "edge": heuristic_to_json(variant.edge),
            **environment(),
        }
        path.with_suffix(".json").write_text(json.dumps(config, indent=2) + "\n")
    (arguments.out / "table.md").write_text(table(arguments.out))
    print(f"wrote {arguments.out / 'table.md'}")
    print(table(arguments.out))


if __name__ == "__main__":
    main()
