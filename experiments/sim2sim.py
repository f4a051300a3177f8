"""Real2Sim with known truth: how well length and stiffness are recovered, on the initial support and with EDGE.

    python -m experiments.sim2sim --out experiments/results/sim2sim

Twenty simulated DLOs inside Theta_0 and eight outside of it are observed once each, under the exploratory actions,
and inferred with the support kept fixed and with EDGE, for each setting of the keypoint detector, which determines how
much can be inferred. Chunks of runs are saved as they end; repeating an interrupted command continues it.
"""

import argparse
import csv
import dataclasses
import io
import itertools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from rich.console import Console
from rich.progress import track
from rich.table import Table

import jaxlfi
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.distributions.belief import rejected
from jaxlfi.envs.whip.parameters import MEDIAN
from jaxlfi.envs.whip.physics.chain import elasto_gravity
from jaxlfi.envs.whip.real2sim import task
from jaxlfi.figures import legends, style
from jaxlfi.figures.natural import Scale
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance
from jaxlfi.tasks.simulation import trajectory_and_outcome

INSIDE = 20
OUTSIDE = np.array(
    [[110, 6e3], [150, 2e4], [170, 1.2e5], [210, 3e5], [260, 1.5e5], [330, 1.2e4], [345, 2e3], [320, 1e5]]
)
"""Lengths (mm) and moduli (Pa) outside of Theta_0, in one or in both."""
HEURISTICS = {
    "fixed": jaxlfi.Fixed(),
    "edge": jaxlfi.Edge(mass_threshold=jnp.array([0.003, 0.005]), uninformed_factor=1.0),
}
SETTINGS = QUICK.replace(
    rounds=8, simulations_per_round=60, simulation_budget=75, estimator=QUICK.estimator.replace(batch_size=10)
)
"""`quick` with 480 simulations per run; the paper uses 1,500."""
DRAWS = 500
RUNS_PER_CHUNK = 14


def truths(seed: int = 0) -> np.ndarray:
    """Lengths (mm) and moduli (Pa): uniform over Theta_0 in length and log-modulus, then `OUTSIDE`, shape [28, 2]."""
    unit = np.random.default_rng(seed).uniform(size=(INSIDE, 2))
    inside = np.stack([195 + 110 * unit[:, 0], 1e3 * 50 ** unit[:, 1]], axis=-1)
    return np.concatenate([inside, OUTSIDE])


def study(out: Path, detector: str, console: Console) -> dict[str, np.ndarray]:
    """Draws of every posterior in inference space, shape [28, 500, 2], and the final bounds, by heuristic."""
    problem = task(detector=detector)
    theta = np.asarray(problem.space.to_inference(jnp.asarray(truths(), jnp.float32)))
    observe = jax.jit(jax.vmap(lambda key, theta: trajectory_and_outcome(problem, key, theta)))
    observed, failure = observe(jax.random.split(jax.random.key(1), len(theta)), theta)
    if np.any(failure):
        raise SystemExit(f"{int(np.sum(failure != 0))} of the observed simulations failed")
    found = {"theta": theta}
    for name, heuristic in HEURISTICS.items():

        @jax.jit
        def infer(keys, observed, heuristic=heuristic):
            def one(key, observed):
                key_run, key_draw = jax.random.split(key)
                run = jaxlfi.infer(
                    key_run, problem, observed, support="initial", heuristic=heuristic, settings=SETTINGS
                )
                draws = rejected(key_draw, run.belief, DRAWS)
                failed = jnp.sum(run.history["failed"])
                return {
                    "draws": draws, "failed": failed,
                    "low": run.belief.support.low, "high": run.belief.support.high,
                }  # fmt: skip

            return jax.vmap(one)(keys, observed)

        keys = jax.random.split(jax.random.key(2), len(theta))
        parts = []
        for start in track(
            range(0, len(theta), RUNS_PER_CHUNK), description=f"{detector} {name}", console=console, transient=True
        ):
            path = out / "chunks" / f"{detector}_{name}_{start:02d}.npz"
            if not path.exists():
                rows = slice(start, start + RUNS_PER_CHUNK)
                atomic.write_arrays(path, jax.device_get(infer(keys[rows], observed[rows])))
            parts.append(atomic.read_arrays(path))
        for field in parts[0]:
            found[f"{name}/{field}"] = np.concatenate([part[field] for part in parts])
    return found


def saved(path: Path) -> dict[str, np.ndarray]:
    """The results of `study`, as saved by `main`."""
    return {name.replace("_", "/", 1): array for name, array in atomic.read_arrays(path).items()}


