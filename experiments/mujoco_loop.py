"""Results of the loop of a MuJoCo task, as the tables of a page; and returns of further policies on its machine.

    jaxlfi r2s2r mujoco,config=examples/mujoco/furuta.toml ... --out runs/loop
    python -m experiments.mujoco_loop table runs/loop/results.json
    python -m experiments.mujoco_loop achieve examples/mujoco/furuta.toml runs/whips runs/own --out achieved.json

The second command runs policies, and one that does nothing, on the simulated machine as the loop does: from the same
starts, with the same noise.
"""

import argparse
import contextlib
import csv
import io
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.envs.mujoco import excitation, r2s2r, r2s2r_machine
from jaxlfi.envs.mujoco.r2s2r_beside import TITLES
from jaxlfi.envs.mujoco.served import Machine
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.rl.policy import Policy, load
from jaxlfi.robots.clock import Simulated

NOTHING = "nothing"
"""Name of a policy whose controls are the middle of their limits."""


def believed(found: Mapping[str, Any]) -> list[str]:
    """A row for each parameter, and a column for each iteration and each reference."""
    names = list(dict.fromkeys(row["policy"] for row in found["believed"]))
    cells = {(row["policy"], row["parameter"]): _belief(row) for row in found["believed"]}
    truths = {row["parameter"]: row["truth"] for row in found["believed"]}
    heading = ["parameter", "truth", *(TITLES.get(name, name) for name in names)]
    lines = [f"| {' | '.join(heading)} |", "|---" * len(heading) + "|"]
    for parameter, truth in truths.items():
        row = [f"`{parameter}`", f"{truth:.4g}", *(cells[name, parameter] for name in names)]
        lines.append(f"| {' | '.join(row)} |")
    return lines


def fared(found: Mapping[str, Any]) -> list[str]:
    """A row for each policy: return in simulation and on the machine, and distances of signals from their targets."""
    off = [column for column in found["policies"][0] if column.endswith(" off")]
    heading = ["trained on", "return in simulation", "return on the machine", *off, "ended early", "stopped"]
    lines = [f"| {' | '.join(heading)} |", "|---" * len(heading) + "|"]
    for one in found["policies"]:
        measured = [f"{one[column]['mean']:.3f} ± {one[column]['error']:.3f}" for column in ("return", *off)]
        ends = [f"{count} of {one['episodes']}" for count in (sum(one["ended"].values()), one["stopped"])]
        row = [TITLES.get(one["policy"], one["policy"]), f"{one['trained']:.3f}", *measured, *ends]
        lines.append(f"| {' | '.join(row)} |")
    return lines


def achieved(config: Path, policy: Path, episodes: int = r2s2r.EPISODES, seed: int = 0) -> list[float]:
    """Returns of a policy on the simulated machine, one per episode."""
    found, machine = [], Machine.of(config, seed=seed, scattered=True)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        for episode in range(episodes):
            driver = machine.driver(clock := Simulated(), episode)
            driver.simulated_clock = clock
            path = Path(folder) / f"{episode}.csv"
            r2s2r_machine.controlled(driver, policy, config, path)
            found.append(excitation.achieved(config, path)["return"])
    return found


def compared(config: Path, trainings: Sequence[Path]) -> dict[str, Any]:
    """Returns of the first policy of each training, and of `NOTHING`, on the machine and in simulation."""
    found: dict[str, Any] = {}
    for folder in trainings:
        with (folder / "table.csv").open(newline="") as file:
            trained = float(next(csv.DictReader(file))["return"])
        policy = next(folder.glob("*/seed_*/policy.npz"))
        settings = json.loads((folder / "config.json").read_text())["settings"]
        found[folder.name] = {"trained": trained, "achieved": achieved(config, policy), "settings": settings}
    one = load(policy)
    weights, biases = (tuple(map(np.zeros_like, layers)) for layers in (one.weights, one.biases))
    with tempfile.TemporaryDirectory() as folder:
        none = Policy(weights, biases, one.schema).save(Path(folder) / "policy.npz")
        return found | {NOTHING: {"achieved": achieved(config, none)}}


def line(name: str, found: Mapping[str, Any]) -> str:
    """A row of a table: return in simulation and on the machine."""
    values = np.array(found["achieved"])
    error = values.std(ddof=1) / np.sqrt(len(values))
    trained = f"{found['trained']:.3f}" if "trained" in found else ""
    return f"| {name} | {trained} | {values.mean():.3f} ± {error:.3f} |"


def _belief(row: Mapping[str, Any]) -> str:
    if not row["median"]:
        return row["last support"]
    return f"{row['median']} ({row['90 % interval']})"


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables, or run policies."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    table = commands.add_parser("table", help="print the tables of a loop")
    table.add_argument("results", type=Path, metavar="FILE", help="results.json of a loop")
    achieve = commands.add_parser("achieve", help="let policies act on the simulated machine")
    achieve.add_argument("config", type=Path, help="the TOML file of the task")
    achieve.add_argument("trainings", type=Path, nargs="+", help="folders of trainings")
    achieve.add_argument("--out", type=Path, required=True, help="a JSON file")
    arguments = parser.parse_args(words)
    if arguments.command == "table":
        found = json.loads(arguments.results.read_text())
        print("\n".join([*believed(found), "", *fared(found)]))
        return
    found = compared(arguments.config, arguments.trainings)
    files.write_json(arguments.out, {**found, **environment()})
    print("\n".join(line(name, one) for name, one in found.items()))


if __name__ == "__main__":
    main()
