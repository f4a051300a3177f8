"""Predicted times of the main programs on one accelerator: `python -m experiments.benchmarks.accelerators`.

Operations and bytes are those of XLA's cost analysis, for the body of every loop times its steps
(`experiments.benchmarks.loops`), compiled here for the CPU, whose fusions are not an accelerator's. A step of a loop
takes as long as its operations, its bytes, or its kernel launches, whichever is longest. All are predictions: nothing
was run on an accelerator.

    --count GROUP ...    count again, some minutes each; by default the table is made from the saved counts
"""

import argparse
import dataclasses
import functools
import json
import unittest.mock
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks import main_programs
from experiments.benchmarks.loops import Part, parts
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.envs import lotka_volterra
from jaxlfi.io.provenance import environment
from jaxlfi.tasks.simulation import simulate

SAVED = Path(__file__).parents[1] / "results/accelerators/programs.json"
OPERATIONS, BYTES = 67e12, 3.35e12
"""Operations and bytes per second of one H100 SXM, as published by NVIDIA: single precision without tensor cores."""
LAUNCH = 5e-6
"""Seconds from one kernel to the next: assumed, not published."""
ROUND = 10
"""Index of the round, from 1, whose training on all simulations so far is counted."""
SOLVER = 2
"""Number of iterations of MJX's solver in each step of the arm: assumed."""


GROUPS = ("lotka-volterra", "mg1", "training", "mjx", "ppo")
"""Groups of `main_programs` that are counted; the whole round of a grid would take a quarter of an hour to compile."""


def gillespie_steps() -> tuple[float, float]:
    """Steps of the loops in a round's simulations, counted in a run: phases, and steps of recording in each phase."""
    made, loop = [0, 0], jax.lax.while_loop
    depth = [0]

    def counting(running: Any, body: Any, state: Any) -> Any:
        place = depth[0]

        def counted(state):
            jax.debug.callback(functools.partial(_tick, made, place))
            depth[0] += 1
            try:
                return body(state)
            finally:
                depth[0] -= 1

        return loop(running, counted, state)

    task = lotka_volterra.task()
    theta = task.support("misspecified").sample(jax.random.key(1), QUICK.simulation_budget)
    with unittest.mock.patch.object(jax.lax, "while_loop", counting):
        jax.block_until_ready(jax.jit(lambda key: simulate(key, task, theta))(jax.random.key(0)))
    jax.effects_barrier()
    return made[0], made[1] / made[0]


def _tick(made: list[int], place: int) -> None:
    made[place] += 1


def counted(group: str) -> dict[str, list[dict[str, float]]]:
    """The parts of a group's programs, by the programs' names."""
    epochs, size = QUICK.estimator.epochs, ROUND * QUICK.simulations_per_round
    training = epochs, -(-size // QUICK.estimator.batch_size)
    phases = gillespie_steps() if group == "lotka-volterra" else ()
    unknown: dict[str, tuple[float, ...]] = {
        "train": training,
        "simulate": phases,
        "compare": phases,
        "arm": (SOLVER,),
        "MJX": (SOLVER,),
    }
    return {
        one.name: [
            dataclasses.asdict(part)
            for part in parts(one.function, one.arguments, unknown.get(one.name.split()[-1], ()))
        ]
        for one in main_programs.MAKERS[group]()
    }


def predicted(found: Iterable[Part]) -> dict[str, float]:
    """Seconds of a program by what limits its parts, and its totals."""
    seconds = dict.fromkeys(("compute", "memory", "launches"), 0.0)
    totals = dict.fromkeys(("steps", "operations", "bytes", "kernels"), 0.0)
    for part in found:
        each = {
            "compute": part.operations / OPERATIONS,
            "memory": part.bytes / BYTES,
            "launches": part.kernels * LAUNCH,
        }
        longest = max(each, key=lambda name: each[name])
        seconds[longest] += part.steps * each[longest]
        for name in ("operations", "bytes", "kernels"):
            totals[name] += part.steps * getattr(part, name)
        totals["steps"] += part.steps
    return seconds | totals


def table(saved: dict[str, Any]) -> str:
    """The table of the page."""
    lines = [
        "| program | sequential steps | GFLOP | GB | kernels | predicted, s | limited by | without launches, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, found in saved["programs"].items():
        one = predicted(Part(**part) for part in found)
        waits = {name: one[name] for name in ("compute", "memory", "launches")}
        longest, total = max(waits, key=lambda name: waits[name]), sum(waits.values())
        bare = max(one["operations"] / OPERATIONS, one["bytes"] / BYTES)
        cells = [
            f"{one['steps']:,.0f}",
            f"{one['operations'] / 1e9:,.3g}",
            f"{one['bytes'] / 1e9:,.3g}",
            f"{one['kernels']:,.0f}",
            f"{total:.2g}",
            f"{longest}, {waits[longest] / total:.0%}",
            f"{bare:.2g}",
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Count the requested groups, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", nargs="+", default=[], choices=GROUPS, help="programs to count again, and save")
    for group in parser.parse_args().count:
        saved = json.loads(SAVED.read_text()) if SAVED.exists() else {"programs": {}}
        saved = {"programs": saved["programs"] | counted(group), **environment()}
        SAVED.parent.mkdir(parents=True, exist_ok=True)
        SAVED.write_text(json.dumps(saved, indent=1) + "\n")
    print(table(json.loads(SAVED.read_text())))


if __name__ == "__main__":
    main()