def measures(found: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Errors, standard deviations and coverage of every posterior, each [28, 2]: of length in mm, and of ln E."""
    draws, theta = found[f"{name}/draws"], found["theta"]
    low, high = np.quantile(draws, [0.05, 0.95], axis=1)
    return {
        "error": np.abs(draws.mean(axis=1) - theta),
        "mean error": np.abs(draws - theta[:, None]).mean(axis=1),
        "sd": draws.std(axis=1),
        "covered": (low <= theta) & (theta <= high),
    }


def lines(found: dict[str, np.ndarray], detector: str) -> list[dict[str, object]]:
    """The table: one row per heuristic and group of truths."""
    length, modulus = truths().T
    number = elasto_gravity(length / 1e3, modulus, MEDIAN.density)
    outside = np.arange(len(length)) >= INSIDE
    groups = {"inside": ~outside, "outside": outside}
    groups |= {
        f"inside, {text}": ~outside & chosen
        for text, chosen in (
            ("G < 50", number < 50), ("50 < G < 200", (number >= 50) & (number < 200)), ("G > 200", number >= 200),
        )
    }  # fmt: skip
    table = []
    width = np.array([110.0, np.log(50.0)])
    for (group, chosen), name in itertools.product(groups.items(), HEURISTICS):
        own = {key: value[chosen] for key, value in measures(found, name).items()}
        table.append(
            {
                "detector": detector,
                "truths": group,
                "n": int(chosen.sum()),
                "support": name,
                "length error [mm]": float(own["error"][:, 0].mean()),
                "ln E error": float(own["error"][:, 1].mean()),
                "length sd / width": float(own["sd"][:, 0].mean() / width[0]),
                "ln E sd / width": float(own["sd"][:, 1].mean() / width[1]),
                "length in 90 %": float(own["covered"][:, 0].mean()),
                "ln E in 90 %": float(own["covered"][:, 1].mean()),
                "failed": int(found[f"{name}/failed"][chosen].sum()),
            }
        )
    return table


def draw(figure: Figure, found: dict[str, dict[str, np.ndarray]]) -> None:
    """Draw inferred over true values with 90 % intervals: a column per detector and heuristic, length above modulus."""
    columns = list(itertools.product(found, HEURISTICS))
    axes = figure.subplots(2, len(columns), squeeze=False, sharex="row", sharey="row")
    box = ((195, 305), (np.log(1e3), np.log(5e4)))
    look = dict(zip(HEURISTICS, style.looks(["initial", "initial+edge"]).values(), strict=True))
    for column, (detector, name) in enumerate(columns):
        own, colour = found[detector], look[name].colour
        draws, theta = own[f"{name}/draws"], own["theta"]
        low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=1)
        axes[0, column].set_title(
            f"{detector} keypoints\n{'EDGE' if name == 'edge' else 'fixed support'}", color=colour
        )
        for row, parameter in enumerate((Scale("length", "mm"), Scale("Young's modulus", "Pa", log=True))):
            panel = axes[row, column]
            panel.axvspan(*box[row], color="0.92", zorder=0)
            panel.axline((theta[0, row],) * 2, slope=1, **style.TRUTH_LINE, zorder=1)
            panel.errorbar(
                theta[:, row], middle[:, row], [middle[:, row] - low[:, row], high[:, row] - middle[:, row]],
                fmt=look[name].marker, markersize=2.8, linewidth=0.8, color=colour, zorder=2,
            )  # fmt: skip
            for axis, words in ((panel.xaxis, "true"), (panel.yaxis, "inferred")):
                dataclasses.replace(parameter, label=f"{words} {parameter.label}").show(axis, 5)
            if column:
                panel.set_ylabel("")
    handles = [
        Line2D([], [], color=style.GREY, marker="o", markersize=3, label="median and 90 % interval, one for each DLO"),
        Line2D([], [], **style.TRUTH_LINE, label="truth"),
        Patch(color="0.92", label="first guess"),
    ]
    legends.below(figure, handles)


def main() -> None:
    """Run the study, and write its table and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--detectors", nargs="+", default=["clean", "mask", "transporter"])
    arguments = parser.parse_args()
    console = Console(width=160)
    arguments.out.joinpath("chunks").mkdir(parents=True, exist_ok=True)
    # Saved results are drawn, and not computed again.
    kept = {name: arguments.out / f"{name}.npz" for name in arguments.detectors}
    found = {name: saved(path) if path.exists() else study(arguments.out, name, console) for name, path in kept.items()}
    table = [line for name, own in found.items() for line in lines(own, name)]
    stream = io.StringIO()
    writer = csv.DictWriter(stream, table[0])
    writer.writeheader()
    writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in line.items()} for line in table)
    atomic.write_bytes(arguments.out / "table.csv", stream.getvalue().encode())
    for name, own in found.items():
        atomic.write_arrays(arguments.out / f"{name}.npz", {k.replace("/", "_"): v for k, v in own.items()})
    command = provenance.command_line(["python", "-m", "experiments.sim2sim", *sys.argv[1:]])
    atomic.write_json(arguments.out / "config.json", provenance.environment() | {"command_line": command})
    shown = Table(*table[0])
    for line in table:
        shown.add_row(*(f"{v:.3g}" if isinstance(v, float) else str(v) for v in line.values()))
    console.print(shown)
    with style.context():
        figure = style.new_figure(min(1.8 * len(HEURISTICS) * len(found), style.TEXT_WIDTH), 4.2)
        draw(figure, found)
        style.save(figure, arguments.out / "recovery.png", 200)


if __name__ == "__main__":
    main()
