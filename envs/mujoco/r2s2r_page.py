"""The page that `jaxlfi r2s2r mujoco,config=FILE` ends with: what was believed, trained and achieved, by iteration."""

import argparse
import csv
import html
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxlfi.cli.loops import believed, moved
from jaxlfi.envs.mujoco import config as tables
from jaxlfi.io import files, web_page
from jaxlfi.rl import policy
from jaxlfi.runs.load import load

SHOWN = {
    "curves": "Return of training episodes over environment steps",
    "pairs": "Posterior of each pair of parameters",
    "support": "Bounds of the parameters over rounds",
    "predictive": "Simulations of the posterior over time, as bands, and what was recorded",
}
"""What pictures show, for those who cannot see them, by file name; others are left out."""


def write(arguments: argparse.Namespace, config: Path, policies: Mapping[str, Path]) -> Path:
    """Write page.html.

    Args:
        arguments: of the loop, whose stages are complete.
        config: of the task.
        policies: by name.
    """
    out = arguments.out
    folders = sorted(out.glob("iteration_*/posterior"), key=lambda path: int(path.parent.name.rpartition("_")[2]))
    runs = {folder: load(folder) for folder in folders}
    steps = [f"{moved(*pair):.2g}" for pair in zip(list(runs.values())[:-1], list(runs.values())[1:], strict=True)]
    truths = {name: table.get("truth") for name, table in tables.load(config)["parameters"].items()}
    rows = [
        {"iteration": folder.parent.name.rpartition("_")[2], **_beliefs(row, truths)}
        for folder, run in runs.items()
        for row in believed(folder, run)
    ]
    fared = achieved(out / "deployed" / "table.csv")
    trained = [
        {"policy": name, "domain": str(policy.load(path).schema.get("domain", "")), "file": str(path)}
        for name, path in policies.items()
    ]
    pictures = [*sorted(out.glob("**/curves.png")), *sorted(out.glob("iteration_*/posterior/figures/*.png"))]
    machine = f"the driver at {arguments.address}" if arguments.address else "a simulated machine in another process"
    settled = f" The medians moved by {', '.join(steps)} half-widths of the 90 % intervals before." if steps else ""
    parts = (
        f"<p>The machine: {html.escape(machine)}. Heuristic {html.escape(arguments.heuristic)}, preset "
        f"{arguments.preset}, seed {arguments.seed}.</p>",
        f"<h2>What was believed</h2><p>From the excitation and the policies' recordings so far.{settled}</p>",
        web_page.table(rows),
        "<h2>What was trained</h2>",
        web_page.table(trained),
        f"<h2>What was achieved on the machine</h2><p>Means of {arguments.episodes} episodes with their standard "
        "errors; the return is that of the training.</p>",
        web_page.table(fared),
        "<h2>Recordings</h2>",
        web_page.table(recorded(out)),
        *(_figure(path.relative_to(out)) for path in pictures if path.stem in SHOWN),
    )
    page = web_page.document(f"{config.stem}: from the machine to a policy, and back", parts)
    files.write_bytes(out / "page.html", page.encode())
    return out / "page.html"


def achieved(table: Path) -> list[dict[str, str]]:
    """Means over the episodes of each policy, with their standard errors."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = []
    for name in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == name]
        line = {"policy": name, "episodes": str(len(own))}
        for column in rows[0]:
            if column in ("policy", "episode", "controls"):
                continue
            values = np.array([float(row[column]) for row in own])
            error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
            line[column] = f"{values.mean():.3g} ± {error:.2g}"
        found.append(line)
    return found


def recorded(out: Path) -> list[dict[str, str]]:
    """How each recording went."""
    rows = []
    for path in [out / "excitation.json", *sorted(out.glob("iteration_*/rollout.json"))]:
        if path.exists():
            report = json.loads(path.read_text())
            missed, why = report["timing"]["missed"], report["stopped"]
            rows.append({"recording": str(path.relative_to(out)), "deadlines missed": str(missed), "stopped": why})
    return rows


def _beliefs(row: Mapping[str, str], truths: Mapping[str, float | None]) -> dict[str, str]:
    truth = truths.get(row["parameter"])
    return {key: row[key] for key in ("parameter", "median", "90 % interval", "last support")} | {
        "truth of the simulated machine": "" if truth is None else f"{truth:.4g}"
    }


def _figure(path: Path) -> str:
    where = "" if path.parent == Path() else f", of {path.parent.as_posix()}"
    return web_page.figure(path.as_posix(), f"{SHOWN[path.stem]}{where}", path.as_posix())
