"""Several observations of the same parameters: ways to combine them into one posterior.

    python -m experiments.trials --task lotka_volterra --seeds 10

Each seed observes the task's truth in several independent trials. Their joint posterior is found

* `moments`, `mean`: by inference on the task of all trials together (`jaxlfi.repeated`), with 1,000 parameter vectors,
  each simulated once for every trial; `moments (same budget)` uses only as many simulations in total as one trial;
* `product`: by inference on each trial alone, and the product of the posteriors; the prior is uniform, and cancels.

All but the one with the same budget simulate trials x 1,000 times. On the linear Gaussian task the exact posterior is
known, and the table has the median standard deviation relative to it.
"""

import argparse
import operator
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from experiments.widths import DRAWS, LOST, TUNING, Cases, final_states, save
from jaxlfi.bayessim.batch import posterior_after
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_algebra import product, reduce
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.heuristics import Fixed
from jaxlfi.io import files as atomic
from jaxlfi.registry import TASKS
from jaxlfi.studies.calibration.repeat import described
from jaxlfi.tasks.observation import simulate_observation
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated

SUPPORT = "ok"
JOINT = {"moments": ("moments", False), "mean": ("mean", False), "moments (same budget)": ("moments", True)}
"""Candidates with joint inference on all trials: the pooling, and whether simulations are divided by the trials."""


def observations(task: Task, first: int, seeds: int, trials: int) -> np.ndarray:
    """Trials at the task's truth: a seed's first n are the same for every n, shape [seeds, trials, ...]."""

    def one(seed: int, trial: int) -> np.ndarray:
        return simulate_observation(jax.random.fold_in(run_keys(key_of(seed)).observe, trial), task)

    return np.stack([[one(first + seed, trial) for trial in range(trials)] for seed in range(seeds)])


def cases_of(task: Task, first: int, observed: np.ndarray) -> Cases:
    """One run per observation [N, ...], all at the task's truth."""
    theta = np.broadcast_to(np.asarray(task.inference.truth, np.float32), (len(observed), task.dim))
    seeds = first + np.arange(len(observed))
    return Cases(seeds, theta, observed, np.asarray(jax.vmap(task.summary)(jnp.asarray(observed))))


def beliefs(task: Task, settings: Settings, cases: Cases, batch: int, console: Console) -> Posterior:
    """The posteriors of all cases, stacked."""
    states, _ = final_states(task, settings, task.support(SUPPORT), Fixed(), cases, batch, console)
    after = lambda state, x: posterior_after(settings.correction, state.reported, state.network, x)
    return jax.vmap(after)(states, cases.x)


def multiplied(each: GaussianMixture) -> GaussianMixture:
    """The product of stacked mixtures, reduced after each factor to the number of components of one mixture."""
    components = each.logits.shape[-1]

    def body(so_far, one):
        return reduce(product(so_far, one)[0], components), None

    first, others = jax.tree.map(lambda leaf: leaf[0], each), jax.tree.map(lambda leaf: leaf[1:], each)
    return jax.lax.scan(body, first, others)[0]


def summarised(task: Task, posteriors: Posterior, first: int) -> dict[str, np.ndarray]:
    """Draws, densities and standard deviations of stacked posteriors, and the densities of the truth."""
    count = posteriors.support.low.shape[0]
    truth = jnp.broadcast_to(task.inference.truth, (count, task.dim))
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(78), first + jnp.arange(count))
    one = jax.jit(jax.vmap(lambda key, truth, posterior: described(key, truth, posterior, DRAWS)))
    return jax.device_get(one(keys, truth, posteriors))


