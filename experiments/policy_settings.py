"""Settings of PPO on the whipping task, one changed at a time; all settings and seeds train side by side.

python -m experiments.policy_settings --domain runs/dlo-0 --out experiments/results/policies/settings-dlo-0
"""

import argparse
import csv
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxlfi.cli.domains import domain
from jaxlfi.io import files
from jaxlfi.io.progress import RoundProgress
from jaxlfi.rl import ppo, registry
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.settings import PPO

BASE = PPO(learning_rate=5e-4, entropy=0.01, initial_deviation=0.6, minibatches=12)
"""The first guess, from which one setting is changed at a time."""
CHANGES: dict[str, dict[str, float]] = {
    "base": {},
    "discount 0.95": {"discount": 0.95},
    "discount 0.9": {"discount": 0.9},
    "deviation 1": {"initial_deviation": 1.0},
    "learning rate 1.5e-3": {"learning_rate": 1.5e-3},
    "discount 0.95, deviation 1": {"discount": 0.95, "initial_deviation": 1.0},
}
FIRST_SEED = 1000
"""Seeds from here on are for choosing settings, and are reported nowhere else."""
HELD_OUT = 64
CHUNK = 8


def main() -> None:
    """Train, evaluate, and write the table."""
    arguments = parser().parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    environment = registry.load("whip")
    name, draw = domain(environment, arguments.domain)
    cases = [(label, seed) for label in CHANGES for seed in range(FIRST_SEED, FIRST_SEED + arguments.seeds)]
    settings = [BASE.replace(total_steps=arguments.steps, **CHANGES[label]) for label, _ in cases]
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *settings)
    keys = [jax.random.split(jax.random.key(seed), 4) for _, seed in cases]
    trained = Domain(jnp.stack([draw(key[0], BASE.environments).theta for key in keys]))
    held_out = Domain(jnp.stack([draw(key[1], HELD_OUT).theta for key in keys]))

    start = lambda key, settings, points: ppo.init(key, environment, settings, points)
    state = jax.jit(jax.vmap(start))(jnp.stack([key[2] for key in keys]), stacked, trained)
    some = lambda settings, state: ppo.train(environment, settings, state, CHUNK)
    advance = jax.jit(jax.vmap(some, out_axes=(0, 1)), donate_argnums=1)
    returns, chunks = [], -(-settings[0].updates // CHUNK)
    with RoundProgress(Console(), chunks, 0, f"{len(cases)} trainings", unit="chunk") as progress:
        for _ in range(chunks):
            state, made = advance(stacked, state)
            returns.append(np.asarray(made.value))
            progress.advance(1, f", return {np.nanmean(returns[-1]):.2f}")

    def fares(key, settings, params, points):
        return evaluate(key, environment, ppo.deterministic(environment, settings, params), points)

    outcomes = jax.device_get(
        jax.jit(jax.vmap(fares))(jnp.stack([key[3] for key in keys]), stacked, state.params, held_out)
    )
    files.write_arrays(
        arguments.out / "curves.npz",
        {
            "value": np.concatenate(returns),
            "returns": outcomes.value,
            "settings": np.asarray([one for one, _ in cases]),
        },
    )
    write(arguments.out / "table.csv", cases, outcomes.value.mean(axis=1), outcomes.facts["clean_hit"].mean(axis=1))
    show(name, arguments, cases, outcomes.value.mean(axis=1))


def write(path: Path, cases, returns: np.ndarray, clean: np.ndarray) -> None:
    """A row for each training."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["settings", "seed", "return", "clean_hit"])
        for (label, seed), value, rate in zip(cases, returns, clean, strict=True):
            writer.writerow([label, seed, f"{value:.4f}", f"{rate:.4f}"])


def show(name: str, arguments: argparse.Namespace, cases, returns: np.ndarray) -> None:
    """The mean over seeds, and all of them."""
    table = Table("settings", "mean return", "of each seed", title=f"{name}, {arguments.steps} steps")
    for label in CHANGES:
        own = np.array([value for (other, _), value in zip(cases, returns, strict=True) if other == label])
        table.add_row(label, f"{own.mean():.2f}", "  ".join(f"{value:.2f}" for value in own))
    Console(width=100).print(table)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--domain", default="uniform", help="as of jaxlfi train (default: uniform)")
    top.add_argument("--seeds", type=int, default=4, help=f"from {FIRST_SEED} on (default: 4)")
    top.add_argument("--steps", type=int, default=36_000, help="of each training (default: 36000)")
    top.add_argument("--out", type=Path, required=True, help="folder of the results")
    return top


if __name__ == "__main__":
    main()
