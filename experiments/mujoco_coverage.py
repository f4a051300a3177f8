"""Coverage of credible intervals of MuJoCo models, with and without polishing, and their widths beside Metropolis's.

    python -m experiments.mujoco_coverage --recordings 6 --out experiments/results/mujoco-coverage

Examples of examples/mujoco are recorded again with another integrator and with forces that the models lack, for truths
in their right box (`experiments.mujoco_sysid`). The methods on each recording are:

    infer        the posterior of `jaxlfi infer mujoco,config=FILE --heuristic edge --no-polish`; for the first four
                 examples, the one kept by `experiments.mujoco_sysid`, on recordings from which no method has fitted a
                 point
    polish       the same without `--no-polish`; the posterior of `infer` if simulations do not confirm the polished one
    metropolis   random-walk Metropolis on the likelihood that inference simulates: noise, `[discrepancy]`, and
                 `unmodelled_force` to first order; on the first `--chains-of` recordings, uniform over Phi

Chains begin at draws of the polished posterior, and their steps have the covariance of a Gauss-Newton step. Existing
results are kept: a larger --recordings adds the missing ones.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import numpy as np
import scipy.linalg
from rich.progress import track

from experiments import mujoco_sysid
from experiments.mujoco_sysid import DRAWS, folded, load, recordings
from jaxlfi.envs.mujoco import least_squares
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.runs.polishing import STARTS
from jaxlfi.tasks.task import Task

EXAMPLES = ("furuta", "arm", "puck", "finger", "servo", "shuffle")
METHODS = ("infer", "polish", "metropolis")
KNOWN = {"furuta": ("wrong", 20), "arm": ("wrong", 10), "puck": ("wrong", 5), "finger": ("right", 5)}
"""Box of the posteriors of `experiments.mujoco_sysid`, and the first recording without fitted points, by example."""
SYSID = Path(__file__).parent / "results/mujoco-sysid"
FIRST_SEED = 3000
"""First seed of the recordings of other examples, whose truths differ from those that methods were developed on."""
CHAINS, STEPS, DROPPED = 8, 200, 40
"""Metropolis: number of parallel chains, of their steps, and of the first steps, which are dropped as burn-in."""


class Likelihood:
    """The likelihood of a recording, with the noise and the model errors that inference simulates.

    Forces that the model lacks count to first order: their effects are those at one point.
    """

    def __init__(self, task: Task, observed: np.ndarray, point: np.ndarray):
        """Factorise the covariance of the residuals, which are in standard deviations of the noise.

        Args:
            task: task of a MuJoCo model.
            observed: the recording.
            point: a point near the posterior, in inference space, shape [D].
        """
        self.residuals, simulator = least_squares.Residuals(task, observed), simulator_of(task)
        size = int(simulator.there.sum())
        covariance, place = np.eye(size), np.cumsum(simulator.there.ravel()).reshape(simulator.there.shape) - 1
        (times,) = simulator.times
        for signal, process in simulator.discrepancies.items():
            there = simulator.there[:, signal]
            own, when = place[there, signal], times[there]
            lag = np.abs(when[:, None] - when)
            covariance[np.ix_(own, own)] += (process.deviation / self.residuals.noise[signal]) ** 2 * np.exp(
                -lag / process.time
            )
        if simulator.forces is not None:
            by_forces = self.residuals.of_forces(point, simulator.forces)
            covariance += by_forces @ by_forces.T
        self._factor = scipy.linalg.cholesky(covariance, lower=True)

    def whitened(self, rows: np.ndarray) -> np.ndarray:
        """Residuals [..., N] without their correlations."""
        return scipy.linalg.solve_triangular(self._factor, rows.T, lower=True).T

    def __call__(self, coordinates: np.ndarray) -> np.ndarray:
        """Log-likelihoods up to a constant, of points in inference space [N, D]."""
        return -0.5 * np.sum(self.whitened(self.residuals(coordinates)) ** 2, axis=1)

    def covariance(self, point: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Covariance of a Gaussian about a point, no wider than the box along any of its axes, shape [D, D]."""
        jacobian = self.whitened(self.residuals.jacobian(point, low, high).T)
        return np.linalg.inv(jacobian @ jacobian.T + np.diag(12 / (high - low) ** 2))


