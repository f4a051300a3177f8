"""Results of `jaxlfi r2s2r mujoco,config=FILE`: posteriors and returns by iteration, and those of the other arms.

results.json       numbers
page.html          the same in words, with pictures
"""

import argparse
import csv
import html
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.cli.loops import believed, moved
from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco import r2s2r_beside as beside
from jaxlfi.envs.mujoco.r2s2r_machine import report_of
from jaxlfi.io import files, web_page
from jaxlfi.io.provenance import environment
from jaxlfi.rl import policy, preparation
from jaxlfi.runs.load import load

SHOWN = {
    "curves": "Return of training episodes over environment steps",
    "pairs": "Posterior of each pair of parameters",
    "support": "Bounds of the parameters over rounds",
    "predictive": "Simulations of the posterior over time, as bands, and what was recorded",
}
"""Descriptions of pictures, for those who cannot see them, by file name; other pictures are left out."""
TEXTS = ("policy", "ended", "stopped")
"""Columns of the table of episodes that are not numbers."""


def write(arguments: argparse.Namespace, config: Path, policies: Mapping[str, Path]) -> Path:
    """Write results.json and page.html.

    Args:
        arguments: of the loop, whose stages are complete.
        config: of the task.
        policies: by name, "iteration 1" and so on, and those that they are compared with.
    """
    out = arguments.out
    found = results(arguments, config, policies)
    files.write_json(out / "results.json", {**found, **environment()})
    figures = sorted(out.glob("iteration_*/posterior/figures/*.png"))
    pictures = [*(path.parents[2] / "curves.png" for path in policies.values())]
    pictures += [path for path in figures if path.stem in SHOWN and path.stem != "curves"]  # its curves are of errors
    machine = f"the driver at {arguments.address}" if arguments.address else "a simulated machine in another process"
    steps = ", then ".join(f"{far:.2g}" for far in found["moved"])
    settled = f" The medians moved by {steps} half-widths of the previous 90 % intervals." if steps else ""
    parts = (
        f"<p>The machine: {html.escape(machine)}. Heuristic {html.escape(arguments.heuristic)}, preset "
        f"{arguments.preset}, seed {arguments.seed}.</p>",
        f"<h2>What was believed</h2><p>From all recordings so far.{settled}</p>",
        web_page.table([_belief(row) for row in found["believed"]]),
        *_delays(found["delays"]),
        "<h2>What was trained and achieved</h2><p>The return in simulation is the mean over 128 other points of what a "
        f"policy was trained on, that on the machine the mean of up to {arguments.episodes} episodes with its standard "
        "error, from measurements, and so with their noise. Episodes in which the robot was stopped before its time "
        "are counted, and not averaged.</p>",
        web_page.table([_fared(row) for row in found["policies"]]),
        "<h2>Recordings</h2>",
        web_page.table(recorded(out)),
        "<h2>Pictures</h2>",
        *(_figure(path.relative_to(out)) for path in pictures),
    )
    page = web_page.document(f"{config.stem}: from the machine to a policy, and back", parts)
    files.write_bytes(out / "page.html", page.encode())
    return out / "page.html"