def compare(task: Task, arguments: argparse.Namespace, console: Console) -> None:
    """Run all candidates for all numbers of trials; arrays that are there are kept."""
    settings, first, batch = QUICK.replace(predictive=False), arguments.first_seed, arguments.runs_per_batch
    most = max(arguments.trials)
    observed = observations(task, first, arguments.seeds, most)
    support = task.support(SUPPORT)
    each = None
    for trials in arguments.trials:
        now = observed[:, :trials]
        for name, (pooling, same_budget) in JOINT.items():
            path = arguments.folder / f"{trials}-{name.replace(' (same budget)', '-same-budget')}.npz"
            if path.exists() or (trials == 1 and name != "moments"):
                continue
            joint = repeated(task, trials, pooling)
            fewer = trials if same_budget else 1
            numbers = settings.replace(
                simulations_per_round=settings.simulations_per_round // fewer,
                simulation_budget=settings.simulation_budget // fewer,
            )
            console.print(f"{trials} trials, {name}", highlight=False)
            cases = cases_of(joint, first, now.reshape(len(now), -1, *now.shape[3:]))
            found = summarised(task, beliefs(joint, numbers, cases, batch, console), first)
            save(path, with_exact(task, found, now), numbers)
        path = arguments.folder / f"{trials}-product.npz"
        if path.exists() or trials == 1:
            continue
        if each is None:  # the inferences on single trials serve all numbers of trials
            console.print(f"{most} trials, each alone", highlight=False)
            single = cases_of(task, first, observed.reshape(-1, *observed.shape[2:]))
            alone = beliefs(task, settings, single, batch, console).mixture
            each = jax.tree.map(lambda leaf: leaf.reshape(-1, most, *leaf.shape[1:]), alone)
        mixture = jax.jit(jax.vmap(multiplied))(jax.tree.map(operator.itemgetter(np.s_[:, :trials]), each))
        posteriors = jax.vmap(lambda mixture: truncated(mixture, mixture, support, task.space))(mixture)
        save(path, with_exact(task, summarised(task, posteriors, first), now), settings)
    (arguments.folder / "table.md").write_text(table(arguments.folder))


def with_exact(task: Task, found: dict[str, np.ndarray], observed: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays, the truth and, if they are known, the exact posteriors' means and standard deviations."""
    if task.name == "gaussian_linear":
        exact = [gaussian_linear.posterior(one.mean(axis=0)) for one in observed]
        deviation = [np.sqrt(np.diag(np.asarray(one.covariance)) / observed.shape[1]) for one in exact]
        found = found | {"exact_sd": np.stack(deviation), "exact_mean": np.stack([one.mean for one in exact])}
    return found | {"theta": np.asarray(task.inference.truth)}


def table(folder: Path) -> str:
    """The comparison as Markdown, from the saved arrays."""
    lines = [
        "| trials | candidate | error | lost | 50 % covers it | 90 % | sd / exact sd | shift / exact sd |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for path in sorted(folder.glob("*.npz")):
        trials, _, name = path.stem.partition("-")
        arrays = atomic.read_arrays(path)
        error = np.abs(arrays["draws"] - arrays["theta"]).sum(axis=2).mean(axis=1)
        low, high = bootstrap_interval(error)
        outranked = np.sum(arrays["log_prob"] > arrays["truth_log_prob"][:, None], axis=1)
        held = [f"{np.mean(outranked < level * (DRAWS + 1)):.2f}" for level in (0.5, 0.9)]
        exact = ["", ""]
        if "exact_sd" in arrays:
            ratio = arrays["draws"].std(axis=1) / arrays["exact_sd"]
            distance = np.abs(arrays["draws"].mean(axis=1) - arrays["exact_mean"]) / arrays["exact_sd"]
            exact = [f"{np.median(ratio):.2f}", f"{np.median(distance):.2f}"]
        cells = [trials, name, f"{error.mean():.2f} [{low:.2f}, {high:.2f}] ({np.median(error):.2f})"]
        cells += [f"{int(np.sum(error > LOST))} of {len(error)}", *held, *exact]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="lotka_volterra", help="a task with a known truth, and a support 'ok'")
    parser.add_argument("--trials", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=TUNING, help="0 to report, from 1000 to choose")
    parser.add_argument("--runs-per-batch", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("runs/trials"))
    arguments = parser.parse_args()
    arguments.folder = arguments.out / arguments.task
    arguments.folder.mkdir(parents=True, exist_ok=True)
    compare(TASKS.load(arguments.task), arguments, Console())
    print(table(arguments.folder))


if __name__ == "__main__":
    main()