def metropolis(task: Task, observed: np.ndarray, starts: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Draws of the posterior on Phi, in inference space, by random-walk Metropolis (Metropolis et al. 1953).

    Args:
        task: task of a MuJoCo model.
        observed: the recording.
        starts: starts of the chains, in inference space, shape [CHAINS, D]; steps are scaled at the first.
        seed: seed of the steps.

    Returns:
        `draws` [CHAINS (STEPS - DROPPED), D]; `accepted`, the fraction of steps; `r_hat` [D], of Gelman and Rubin 1992.
    """
    began, rng = time.perf_counter(), np.random.default_rng(seed)
    phi = task.inference.feasible
    low, high = np.asarray(phi.low, float), np.asarray(phi.high, float)
    likelihood = Likelihood(task, observed, starts[0])
    root = np.linalg.cholesky(likelihood.covariance(starts[0], low, high)) * 2.38 / np.sqrt(task.dim)
    at, density, kept, accepted = starts.copy(), likelihood(starts), [], 0.0
    for _ in range(STEPS):
        step = at + rng.standard_normal(at.shape) @ root.T
        inside = ((step >= low) & (step <= high)).all(axis=1)
        proposed = np.where(inside, likelihood(np.clip(step, low, high)), -np.inf)
        better = np.log(rng.uniform(size=len(at))) < proposed - density
        at, density = np.where(better[:, None], step, at), np.where(better, proposed, density)
        accepted += better.mean() / STEPS
        kept.append(at)
    chains = folded(task, np.stack(kept[DROPPED:]))  # [steps, chains, D]
    within, between = chains.var(axis=0, ddof=1).mean(axis=0), chains.mean(axis=0).var(axis=0, ddof=1)
    return {
        "draws": np.concatenate([*np.stack(kept[DROPPED:]).swapaxes(0, 1)]).astype(np.float32),
        "accepted": np.asarray(accepted),
        "r_hat": np.sqrt((len(chains) - 1) / len(chains) + between / within),
        "simulations": np.asarray(likelihood.residuals.simulations),
        "seconds": np.asarray(time.perf_counter() - began),
    }


def polished(task: Task, observed: np.ndarray, draws: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Draws of a polished posterior within Phi, in inference space; the given draws if polishing fails."""
    began = time.perf_counter()
    found = task.polish(task, observed, np.asarray(task.space.to_natural(draws[:STARTS])), task.feasible)
    phi, own = task.inference.feasible, draws
    if found.mixture is not None:
        own = np.asarray(found.mixture.sample(jax.random.key(seed), 4 * DRAWS))
        own = np.resize(own[np.asarray(jax.vmap(phi.contains)(own))][:DRAWS], (DRAWS, task.dim))
    return {
        "draws": own.astype(np.float32),
        "polished": np.asarray(found.mixture is not None),
        "simulations": np.asarray(found.simulations),
        "seconds": np.asarray(time.perf_counter() - began),
    }


def recorded(task: Task, name: str, out: Path, count: int) -> dict[str, np.ndarray]:
    """`count` truths and recordings of an example (`mujoco_sysid.recordings`)."""
    if name not in KNOWN:
        return recordings(out / f"{name}-recordings.npz", task, name, count, FIRST_SEED)
    first = KNOWN[name][1]
    arrays = files.read_arrays(SYSID / f"{name}-recordings.npz")
    return {key: own[first : first + count] for key, own in arrays.items()}


def run(name: str, out: Path, count: int, chains_of: int) -> None:
    """Run all methods on the recordings for which they have no results yet."""
    task = load(name)
    found = recorded(task, name, out, count)
    beside = {method: out / f"{name}-{method}.npz" for method in METHODS}
    known = {method: files.read_arrays(path) if path.exists() else {} for method, path in beside.items()}
    done = {method: len(arrays.get("seconds", ())) for method, arrays in known.items()}

    def add(method: str, arrays: dict[str, np.ndarray]) -> None:
        before = known[method]
        known[method] = {key: np.concatenate([before[key], own]) if before else own for key, own in arrays.items()}
        files.write_arrays(beside[method], known[method])

    if done["infer"] < count and name in KNOWN:
        box, first = KNOWN[name]
        rows = slice(first + done["infer"], first + count)
        add("infer", {key: own[rows] for key, own in files.read_arrays(SYSID / f"{name}-{box}-edge.npz").items()})
    elif done["infer"] < count:
        rest = found["observed"][done["infer"] :]
        add("infer", mujoco_sysid.believed("edge", task, rest, "initial", FIRST_SEED + done["infer"]))
    several = (
        ("polish", count, lambda row, draws: polished(task, found["observed"][row], draws, row)),
        (
            "metropolis",
            min(count, chains_of),
            lambda row, draws: metropolis(task, found["observed"][row], _starts(task, known, row), row),
        ),
    )
    for method, until, made in several:
        for row in track(range(done[method], until), f"{name}: {method}"):
            own = made(row, known["infer"]["draws"][row])
            add(method, {key: np.asarray(value)[None] for key, value in own.items()})


def _starts(task: Task, known: dict[str, dict[str, np.ndarray]], row: int) -> np.ndarray:
    """Starts of the chains: draws of the polished posterior, the first replaced by their median unless bimodal."""
    draws = np.asarray(known["polish"]["draws"][row], float)
    return np.concatenate([draws[:1] if task.name == "puck" else np.median(draws, axis=0)[None], draws[1:CHAINS]])


@dataclasses.dataclass(frozen=True)
class Judged:
    """A method on N recordings of an example with D parameters.

    Attributes:
        held: whether 90 % intervals hold the truth, shape [N, D].
        half: half-widths of these, as fractions of the right box's width, shape [N, D].
        deviation: standard deviations in inference space, shape [N, D].
        error: errors of medians, as fractions of the right box's width, shape [N, D].
        simulations: number of simulations, shape [N].
        seconds: duration, shape [N].
        confirmed: whether a polished posterior was confirmed by simulations, shape [N]; empty for other methods.
    """

    held: np.ndarray
    half: np.ndarray
    deviation: np.ndarray
    error: np.ndarray
    simulations: np.ndarray
    seconds: np.ndarray
    confirmed: np.ndarray


def judged(task: Task, name: str, method: str, out: Path) -> Judged:
    """Evaluate a method from its arrays."""
    arrays = files.read_arrays(out / f"{name}-{method}.npz")
    count = len(arrays["seconds"])
    theta = recorded(task, name, out, count)["theta"]
    truth, draws = folded(task, np.asarray(task.space.to_inference(theta))), folded(task, arrays["draws"])
    right = task.support("right")
    width = np.asarray(right.high) - np.asarray(right.low)
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=1)
    held = (low <= truth) & (truth <= high)
    half, error = 0.5 * (high - low) / width, np.abs(middle - truth) / width
    confirmed = arrays.get("polished", np.zeros(0, bool))
    return Judged(held, half, draws.std(axis=1), error, arrays["simulations"], arrays["seconds"], confirmed)


