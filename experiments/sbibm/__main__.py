"""Quality of posteriors on the field's benchmark: C2ST against its reference posteriors.

    python -m experiments.sbibm --tasks two_moons --methods npe apt --simulations 1000 --out experiments/results/sbibm

All observations of a task are inferred as one batch, in one compiled program. Results are added to OUT/table.csv, one
line per observation; existing lines are not computed again, and draws are kept in OUT/draws. The classifier takes
longer than inference, minutes per observation in ten dimensions. Needs the `bench` extra (scikit-learn).
"""

import argparse
import csv
import io
import itertools
import json
import time
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from experiments.sbibm.c2st import c2st
from experiments.sbibm.tasks import TASKS, observation, reference
from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.batch import posterior_after
from jaxlfi.bayessim.presets import FLOW, METHODS
from jaxlfi.bayessim.settings import Settings
from jaxlfi.estimators.base import converted
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.heuristics import Fixed
from jaxlfi.io import compile_cache
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment
from jaxlfi.runs.describe import settings_to_json

OBSERVATIONS = (1, 2, 3)
ROUNDS = 10
COLUMNS = ("task", "method", "simulations", "observation", "c2st", "inside", "seconds")
DRAWS = 10_000


def mdn(settings: Settings) -> Settings:
    """The method with mixture networks of ten Gaussians in place of flows: many, for curved posteriors."""
    return settings.replace(estimator=converted(settings.estimator, MixtureNetwork, {"components": 10}))


def gaussian(settings: Settings) -> Settings:
    """The method with eight small networks of one Gaussian each, for posteriors in many dimensions."""
    one = {"components": 1, "hidden": (32,), "activation": "tanh", "ensemble_size": 8, "learning_rate": 2e-3}
    return settings.replace(estimator=converted(settings.estimator, MixtureNetwork, one))


NETWORKS = {"": lambda settings: settings, "-mdn": mdn, "-gaussian": gaussian}
VARIANTS = {
    method + suffix: (METHODS[method], network) for suffix, network in NETWORKS.items() for method in ("npe", "apt")
}


def settings_of(method: str, simulations: int) -> Settings:
    """A method's settings at a budget, which sequential methods divide among ten rounds."""
    each = simulations // ROUNDS
    divided, network = VARIANTS[method]
    return network(
        divided(Settings(estimator=FLOW, rounds=ROUNDS, simulations_per_round=each, simulation_budget=each))
    ).check()


def posterior_draws(task_name: str, settings: Settings, seed: int) -> dict[str, np.ndarray]:
    """Posterior `draws` of every observation, the mass of q `inside` the box, and `seconds` per observation."""
    task = TASKS[task_name]()
    box = task.support()
    x = np.stack([observation(task_name, number) for number in OBSERVATIONS]).astype(np.float32)

    def one(key, x):
        key_run, key_draw = jax.random.split(key)
        state, _ = algorithm.run(key_run, task, settings, Fixed(), x, box)
        posterior = posterior_after(settings.correction, state.reported, state.network, x)
        return posterior.sample(key_draw, DRAWS, space="inference"), posterior.mass_inside

    keys = jax.random.split(jax.random.key(seed), len(OBSERVATIONS))
    program = jax.jit(jax.vmap(one)).lower(keys, x).compile()
    start = time.perf_counter()
    draws, inside = jax.block_until_ready(program(keys, x))
    seconds = (time.perf_counter() - start) / len(OBSERVATIONS)
    return {"draws": np.asarray(draws), "inside": np.asarray(inside), "seconds": np.asarray(seconds)}


def kept_draws(out: Path, task: str, method: str, simulations: int, seed: int) -> dict[str, np.ndarray]:
    """The result of `posterior_draws`, from the folder if it is there already.

    Raises:
        SystemExit: if the folder's draws were made with other settings or another seed.
    """
    name, settings = f"{task}_{method}_{simulations}", settings_of(method, simulations)
    path, described = out / "draws" / f"{name}.npz", out / f"{name}.json"
    config = {"settings": settings_to_json(settings), "seed": seed}
    if described.exists():
        before = json.loads(described.read_text())
        if config != {part: before.get(part) for part in config}:
            raise SystemExit(f"{described}: made with other settings or another seed; give another folder as --out")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_json(described, config | environment())
        atomic.write_arrays(path, posterior_draws(task, settings, seed))
    return atomic.read_arrays(path)


def write_table(path: Path, lines: list[dict[str, str]]) -> None:
    """Write the whole table again, so that it is complete whenever the program is stopped."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    atomic.write_bytes(path, stream.getvalue().encode())


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
    path, console = arguments.out / "table.csv", Console()
    lines = list(csv.DictReader(path.open())) if path.exists() else []
    for simulations, task, method in itertools.product(arguments.simulations, arguments.tasks, arguments.methods):
        what = {"task": task, "method": method, "simulations": str(simulations)}
        own = {line["observation"]: line for line in lines if what.items() <= line.items()}
        missing = [i for i, number in enumerate(OBSERVATIONS) if str(number) not in own]
        if not missing:
            continue
        with console.status(f"{task}, {method}, {simulations} simulations: inference"):
            found = kept_draws(arguments.out, task, method, simulations, arguments.seed)
        for i in missing:
            number = str(OBSERVATIONS[i])
            with console.status(f"{task}, {method}, {simulations} simulations: classifier, observation {number}"):
                value = c2st(reference(task, OBSERVATIONS[i]), found["draws"][i])
            figures = (f"{value:.4f}", f"{found['inside'][i]:.4f}", f"{found['seconds']:.1f}")
            own[number] = what | dict(zip(COLUMNS[3:], (number, *figures), strict=True))
            lines.append(own[number])
            write_table(path, lines)
        values = [float(line["c2st"]) for line in own.values()]
        console.print(
            f"{task}, {method}, {simulations}: C2ST {np.mean(values):.3f} +- {np.std(values, ddof=1):.3f}, "
            f"{own['1']['seconds']} s an observation"
        )


if __name__ == "__main__":
    main()
