"""PPO settings on the whipping task, changed one at a time; those that differ only in numbers train in parallel.

python -m experiments.policy_settings --domain runs/dlo-0 --out OUT
python -m experiments.policy_settings --around first --domain runs/dlo-0 --out OUT
"""

import argparse
import collections
import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxlfi.cli.domains import domain
from jaxlfi.io import files
from jaxlfi.io.progress import RoundProgress
from jaxlfi.registry import ENVIRONMENTS
from jaxlfi.rl import ppo
from jaxlfi.rl.domains import POOL, Domain
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.settings import PPO

AROUND: dict[str, tuple[PPO, dict[str, dict[str, float]]]] = {
    "first": (
        PPO(learning_rate=5e-4, entropy=0.01, initial_deviation=0.6, minibatches=12),
        {
            "base": {},
            "discount 0.95": {"discount": 0.95},
            "discount 0.9": {"discount": 0.9},
            "deviation 1": {"initial_deviation": 1.0},
            "learning rate 1.5e-3": {"learning_rate": 1.5e-3},
            "discount 0.95, deviation 1": {"discount": 0.95, "initial_deviation": 1.0},
        },
    ),
    "quick": (
        PPO(learning_rate=5e-4, entropy=0.01, minibatches=12),
        {
            "base": {},
            "entropy 0": {"entropy": 0.0},
            "learning rate 3e-4": {"learning_rate": 3e-4},
            "annealed": {"annealing": 1.0},
            "minibatches of 64": {"minibatches": 3, "segments": 4},
            "unroll 8": {"segments": 2, "unroll": 8},
            "24 environments": {"minibatches": 24, "environments": 24},
            "redrawn": {"redrawn": True},
        },
    ),
}
"""Base settings and their changes, by name: first a guess, then `quick`, which resulted from that."""
FIRST_SEED = 1000
"""First of the seeds for choosing settings, which are reported nowhere else."""
HELD_OUT = 64
CHUNK = 8


def main() -> None:
    """Train, evaluate, and write the table."""
    arguments = parser().parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    base, changes = AROUND[arguments.around]
    cases = [(label, seed) for label in changes for seed in range(FIRST_SEED, FIRST_SEED + arguments.seeds)]
    settings = [base.replace(total_steps=arguments.steps, **changes[label]) for label, _ in cases]
    alike = collections.defaultdict(list)
    for row, one in enumerate(settings):
        alike[jax.tree.structure(one)].append(row)
    environment = ENVIRONMENTS.load("whip")
    name, draw = domain(environment, arguments.domain)

    curves, table = {}, {}
    chunks = sum(-(-settings[rows[0]].updates // CHUNK) for rows in alike.values())
    with RoundProgress(Console(), chunks, 0, f"{len(cases)} trainings", unit="chunk") as progress:
        for rows in alike.values():
            seeds = [cases[row][1] for row in rows]
            values, outcomes = side_by_side(environment, draw, [settings[row] for row in rows], seeds, progress)
            for i, row in enumerate(rows):
                label, seed = cases[row]
                curves[f"{label}, {seed}"] = values[:, i]
                table[cases[row]] = outcomes.value[i].mean(), outcomes.facts["clean_hit"][i].mean()
            files.write_arrays(arguments.out / "curves.npz", curves)
            write(arguments.out / "table.csv", table)
    show(f"{name}, {arguments.steps} steps", list(changes), table)


def side_by_side(environment, draw, settings: Sequence[PPO], seeds: Sequence[int], progress: RoundProgress):
    """Run trainings as one program, with settings that differ only in numbers.

    Args:
        environment: the environment to train on.
        draw: function that draws points of the domain, from a key and their number.
        settings: settings of each training.
        seeds: seed of each training.
        progress: progress bar, advanced by a step for every `CHUNK` updates.

    Returns:
        Mean returns of the updates, shape [updates, trainings], and the outcomes of their policies' episodes on
        held-out points of the domain, shape [trainings, HELD_OUT].
    """
    first = settings[0]
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(one) for one in leaves]), *settings)
    keys = jax.vmap(lambda seed: jax.random.split(jax.random.key(seed), 4))(jnp.asarray(seeds))
    points = POOL if first.redrawn else first.environments
    domains_of = lambda index, number: Domain(jnp.stack([draw(key[index], number).theta for key in keys]))

    start = lambda key, settings, points: ppo.init(key, environment, settings, points)
    state = jax.jit(jax.vmap(start))(keys[:, 2], stacked, domains_of(0, points))
    some = lambda settings, state: ppo.train(environment, settings, state, CHUNK)
    advance = jax.jit(jax.vmap(some, out_axes=(0, 1)), donate_argnums=1)
    values = []
    for _ in range(-(-first.updates // CHUNK)):
        state, made = advance(stacked, state)
        values.append(np.asarray(made.value))
        progress.advance(1, f", return {np.nanmean(values[-1]):.2f}")

    def fares(key, settings, params, points):
        return evaluate(key, environment, ppo.deterministic(environment, settings, params), points)

    outcomes = jax.jit(jax.vmap(fares))(keys[:, 3], stacked, state.params, domains_of(1, HELD_OUT))
    return np.concatenate(values), jax.device_get(outcomes)


def write(path: Path, table: Mapping[tuple[str, int], tuple[float, float]]) -> None:
    """Write a row for each training."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["settings", "seed", "return", "clean_hit"])
        for (label, seed), (value, rate) in table.items():
            writer.writerow([label, seed, f"{value:.4f}", f"{rate:.4f}"])


def show(title: str, labels: Sequence[str], table: Mapping[tuple[str, int], tuple[float, float]]) -> None:
    """Print the mean return over seeds, and that of each seed."""
    shown = Table("settings", "mean return", "of each seed", title=title)
    for label in labels:
        own = [value for (other, _), (value, _) in table.items() if other == label]
        shown.add_row(label, f"{np.mean(own):.2f}", "  ".join(f"{value:.2f}" for value in own))
    Console(width=100).print(shown)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--around", choices=list(AROUND), default="quick", help="settings to change (default: quick)")
    top.add_argument("--domain", default="uniform", help="as of jaxlfi train (default: uniform)")
    top.add_argument("--seeds", type=int, default=4, help=f"from {FIRST_SEED} on (default: 4)")
    top.add_argument("--steps", type=int, default=36_000, help="of each training (default: 36000)")
    top.add_argument("--out", type=Path, required=True, help="folder of the results")
    return top


if __name__ == "__main__":
    main()