def table(out: Path) -> list[str]:
    """All results so far, as the lines of a table."""
    lines = [
        "| example | method | recordings | confirmed | 90 % intervals hold | error, median | half-width, median | "
        "deviation over Metropolis's, median (least to largest) | simulations | s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in EXAMPLES:
        task = load(name)
        several = {one: judged(task, name, one, out) for one in METHODS if (out / f"{name}-{one}.npz").exists()}
        for method, own in several.items():
            ratio = "–"
            if method != "metropolis" and "metropolis" in several:
                beside = several["metropolis"].deviation
                ratios = own.deviation[: len(beside)] / beside
                ratio = f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
            cells = [
                name, method, str(len(own.held)), str(own.confirmed.sum()) if own.confirmed.size else "–",
                f"{own.held.sum()} of {own.held.size}",
                f"{np.median(own.error):.3f}", f"{np.median(own.half):.3f}", ratio,
                f"{np.mean(own.simulations):.0f}", f"{np.mean(own.seconds):.0f}",
            ]  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Run what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", default=EXAMPLES, choices=EXAMPLES)
    parser.add_argument("--recordings", type=int, default=6, help="of each example (default: 6)")
    parser.add_argument("--chains-of", type=int, default=3, help="recordings that Metropolis gets (default: 3)")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/mujoco-coverage"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.examples:
        run(name, arguments.out, arguments.recordings, arguments.chains_of)
        text = "\n".join(table(arguments.out)) + "\n"
        (arguments.out / "table.md").write_text(text)
    (arguments.out / "config.json").write_text(json.dumps({"first_seed": FIRST_SEED, **environment()}, indent=2) + "\n")
    print(text)


if __name__ == "__main__":
    main()
