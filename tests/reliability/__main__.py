"""What survives: runs that are killed, a full disk, a read-only folder, a moved one, a clock that jumps, two at once.

    python -m tests.reliability --kills 100

Each trial starts a command, kills it by SIGKILL, and goes on by `jaxlfi resume` (or by the same command, where nothing
had been begun), which is killed again; after three kills it goes on to its end, and its folder is compared bit by bit
with that of an undisturbed run by a fresh process. The first kill is in a window of writing (`injection`) that no other
trial has, the others are at moments drawn uniformly over the time that an undisturbed run takes; where a process has
come to its end before, there is no such kill. After these, `--every-window` kills the commands that it names once
before, midway and after each of their windows. What was done is kept in kills.csv as each trial ends; with the same
`--out`, an experiment that was stopped goes on.

The adversities need root, for small file systems in memory. Everything needs Linux.
"""

import argparse
import collections
import csv
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

if __name__ == "__main__":  # before jax is imported: every process finds its programs compiled
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path("runs/reliability-programs").absolute()))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import distributed  # noqa: F401 - so that the processes that are forked have it
import numpy as np

import jaxlfi.cli.commands
import jaxlfi.rl.training  # noqa: F401 - likewise
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment
from tests.reliability import adversities
from tests.reliability.commands import Command, commands
from tests.reliability.comparing import LEFT_OUT
from tests.reliability.injection import Blow
from tests.reliability.process import Ended, Running
from tests.reliability.undisturbed import Undisturbed

KILLS_PER_TRIAL = 3
AT_A_MOMENT, IN_A_WINDOW = "at a moment", "in a window"
OFF_ROUTE = ("infer", "grid", "train")
"""Commands that meet the adversities; `compare` and a run on a cluster keep their folders as `infer` does."""
COLUMNS = (
    "command", "trial", "kill", "of", "how", "second", "window", "operation", "file", "moment", "result", "beside",
)  # fmt: skip


def trial(
    undisturbed: Undisturbed, first: Blow, rng: np.random.Generator, folder: Path, most: int = KILLS_PER_TRIAL
) -> tuple[list[dict], str]:
    """Kill, go on, kill, go on, kill, go on, and compare.

    Returns:
        One row a kill, and what came of it: "" for the same bits.
    """
    folder.mkdir(parents=True)
    command, rows, ended = undisturbed.command, [], None
    for kill in range(most + 1):
        begun = (folder / "run" / "config.json").exists()
        words = command.resume if begun else command.start
        second = float(rng.uniform(0, undisturbed.ended.seconds)) if 0 < kill < most else None
        blow = first if kill == 0 else None
        ended = Running(folder, words, blow=blow, program=command.program).wait(second)
        if not ended.killed:  # it came to its end before
            break
        rows.append(_row(command, ended, kill, begun, blow))
    if ended.killed:
        return rows, "killed at the end"
    if ended.status:
        return rows, f"exit status {ended.status}: {ended.errors.strip().splitlines()[-1:]}"
    return rows, "; ".join(undisturbed.compared(folder / "run"))


def _row(command: Command, ended: Ended, kill: int, begun: bool, blow: Blow | None) -> dict[str, object]:
    """One kill, as kills.csv has it."""
    shared = {"command": command.name, "kill": kill, "of": "resume" if begun else "start"}
    if blow is None:
        return shared | {"how": AT_A_MOMENT, "second": f"{ended.seconds:.3f}"}
    at = ended.windows[blow.window]
    file = "/".join("new" if part.startswith(".run-") else part for part in at.path.split("/"))
    window = {"window": blow.window, "operation": at.operation, "file": file, "moment": blow.moment}
    return shared | {"how": IN_A_WINDOW} | window