def results(arguments: argparse.Namespace, config: Path, policies: Mapping[str, Path]) -> dict[str, Any]:
    """The same in numbers.

    Returns:
        "believed", a row for each parameter of an iteration, and of what it is compared with; "moved", how far each
        posterior was from the one before (`loops.moved`); "delays", in s (`delays`); "policies", a row for each, with
        what it was trained on, the return in simulation and on the machine.
    """
    out = arguments.out
    names = [name for name in policies if name.startswith("iteration ")]
    runs = {name: load(out / name.replace(" ", "_") / "posterior") for name in names}
    parameters = tables.parameters_of(tables.load(config))
    rows = [
        {"policy": name, **{key: row[key] for key in ("parameter", "median", "90 % interval", "last support")}}
        for name, run in runs.items()
        for row in believed(out, run)
    ]
    for arm in (name for name in policies if name not in runs):
        rows += _beside(arm, parameters, out)
    truths = {one.name: one.truth for one in parameters}
    several = list(runs.values())
    return {
        "task": arguments.task,
        "asked": {key: getattr(arguments, key) for key in ("heuristic", "preset", "seed", "infer", "train")},
        "believed": [{**row, "truth": truths.get(row["parameter"])} for row in rows],
        "moved": [moved(*pair) for pair in itertools.pairwise(several)],
        "delays": delays(out, [row for row in rows if row["policy"] == names[-1]], policy.load(policies[names[-1]])),
        "policies": [
            {
                "policy": name,
                "domain": str(policy.load(path).schema.get("domain", "")),
                "trained": _in_simulation(path),
                **achieved(out / "deployed" / "table.csv", name),
            }
            for name, path in policies.items()
        ],
    }


def achieved(table: Path, name: str) -> dict[str, Any]:
    """A policy's performance on the machine, over the episodes that were not stopped early.

    Args:
        table: of all episodes.
        name: of the policy.

    Returns:
        The number of "episodes", how many were "stopped", and how many were "ended" by each termination; for each
        further column the mean and its standard error, None where undefined.
    """
    with table.open(newline="") as file:
        own = [row for row in csv.DictReader(file) if row["policy"] == name]
    ended = [row["ended"] for row in own if row["ended"]]
    kept = [row for row in own if not row["stopped"]]
    found: dict[str, Any] = {"episodes": len(own), "stopped": len(own) - len(kept)}
    found["ended"] = {one: ended.count(one) for one in dict.fromkeys(ended)}
    for column in own[0]:
        if column in (*TEXTS, "episode"):
            continue
        values = np.array([float(row[column]) for row in kept])
        error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
        found[column] = {"mean": float(values.mean()) if len(values) else None, "error": error}
    return found


def delays(out: Path, believed: Sequence[Mapping[str, str]], trained: policy.Policy) -> dict[str, Any]:
    """The inferred delays, next to the ages of measurements in recordings and in training.

    Args:
        out: of the loop.
        believed: of the newest posterior, a row for each parameter.
        trained: the newest policy.

    Returns:
        "inferred", by parameter its "median" and "90 % interval", and the bounds "trained" of what the policy was
        trained on; "ages", the median one of each recording, by its file; "observation_delay" and "action_delay", the
        bounds that the policy was trained with. In s.
    """
    on, prepared = trained.schema.get(policy.TRAINED_ON, {}), trained.schema.get(preparation.KEY, {})
    inferred = {
        row["parameter"]: {key: row[key] for key in ("median", "90 % interval")}
        | {"trained": [on[row["parameter"]][end] for end in ("low", "high")] if row["parameter"] in on else None}
        for row in believed
        if row["parameter"].endswith("/delay")
    }
    reports = {str(path.relative_to(out)): report_of(path)["timing"].get("age") for path in reports_of(out)}
    return {
        "inferred": inferred,
        "ages": {name: age for name, age in reports.items() if age is not None},
        **{key: list(prepared.get(key, (0.0, 0.0))) for key in ("observation_delay", "action_delay")},
    }


def reports_of(out: Path) -> list[Path]:
    """Reports of all recordings, including those that were cut short."""
    paths = [*sorted(out.glob("excitation*/*.json")), out / "excitation.json"]
    paths += [*sorted(out.glob("iteration_*/rollout*.json")), *sorted(out.glob("iteration_*/*.cut-*/*.json"))]
    return [path for path in paths if path.exists()]


def recorded(out: Path) -> list[dict[str, str]]:
    """How each recording went."""
    rows = []
    for path in reports_of(out):
        report = report_of(path)
        missed, why = str(report["timing"]["missed"]), report["stopped"] or report.get("ended", "")
        row = {"recording": str(path.relative_to(out)), "controls": str(report["controls"])}
        age = report["timing"].get("age")
        row["age of measurements"] = "" if age is None else f"{1e3 * age:.3g} ms"
        rows.append({**row, "deadlines missed": missed, "ended early": why})
    return rows


