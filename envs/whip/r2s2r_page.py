"""The page that `jaxlfi r2s2r` ends with: posteriors, training domains, returns on the object, and a film."""

import argparse
import csv
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxlfi.cli.loops import believed
from jaxlfi.envs.whip import render
from jaxlfi.envs.whip.reference_objects import film
from jaxlfi.envs.whip.reference_objects.deployment import deploy
from jaxlfi.envs.whip.reference_objects.objects import load as load_object
from jaxlfi.envs.whip.reference_objects.scene import PLACE
from jaxlfi.io import files, web_page
from jaxlfi.rl import policy
from jaxlfi.runs.load import load
from jaxlfi.runs.run import Run

REPETITIONS = 16
"""Number of places at which policies are compared in the end."""

SHOWN = {
    "film": "Film of the last policy on the object, at half speed",
    "sheet": "The last policy on the object, control step by control step, with the keypoints it saw",
    "curves": "Return of training episodes over environment steps",
    "predictive": "Keypoints of simulations of the posterior over the observed ones, at eight moments and over time",
    "posterior/pairs": "Posterior of length and Young's modulus",
    "posterior/samples": "Lengths and moduli simulated in each iteration, and the last posterior",
    "posterior/efficiency": "Success rate of simulations over iterations",
    "posterior/curves": "Accuracy of posterior samples over iterations",
    "posterior/support": "Bounds of length and Young's modulus over iterations",
    "posterior/losses": "Training and validation losses",
    "posterior/predictive": "Channels of simulations of the posterior over time, as bands, and the observed ones",
    "posterior/channels": "Trajectory error by channel",
}
"""Alternative texts of the pictures, by file name."""
UNMEASURED = ("policy", "object")
"""Columns of the table of returns that are not results."""


def write(arguments: argparse.Namespace, policies: Sequence[Path]) -> Path:
    """Write page.html, and film.gif and sheet.png of the last policy on the object.

    Args:
        arguments: arguments of `jaxlfi r2s2r`, whose stages are complete.
        policies: the files of all policies, in order.
    """
    out = arguments.out
    if not (out / "film.gif").exists():
        key, act = jax.random.key(arguments.seed), policy.load(policies[-1])
        last = deploy(key, load_object(arguments.object), act, whole=True)
        if last.recording is not None:
            film.save_pictures(out, last, float(PLACE.cube_side), f"{arguments.object}: return {last.value:.2f}")
    runs = [arguments.posterior] if arguments.posterior else [out / "iteration_1/posterior"]
    runs += [out / f"iteration_{iteration}/posterior" for iteration in range(2, arguments.iterations + 1)]
    posteriors = {folder: load(folder) for folder in runs}
    with (out / "deployed" / "table.csv").open(newline="") as file:
        fared = [_fared(row, out) for row in csv.DictReader(file)]
    pictures = [path for path in (out / "film.gif", out / "sheet.png") if path.exists()]
    pictures += predicted(out, list(posteriors.values()))
    pictures += [*sorted(out.glob("**/policy*/curves.png")), *sorted(out.glob("iteration_*/posterior/figures/*.png"))]
    parts = (
        f"<p>Heuristic {html.escape(arguments.heuristic)}, preset {arguments.preset}, seed {arguments.seed}, "
        f"seen by the detector {arguments.detector}.</p>",
        "<h2>What was believed</h2>",
        web_page.table([row for folder, run in posteriors.items() for row in believed(folder, run)]),
        "<h2>What was trained on</h2>",
        web_page.table(
            [{"policy": _name(path, out), "domain": policy.load(path).schema.get("domain", "")} for path in policies]
        ),
        f"<h2>How it fared on the object</h2><p>At {REPETITIONS} places; the first is nominal, at the others stack and "
        "camera are displaced as in training. All policies meet the same places.</p>",
        web_page.table(fared),
        "<h2>Pictures</h2>",
        *(_figure(path.relative_to(out)) for path in pictures),
    )
    page = web_page.document(f"{arguments.object}: from the object to a policy, and back", parts)
    files.write_bytes(out / "page.html", page.encode())
    return out / "page.html"


def predicted(out: Path, runs: Sequence[Run]) -> list[Path]:
    """Draw keypoints of simulations of each posterior over the observed ones: predictive_1.png and so on."""
    simulated = [run for run in runs if np.isfinite(run.history["sample_trajectory_error"][-1]).any()]
    return [render.save_predictive(out / f"predictive_{i}.png", run) for i, run in enumerate(simulated, 1)]


def _fared(row: Mapping[str, str], out: Path) -> dict[str, str]:
    """A row of the table of returns, without the object, which is in the title."""
    measured = [(name.replace("_", " "), _short(value)) for name, value in row.items() if name not in UNMEASURED]
    return {"policy": _name(Path(row["policy"]), out), **dict(measured)}


def _name(path: Path, out: Path) -> str:
    """A policy's file, relative to the loop's folder if it is inside."""
    return path.relative_to(out).as_posix() if path.is_relative_to(out) else str(path)


def _short(value: str) -> str:
    try:
        return f"{float(value):.2f}"
    except ValueError:
        return value


def _figure(path: Path) -> str:
    where = "" if path.parent == Path() else f", of {path.parent.as_posix()}"
    kind = f"posterior/{path.stem}" if path.parent.name == "figures" else path.stem.partition("_")[0]
    shown = f"{SHOWN.get(kind, path.stem)}{where}"
    return web_page.figure(path.as_posix(), shown, f"{shown}.")
