"""Quality of posteriors on the field's benchmark: C2ST against its reference posteriors.

    python -m experiments.sbibm --tasks two_moons --methods npe apt --simulations 1000 --out experiments/results/sbibm

Every published observation is a lane of one compiled program. Results are added to OUT/table.csv, one line an
observation; a line that is there is not computed again. Needs the `bench` extra (scikit-learn).
"""

import argparse
import csv
import json
import time
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from experiments.sbibm.c2st import c2st
from experiments.sbibm.tasks import TASKS, observation, reference
from jaxlfi import bayessim, compile_cache
from jaxlfi.bayessim import Settings
from jaxlfi.belief import rejected
from jaxlfi.describe import settings_to_json
from jaxlfi.heuristics import Fixed
from jaxlfi.posterior import draws_within
from jaxlfi.presets import FLOW, METHODS
from jaxlfi.run_store import environment

OBSERVATIONS = (1, 2, 3)
ROUNDS = 10
COLUMNS = ("task", "method", "simulations", "observation", "c2st", "inside", "seconds")
DRAWS = 10_000


def mdn(settings: Settings) -> Settings:
    """The single-round method with a mixture density network of ten Gaussians in place of the flow."""
    return settings.replace(estimator=settings.estimator.replace(family="mdn", components=10))


VARIANTS = {
    "npe": METHODS["npe"],
    "apt": METHODS["apt"],
    "npe-mdn": lambda settings: mdn(METHODS["npe"](settings)),
    "apt-mdn": lambda settings: mdn(METHODS["apt"](settings)),
}


def settings_of(method: str, simulations: int) -> Settings:
    """A method at a budget; sequential ones divide it by ten rounds."""
    each = simulations // ROUNDS
    return VARIANTS[method](Settings(estimator=FLOW, rounds=ROUNDS, additions=each, attempts=each)).check()


def posterior_draws(task_name: str, settings: Settings, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Draws of the posterior of every observation, the share of q inside the box, and seconds without compiling."""
    task = TASKS[task_name]()
    box = task.support()
    x = np.stack([observation(task_name, number) for number in OBSERVATIONS]).astype(np.float32)

    def one(key, x):
        key_run, key_draw = jax.random.split(key)
        state, _ = bayessim.run(key_run, task, settings, Fixed(), x, box)
        if settings.estimator.is_flow:
            return draws_within(key_draw, settings.estimator, state.network, x, state.feasible, box, DRAWS)
        draws = rejected(key_draw, state.belief, DRAWS)
        return draws, state.belief.support.contains(state.belief.mixture.sample(key_draw, DRAWS)).mean()

    keys = jax.random.split(jax.random.key(seed), len(OBSERVATIONS))
    program = jax.jit(jax.vmap(one)).lower(keys, x).compile()
    start = time.perf_counter()
    draws, inside = jax.block_until_ready(program(keys, x))
    return np.asarray(draws), np.asarray(inside), time.perf_counter() - start


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--methods", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--simulations", nargs="+", type=int, default=[1000, 10_000])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/sbibm"))
    arguments = parser.parse_args()
    compile_cache.enable()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path, console = arguments.out / "table.csv", Console()
    lines = list(csv.DictReader(path.open())) if path.exists() else []
    for simulations in arguments.simulations:
        for task in arguments.tasks:
            for method in arguments.methods:
                what = {"task": task, "method": method, "simulations": str(simulations)}
                if any(what.items() <= line.items() for line in lines):
                    continue
                settings = settings_of(method, simulations)
                with console.status(f"{task}, {method}, {simulations} simulations"):
                    draws, inside, seconds = posterior_draws(task, settings, arguments.seed)
                    for i, number in enumerate(OBSERVATIONS):
                        value = c2st(reference(task, number), draws[i])
                        figures = (number, f"{value:.4f}", f"{inside[i]:.4f}", f"{seconds / len(OBSERVATIONS):.1f}")
                        lines.append(what | dict(zip(COLUMNS[3:], figures, strict=True)))
                with path.open("w", newline="") as file:
                    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                    writer.writeheader()
                    writer.writerows(lines)
                config = {"settings": settings_to_json(settings), "seed": arguments.seed, **environment()}
                (arguments.out / f"{task}_{method}_{simulations}.json").write_text(json.dumps(config, indent=2) + "\n")
                own = [float(line["c2st"]) for line in lines if what.items() <= line.items()]
                console.print(
                    f"{task}, {method}, {simulations}: C2ST {np.mean(own):.3f} +- {np.std(own, ddof=1):.3f}, "
                    f"{seconds / len(OBSERVATIONS):.1f} s an observation"
                )


if __name__ == "__main__":
    main()