def kills(
    all_undisturbed: Sequence[Undisturbed], count: int, every: Sequence[str], seed: int, out: Path, root: Path
) -> list[dict[str, str]]:
    """Trials of all commands in turn until so many kills were at a moment; then those of every window.

    Those that kills.csv has are not repeated.
    """
    path = out / "kills.csv"
    rows = read(path)
    order = {}
    for undisturbed in all_undisturbed:
        order[undisturbed.command.name] = np.random.default_rng(seed).permutation(len(undisturbed.blows))
    number = 1 + max((int(row["trial"]) for row in rows), default=-1)

    def one(undisturbed: Undisturbed, first: Blow, most: int) -> None:
        nonlocal number
        folder = root / f"trial-{number:03d}"
        shutil.rmtree(folder, ignore_errors=True)
        made, result = trial(undisturbed, first, np.random.default_rng([seed, number]), folder, most)
        beside = len(list(folder.glob(".run-*")))
        rows.extend(row | {"trial": number, "result": result or "same bits", "beside": beside} for row in made)
        write(path, rows, COLUMNS)
        words = f"{len(made)} kills, {result or 'same bits'}; {len(rows)} in all"
        print(f"trial {number}, {undisturbed.command.name}: {words}", flush=True)
        if not result:
            shutil.rmtree(folder)
        number += 1

    while sum(row["how"] == AT_A_MOMENT for row in rows) < count:
        undisturbed = all_undisturbed[number % len(all_undisturbed)]
        place = number // len(all_undisturbed) % len(undisturbed.blows)
        one(undisturbed, undisturbed.blows[order[undisturbed.command.name][place]], KILLS_PER_TRIAL)
    for undisturbed in all_undisturbed:
        name = undisturbed.command.name
        own = [row for row in rows if row["command"] == name and row["how"] == IN_A_WINDOW]
        done = {(str(row["window"]), row["moment"]) for row in own}
        for blow in undisturbed.blows if name in every else ():
            if (str(blow.window), blow.moment) not in done:
                one(undisturbed, blow, 1)
    return rows


def read(path: Path) -> list[dict[str, str]]:
    """A table; empty where it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> None:
    """Write a table."""
    part = path.with_name(f"{path.name}.part")
    with part.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


def cluster(root: Path) -> tuple[list[subprocess.Popen], str]:
    """A Dask scheduler and two workers on this machine, and the scheduler's address."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}

    def start(name: str, *words: str) -> tuple[subprocess.Popen, Path]:
        log = root / f"{name}.log"
        words = (sys.executable, "-m", f"distributed.cli.dask_{name.split('-')[0]}", *words, "--no-dashboard")
        with log.open("w") as file:
            return subprocess.Popen(words, stderr=file, stdout=file, env=env, cwd=root), log

    def said(log: Path, words: str) -> str:
        for _ in range(600):
            if found := [line for line in log.read_text().splitlines() if words in line]:
                return found[0].split()[-1]
            time.sleep(0.1)
        raise RuntimeError(log.read_text())

    host, log = start("scheduler", "--host", "127.0.0.1", "--port", "0")
    address = said(log, "Scheduler at:")
    workers = [start(f"worker-{place}", address, "--nthreads", "1") for place in range(2)]
    for _, log in workers:
        said(log, "Registered to:")
    return [host, *(process for process, _ in workers)], address


def main() -> None:
    """Run what is missing, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="at a moment; half as many are in windows besides")
    parser.add_argument("--every-window", nargs="*", default=[], metavar="COMMAND", help="killed in each window, too")
    parser.add_argument("--commands", nargs="+", default=["infer", "compare", "grid", "train", "r2s2r", "dask"])
    parser.add_argument("--adversities", nargs="*", default=OFF_ROUTE, metavar="COMMAND", help="those that meet them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/reliability"), help="folders of the trials")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/reliability"))
    arguments = parser.parse_args()
    root, out = arguments.work.absolute(), arguments.out.absolute()
    for folder in (root, out):
        folder.mkdir(parents=True, exist_ok=True)
    processes, address = cluster(root) if "dask" in arguments.commands else ([], "")
    try:
        known = commands(address)
        undisturbed = [Undisturbed(known[name], root) for name in arguments.commands]
        for one in undisturbed:
            print(f"{one.command.name}: {len(one.ended.windows)} windows, {one.ended.seconds:.1f} s", flush=True)
        if arguments.adversities:
            found = [row for row in read(out / "adversities.csv") if row["command"] not in arguments.adversities]
            for one in undisturbed:
                found += adversities.all_of(one, root) if one.command.name in arguments.adversities else []
            write(out / "adversities.csv", found, adversities.COLUMNS)
        rows = kills(undisturbed, arguments.kills, arguments.every_window, arguments.seed, out, root)
    finally:
        for process in processes:
            process.terminate()
    counted = collections.Counter((row["command"], row["how"], row["result"] == "same bits") for row in rows)
    config = {
        "experiment": "reliability",
        "seed": arguments.seed,
        "kills": [
            {"command": name, "how": how, "same_bits": same, "number": number}
            for (name, how, same), number in sorted(counted.items())
        ],
        "undisturbed": {
            one.command.name: {
                "windows": len(one.ended.windows),
                "moments": len(one.blows),
                "seconds": round(one.ended.seconds, 1),
                "words": [word for word in one.command.start if word != address],
            }
            for one in undisturbed
        },
        "not_compared": {suffix: list(names) for suffix, names in LEFT_OUT.items()},
        **{name: value for name, value in environment().items() if name != "command_line"},
    }
    atomic.write_json(out / "config.json", config)


if __name__ == "__main__":
    main()
