"""Which two whips identify a DLO's length and stiffness best, and are they better than the exploratory actions?

    python -m experiments.whip_design --out experiments/results/design-whip

`jaxlfi.design` chooses two whips at once that leave the stack of cubes alone, for a DLO of which only Theta_0 is known.
They are compared with two of the exploratory actions in use, those of seeds 0 and 1, on truths drawn from Theta_0. The
physics is simulated, so the likelihood of keypoints is known, and the posterior of two recordings is found by
importance sampling: the study measures the choice of whips, not a network. Proposals are normal, half as wide again as
the posterior of a linear response, whose derivatives are those at the truth; a distant second mode would be missed.
Each part is a file, and is not made again.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

import jax
import numpy as np

from jaxlfi.design import choosing
from jaxlfi.design.fisher import FisherRater
from jaxlfi.design.regions import POOL, region
from jaxlfi.envs.whip import designed
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.real2sim import task as load_task
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.tasks.experiments import single
from jaxlfi.tasks.task import Task

SEED = 31_400
"""Seed of the search, truths and recordings."""
TRUTHS = 20
RATED = 24
"""Number of designs that are rated for each of the two whips."""
DRAWS = 8
"""Number of draws from Theta_0 that a design's information is averaged over."""
POINTS = 256
"""Number of proposals in importance sampling."""
WIDER = 1.5
"""Width of proposals, relative to the posterior of a linear response."""
STEP = np.array([1.0, 0.05])
"""Steps of finite differences, in mm and ln E."""
CHECKED = 128
"""Number of draws from Theta_0 that check whether the chosen whips leave the stack alone."""
ARMS = {"fixed": "exploratory actions 0 and 1", "chosen": "chosen"}


def chosen(task: Task, seed: int, rated: int) -> dict[str, np.ndarray]:
    """Two whips for Theta_0, and how often they fail there: designs [2, K], actions [2, 16, 2]."""
    one, box = single(task), task.support("initial")
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    rng, began = np.random.default_rng(seed), time.monotonic()
    everywhere = region(1.0, rng.uniform(low, high, (POOL, 2)))
    rater = FisherRater(jax.random.key(seed), one, (everywhere,), draws=DRAWS)
    said = lambda designs: print(f"{designs} designs rated", flush=True)
    found = choosing.choose(rater, rng, count=2, rated=rated, advanced=said)
    seconds = time.monotonic() - began
    whipping, designs = one.simulate.function.function, found.batch.designs
    theta = np.asarray(task.space.to_natural(rng.uniform(low, high, (CHECKED, 2))))
    outcome = [whipping(rng, theta, design)[1] for design in designs]
    return {
        "designs": designs,
        "actions": np.stack([designed.actions(design) for design in designs]),
        "bits": np.array(found.together[0]),
        "nominal_bits": found.rated.value[0],
        "spread_bits": found.rated.value[1 : found.spread],
        "outcome": np.stack(outcome),
        "seconds": np.array(seconds),
    }


