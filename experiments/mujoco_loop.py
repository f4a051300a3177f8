"""What the loop of a MuJoCo task came to, as the tables of a page, from its results.json.

jaxlfi r2s2r mujoco,config=examples/mujoco/furuta.toml ... --out runs/loop
python -m experiments.mujoco_loop runs/loop/results.json
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxlfi.envs.mujoco.r2s2r_beside import TITLES


def believed(found: Mapping[str, Any]) -> list[str]:
    """A line for each parameter, and a column for each iteration and for what it is compared with."""
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
    """A line for each policy: the return in simulation and on the machine, and how far signals were off in the end."""
    off = [column for column in found["policies"][0] if column.endswith(" off")]
    heading = ["trained on", "return in simulation", "return on the machine", *off, "ended early", "stopped"]
    lines = [f"| {' | '.join(heading)} |", "|---" * len(heading) + "|"]
    for one in found["policies"]:
        measured = [f"{one[column]['mean']:.3f} ± {one[column]['error']:.3f}" for column in ("return", *off)]
        ends = [f"{count} of {one['episodes']}" for count in (sum(one["ended"].values()), one["stopped"])]
        row = [TITLES.get(one["policy"], one["policy"]), f"{one['trained']:.3f}", *measured, *ends]
        lines.append(f"| {' | '.join(row)} |")
    return lines


def _belief(row: Mapping[str, Any]) -> str:
    if not row["median"]:
        return row["last support"]
    return f"{row['median']} ({row['90 % interval']})"


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("results", type=Path, metavar="FILE", help="results.json of a loop")
    found = json.loads(parser.parse_args(words).results.read_text())
    print("\n".join([*believed(found), "", *fared(found)]))


if __name__ == "__main__":
    main()