def _beside(arm: str, parameters: Sequence[Any], out: Path) -> list[dict[str, str]]:
    """What is believed about the parameters where there is no posterior."""
    if arm == "uniform":
        bounds = [f"{one.support[0]:.4g} to {one.support[1]:.4g}" for one in parameters]
        return [
            {"policy": arm, "parameter": one.name, "median": "", "90 % interval": "", "last support": box}
            for one, box in zip(parameters, bounds, strict=True)
        ]
    found = beside.found_point(arm, out)
    return [
        {
            "policy": arm,
            "parameter": name,
            "median": f"{value:.4g}",
            "90 % interval": _interval(*ends),
            "last support": "",
        }
        for name, value, ends in zip(found["names"], found["theta"], found["interval"], strict=True)
    ]


def _interval(low: float | None, high: float | None) -> str:
    """A point's interval in words; JSON has None for NaN."""
    return "not constrained" if low is None or high is None or low != low else f"{low:.4g} to {high:.4g}"


def _in_simulation(path: Path) -> float:
    """The return of a trained policy on points of its domain that it was not trained on."""
    with (path.parents[2] / "table.csv").open(newline="") as file:
        return float(next(csv.DictReader(file))["return"])


def _belief(row: Mapping[str, Any]) -> dict[str, str]:
    truth = "" if row["truth"] is None else f"{row['truth']:.4g}"
    shown = {key: row[key] for key in ("parameter", "median", "90 % interval", "last support")}
    return {"after": beside.TITLES.get(row["policy"], row["policy"]), **shown, "truth": truth}


def _fared(row: Mapping[str, Any]) -> dict[str, str]:
    shown = {"policy": beside.TITLES.get(row["policy"], row["policy"]), "trained on": row["domain"]}
    shown |= {"return in simulation": f"{row['trained']:.3g}"}
    for column, one in row.items():
        if isinstance(one, Mapping) and "mean" in one and column != "controls":
            error = "" if one["error"] is None else f" ± {one['error']:.2g}"
            mean = "none" if one["mean"] is None else f"{one['mean']:.3g}{error}"
            shown["return on the machine" if column == "return" else column] = mean
    ended = ", ".join(f"{count} {name}" for name, count in row["ended"].items())
    return {**shown, "episodes": str(row["episodes"]), "ended": ended, "stopped": str(row["stopped"])}


def _delays(found: Mapping[str, Any]) -> tuple[str, ...]:
    """A section on delays, where any was inferred or measurements had an age."""
    ages, between = found["ages"].values(), lambda low, high: f"{1e3 * low:.3g} to {1e3 * high:.3g} ms"
    if not found["inferred"] and not any(ages):
        return ()
    rows = [
        {
            "delay": name,
            "inferred, in s": f"{one['median']} ({one['90 % interval']})",
            "recorded": "",
            "trained with": "" if one["trained"] is None else between(*one["trained"]),
        }
        for name, one in found["inferred"].items()
    ]
    recorded = between(min(ages), max(ages)) if ages else ""
    seen, acted = (between(*found[key]) for key in ("observation_delay", "action_delay"))
    rows.append({"delay": "age of measurements", "inferred, in s": "", "recorded": recorded, "trained with": seen})
    rows.append({"delay": "from action to actuator", "inferred, in s": "", "recorded": "", "trained with": acted})
    return (
        "<h2>Delays</h2><p>Recordings have the times at which the driver says that it measured, and ages are from then "
        "to the control. The delay of a sensor is what comes before: a policy acts on measurements that are as old as "
        "both together.</p>",
        web_page.table(rows),
    )


def _figure(path: Path) -> str:
    where = "" if path.parent == Path() else f", of {path.parent.as_posix()}"
    shown = f"{SHOWN[path.stem]}{where}"
    return web_page.figure(path.as_posix(), shown, f"{shown}.")