def clean(task: Task, whips: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Keypoints [N, numbers] in units of their noise under whips [W, 16, 2], for theta [N, 2] in inference space."""
    whipping = single(task).simulate.function.function
    natural, noise = np.asarray(task.space.to_natural(theta)), designed.noise_of(whipping.detector)
    each = [whipping.played(natural, np.asarray(whip)) / noise for whip in whips]
    return np.concatenate([one.reshape(len(theta), -1) for one in each], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class Known:
    """Posteriors of measurements with standard normal noise, by importance sampling.

    Attributes:
        clean: function that gives the measurements without noise for parameters [N, 2], shape [N, numbers].
        low, high: bounds of the uniform prior, shape [2].
    """

    clean: Callable[[np.ndarray], np.ndarray]
    low: np.ndarray
    high: np.ndarray

    def posterior(self, rng: np.random.Generator, truth: np.ndarray) -> dict[str, np.ndarray]:
        """The posterior of a recording at a truth: mean, standard deviation, coverage, effective sample size."""
        offsets = np.concatenate([np.zeros((1, 2)), np.diag(STEP), -np.diag(STEP)])
        y = self.clean(truth + offsets)
        recorded = y[0] + rng.standard_normal(y.shape[1])
        slope = (y[1:3] - y[3:5]) / (2 * STEP[:, None])
        linear = np.linalg.inv(slope @ slope.T)
        centre, factor = truth + linear @ slope @ (recorded - y[0]), WIDER * np.linalg.cholesky(linear)
        theta = _within(rng, centre, factor, self.low, self.high)
        proposal = -0.5 * np.sum(np.linalg.solve(factor, (theta - centre).T) ** 2, axis=0)
        misfit = np.sum((self.clean(theta) - recorded) ** 2, axis=1)
        log = -0.5 * np.where(np.isnan(misfit), np.inf, misfit) - proposal  # an unstable simulation has likelihood 0
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        mean = weight @ theta
        interval = np.stack([_quantiles(theta[:, d], weight) for d in range(2)])
        return {
            "mean": mean,
            "sd": np.sqrt(weight @ (theta - mean) ** 2),
            "held": (interval[:, 0] < truth) & (truth < interval[:, 1]),
            "effective": 1 / np.sum(weight**2),
            "fisher_sd": np.sqrt(np.diagonal(linear)),
        }


def _within(rng, mean, factor, low, high) -> np.ndarray:
    kept = np.empty((0, 2))
    while len(kept) < POINTS:
        tried = mean + rng.standard_normal((POINTS, 2)) @ factor.T
        kept = np.concatenate([kept, tried[((tried > low) & (tried < high)).all(axis=1)]])
    return kept[:POINTS]


def _quantiles(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    order = np.argsort(values)
    return np.interp([0.05, 0.95], np.cumsum(weight[order]) - 0.5 * weight[order], values[order])


def truths(task: Task, count: int, seed: int) -> np.ndarray:
    """Truths, uniform over Theta_0 in length and ln E, shape [count, 2]."""
    box = task.support("initial")
    return np.random.default_rng(seed).uniform(np.asarray(box.low), np.asarray(box.high), (count, 2))


def measured(task: Task, whips: np.ndarray, count: int, seed: int, name: str) -> dict[str, np.ndarray]:
    """Posteriors of all truths under two whips."""
    box, rows = task.support("initial"), []
    known = Known(functools.partial(clean, task, whips), np.asarray(box.low, float), np.asarray(box.high, float))
    everything = truths(task, count, seed)
    for number, truth in enumerate(everything):
        rows.append(known.posterior(np.random.default_rng([seed, number]), truth))
        print(f"{name}: truth {number + 1} of {count}, sd {rows[-1]['sd'].round(4)}", flush=True)
    return {"theta": everything} | {key: np.array([row[key] for row in rows]) for key in rows[0]}


def outcomes(task: Task, designs: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Failure codes of simulations at each truth, 0 for success, by the whips' designs [2, K], shape [2, truths]."""
    whipping, natural = single(task).simulate.function.function, np.asarray(task.space.to_natural(theta))
    return np.stack([whipping(np.random.default_rng(0), natural, design)[1] for design in designs])


def table(folder: Path) -> str:
    """The study's table, from the arrays."""
    kept = {name: np.load(folder / f"{name}.npz") for name in ARMS}
    lines = ["| two whips | sd of length [mm] | sd of ln E | against fixed | truths in 90 % intervals |"]
    lines.append("|---|---|---|---|---|")
    middle = lambda values: np.exp(np.mean(np.log(values), axis=0))
    alone = (np.load(folder / "outcomes.npz")["outcome"] == 0).all(axis=0)
    for name, title, rows in [
        *((name, title, np.ones_like(alone)) for name, title in ARMS.items()),
        ("chosen", "chosen, where the stack is not touched", alone),
    ]:
        sd, held = kept[name]["sd"][rows], kept[name]["held"][rows]
        ratio = middle(sd / kept["fixed"]["sd"][rows])
        against = "–" if name == "fixed" else f"{ratio[0]:.2f}, {ratio[1]:.2f} times"
        inside = f"{held[:, 0].sum()}, {held[:, 1].sum()} of {len(held)}"
        lines.append(f"| {title} | {middle(sd)[0]:.2f} | {middle(sd)[1]:.4f} | {against} | {inside} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Choose, measure, and write arrays and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--truths", type=int, default=TRUTHS, metavar="N")
    parser.add_argument("--rated", type=int, default=RATED, metavar="N")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    task = load_task(engine="native")
    path = given.out / "design.npz"
    if not path.exists():
        files.write_arrays(path, chosen(task, given.seed, given.rated))
    pair = files.read_arrays(path)["actions"]
    whips = {"fixed": np.stack([np.asarray(exploratory_actions(seed)) for seed in (0, 1)]), "chosen": pair}
    for name, own in whips.items():
        path = given.out / f"{name}.npz"
        if not path.exists():
            files.write_arrays(path, measured(task, own, given.truths, given.seed, name))
    path = given.out / "outcomes.npz"
    if not path.exists():
        designs, theta = files.read_arrays(given.out / "design.npz")["designs"], truths(task, given.truths, given.seed)
        files.write_arrays(path, {"outcome": outcomes(task, designs, theta)})
    config = {"truths": given.truths, "rated": given.rated, "seed": given.seed, "points": POINTS} | environment()
    files.write_json(given.out / "config.json", config)
    files.write_bytes(given.out / "table.md", table(given.out).encode())
    print(table(given.out))


if __name__ == "__main__":
    main()
