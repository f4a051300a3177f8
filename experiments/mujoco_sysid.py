"""Posteriors of MuJoCo models compared with least-squares estimates, on the same recordings.

    python -m experiments.mujoco_sysid --recordings 10 --out experiments/results/mujoco-sysid

Each example of examples/mujoco is recorded again for other truths, which lie in its right box and outside of its wrong
one. The recording simulator that stands for reality has another integrator, and forces that the model does not have.
Every method gets both boxes:

    sysid        Gauss-Newton of mujoco.sysid from the box's centre, and its 90 % intervals (extra bench)
    scipy        scipy.optimize.least_squares, the same
    cma          CMA-ES (cma, extra bench), 1,000 simulations; no intervals
    edge         jaxlfi's `quick` with EDGE; all recordings of a box are run as one batch
    apt          the same with --method apt
    edge-fit     least-squares points from the best of 64 draws of edge's posterior, corrected for the integrator's
    apt-fit      error, and their intervals (jaxlfi.envs.mujoco.least_squares)

All use the same code to simulate. sysid, scipy and cma stay in the box; the others do not. Errors and half-widths are
fractions of the right box's width, in logarithms if those are inferred; the sign of the puck's lateral speed is
ignored, as its recording does not identify it. Existing results are kept: a larger --recordings adds the missing ones.
"""

import argparse
import dataclasses
import importlib.util
import json
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from rich.console import Console
from rich.progress import track

from experiments.ablation import PAPER_EDGE
from experiments.widths import Cases, final_states
from jaxlfi.bayessim.batch import posterior_after
from jaxlfi.bayessim.presets import settings_for
from jaxlfi.envs.mujoco import least_squares, sysid_point
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.registry import TASKS
from jaxlfi.tasks.task import Task

FOLDER = Path("examples/mujoco")
EXAMPLES = ("furuta", "arm", "puck", "finger")
BOXES = {"right": "right", "wrong": "initial"}
"""Boxes of each example, and their names in its file."""
POINTS = ("sysid", "scipy", "cma")
POSTERIORS = ("edge", "apt")
METHODS = (*POINTS, *(name for posterior in POSTERIORS for name in (posterior, f"{posterior}-fit")))
DRAWS = 500
SIDE_BY_SIDE = 10
"""Number of runs in a batch."""
LEVEL = 1.6449
"""Half-width of 90 % intervals of a normal distribution, in standard deviations."""
BEYOND = 0.95
"""Fraction of a posterior's draws beyond a bound above which it says that the box was wrong. The whole 90 % interval is
then beyond the bound, so a calibrated posterior is mistaken about that in at most a twentieth of the cases."""
FIRST_SEED = 1000
"""First seed of the recordings; that of the examples' own is 0."""


def truths(task: Task, count: int, first_seed: int = FIRST_SEED) -> np.ndarray:
    """Truths in the right box and outside of the wrong one, in natural units, shape [count, D]."""
    rng = np.random.default_rng(first_seed)
    right, wrong = (task.support(BOXES[name]) for name in ("right", "wrong"))
    low, high = np.asarray(right.low), np.asarray(right.high)
    found: list[np.ndarray] = []
    while len(found) < count:
        theta = rng.uniform(low, high)
        if not bool(wrong.contains(theta)):
            found.append(theta)
    return np.asarray(task.space.to_natural(np.stack(found)), float)


def script():
    """The script that makes the examples' recordings."""
    spec = importlib.util.spec_from_file_location("record", FOLDER / "record.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def recordings(path: Path, task: Task, name: str, count: int, first_seed: int = FIRST_SEED) -> dict[str, np.ndarray]:
    """Truths, their recordings, and held-out recordings; made if they are missing.

    Returns:
        `theta` [N, D], `observed` [N, rows, C], and `held_out` [N, rows, C] without noise, under the controls reversed
        in time and sign.
    """
    if path.exists() and len(files.read_arrays(path)["theta"]) >= count:
        return {key: values[:count] for key, values in files.read_arrays(path).items()}
    record, theta = script(), truths(task, count, first_seed)
    series = lambda log: np.stack([log.signals[signal] for signal in task.simulate.function.signals], axis=1)
    observed, held_out = [], []
    for row, own in enumerate(track(theta, f"recordings of {name}")):
        truth = dict(zip(task.names, map(float, own), strict=True))
        observed.append(series(record.recorded(name, truth, first_seed + row)))
        held_out.append(series(record.recorded(name, truth, None, backwards=True)))
    arrays = {"theta": theta, "observed": np.stack(observed), "held_out": np.stack(held_out)}
    files.write_arrays(path, arrays)
    return arrays


@dataclasses.dataclass(frozen=True)
class Point:
    """A point estimate in inference space, with its intervals [D, 2] and which parameters are on a bound [D]."""

    theta: np.ndarray
    interval: np.ndarray
    at_bound: np.ndarray
    simulations: int


def point(method: str, task: Task, observed: np.ndarray, box: str) -> Point:
    """The estimate of a point method, started at the box's centre."""
    residuals = least_squares.Residuals(task, observed)
    low, high = (np.asarray(bound, float) for bound in (task.support(box).low, task.support(box).high))
    centre = 0.5 * (low + high)
    theta = {"sysid": sysid_point.solved, "scipy": _scipy, "cma": _cma}[method](residuals, centre, low, high)
    spent = residuals.simulations
    half = np.full(len(theta), np.nan)
    if method != "cma":
        left, jacobian = residuals(theta[None])[0], residuals.jacobian(theta, low, high)
        if method == "sysid":
            half = sysid_point.half_widths(left, jacobian)
        else:
            variance = np.sum(left**2) / (len(left) - len(theta))
            half = LEVEL * np.sqrt(variance * np.diagonal(np.linalg.pinv(jacobian.T @ jacobian)))
    near = 1e-3 * (high - low)
    interval = np.stack([theta - half, theta + half], axis=1)
    return Point(theta, interval, (theta - low < near) | (high - theta < near), spent)


def _scipy(residuals, centre, low, high) -> np.ndarray:
    jacobian = lambda x: residuals.jacobian(x, low, high)
    return scipy.optimize.least_squares(
        lambda x: residuals(x[None])[0], centre, jac=jacobian, bounds=(low, high), x_scale=high - low
    ).x


def _cma(residuals, centre, low, high) -> np.ndarray:
    import cma

    options = {"bounds": [0, 1], "maxfevals": 1000, "seed": 1, "verbose": -9}
    search = cma.CMAEvolutionStrategy(np.full(len(centre), 0.5), 0.3, options)
    while not search.stop():
        asked = search.ask()
        search.tell(asked, np.mean(residuals(low + np.array(asked) * (high - low)) ** 2, axis=1).tolist())
    return low + search.result.xbest * (high - low)


def believed(
    method: str, task: Task, observed: np.ndarray, box: str, first_seed: int = FIRST_SEED
) -> dict[str, np.ndarray]:
    """Posterior draws for all recordings by jaxlfi, in inference space [N, DRAWS, D]."""
    settings = settings_for(task, {"edge": "bayessim"}.get(method, method))
    x = np.asarray(jax.vmap(task.summary)(jnp.asarray(observed, jnp.float32)))
    theta = np.zeros((len(observed), task.dim), np.float32)
    cases = Cases(first_seed + np.arange(len(observed)), theta, observed.astype(np.float32), x)
    began = time.perf_counter()
    batch = min(len(observed), SIDE_BY_SIDE)
    states, _ = final_states(task, settings, task.support(box), PAPER_EDGE, cases, batch, Console())
    seconds = time.perf_counter() - began

    @jax.jit
    @jax.vmap
    def drawn(key, x, state):
        return posterior_after(settings.correction, state.reported, state.network, x).sample(key, DRAWS, "inference")

    draws = drawn(jax.vmap(jax.random.key)(jnp.asarray(cases.seeds)), jnp.asarray(x), states)
    support = states.belief.support
    return {
        "draws": np.asarray(draws),
        "support": np.stack([np.asarray(support.low), np.asarray(support.high)], axis=-1),
        "simulations": np.asarray(states.progress.rounds) * settings.simulations_per_round,
        "seconds": np.full(len(observed), seconds / len(observed)),
    }


def fitted(task: Task, observed: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray]:
    """The least-squares point, started at the best of some draws."""
    began = time.perf_counter()
    starts = np.asarray(task.space.to_natural(draws[:64]))
    fits = least_squares.best_fits(task, starts, keep=4, observation=observed)
    best = fits[0]
    return {
        "theta": np.asarray(task.space.to_inference(best.theta)),
        "interval": np.asarray(task.space.to_inference(best.interval.T)).T,
        "at_bound": best.at_bound,
        "misfit": np.asarray(best.misfit),
        "points": np.asarray(sum(one.misfit < 1.1 * best.misfit for one in fits)),
        "simulations": np.asarray(best.simulations),
        "seconds": np.asarray(time.perf_counter() - began),
    }


def run(method: str, task: Task, found: dict[str, np.ndarray], box: str, beside: Callable[[str], Path]) -> None:
    """Run a method on all recordings for which it has no results yet."""
    path = beside(method)
    known = files.read_arrays(path) if path.exists() else {}
    done = len(known.get("seconds", ()))
    observed = found["observed"][done:]
    if not len(observed):
        return
    if method in POSTERIORS:
        arrays = believed(method, task, observed, BOXES[box], FIRST_SEED + done)
    else:
        draws = files.read_arrays(beside(method.removesuffix("-fit")))["draws"] if method.endswith("-fit") else None
        rows = []
        for row, own in enumerate(track(observed, f"{task.name}, {box} box: {method}")):
            if draws is not None:
                rows.append(fitted(task, own, draws[done + row]))
            else:
                began = time.perf_counter()
                one = dataclasses.asdict(point(method, task, own, BOXES[box]))
                rows.append(one | {"seconds": time.perf_counter() - began})
        arrays = {key: np.stack([np.asarray(row[key]) for row in rows]) for key in rows[0]}
    files.write_arrays(path, {key: np.concatenate([*([known[key]] if done else []), arrays[key]]) for key in arrays})


def folded(task: Task, theta: np.ndarray) -> np.ndarray:
    """Parameters without the sign that a recording does not identify."""
    theta = np.array(theta, float)
    if task.name == "puck":
        theta[..., 2] = np.abs(theta[..., 2])
    return theta


def judged(task: Task, found: dict[str, np.ndarray], arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Accuracy of a method.

    Returns:
        `error` and `half` [N, D], the half-width of an interval, as fractions of the right box's width; `held` [N, D],
        whether intervals hold the truth; `held_out` [N], root mean square misfit of the held-out recording in standard
        deviations of the noise.
    """
    right = task.support("right")
    width = np.asarray(right.high) - np.asarray(right.low)
    truth = folded(task, np.asarray(task.space.to_inference(found["theta"])))
    if "draws" in arrays:
        draws = folded(task, arrays["draws"])
        point, best = np.median(draws, axis=1), np.median(arrays["draws"], axis=1)
        interval = np.quantile(draws, [0.05, 0.95], axis=1).transpose(1, 2, 0)
        best = np.where(np.arange(task.dim) == 2, point, best) if task.name == "puck" else best
    else:
        point, best = folded(task, arrays["theta"]), arrays["theta"]
        interval = np.sort(folded(task, arrays["interval"].transpose(0, 2, 1)).transpose(0, 2, 1), axis=2)
    simulator = least_squares.Residuals(task)
    held_out = []
    for own, series in zip(np.asarray(task.space.to_natural(best)), found["held_out"], strict=True):
        clean, _ = backwards(task)(own[None])
        held_out.append(np.sqrt(np.mean(((clean[0] - series) / simulator.noise) ** 2)))
    with np.errstate(invalid="ignore"):  # an undefined interval goes from -inf to -inf
        half = 0.5 * (interval[..., 1] - interval[..., 0]) / width
    return {
        "error": np.abs(point - truth) / width,
        "half": half,
        "held": (interval[..., 0] <= truth) & (truth <= interval[..., 1]),
        "held_out": np.array(held_out),
    }


def backwards(task: Task):
    """The simulator under the controls reversed in time and sign."""
    return task.simulate.function.under(lambda values: -values[::-1]).clean


def says_wrong(task: Task, arrays: dict[str, np.ndarray], box: str) -> np.ndarray:
    """Whether a method says that its box is wrong: a point on a bound, or nearly all draws beyond one; shape [N]."""
    if "draws" not in arrays:
        return arrays["at_bound"].any(axis=1)
    first = task.support(BOXES[box])
    below, above = arrays["draws"] < np.asarray(first.low), arrays["draws"] > np.asarray(first.high)
    return (np.maximum(below.mean(axis=1), above.mean(axis=1)) > BEYOND).any(axis=1)


def table(out: Path) -> str:
    """All results so far, as Markdown."""
    lines = [
        "| example | box | method | recordings | error, median (worst 10th) | 90 % intervals cover | half-width | "
        "held-out misfit | truth found | says wrong | simulations | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in EXAMPLES:
        path = out / f"{name}-recordings.npz"
        if not path.exists():
            continue
        task = load(name)
        for box in BOXES:
            for method in METHODS:
                own = out / f"{name}-{box}-{method}.npz"
                if not own.exists():
                    continue
                arrays = files.read_arrays(own)
                count = len(arrays["seconds"])
                found = {key: values[:count] for key, values in files.read_arrays(path).items()}
                numbers = judged(task, found, arrays)
                right = np.mean((numbers["error"] < 0.1).all(axis=1))
                interval = np.isfinite(numbers["half"]).all()
                cells = [
                    name, box, method, str(count),
                    f"{np.median(numbers['error']):.3f} ({np.quantile(numbers['error'], 0.9):.3f})",
                    f"{np.mean(numbers['held']):.2f}" if interval else "–",
                    f"{np.median(numbers['half']):.3f}" if interval else "–",
                    f"{np.median(numbers['held_out']):.1f}",
                    f"{right:.2f}", f"{np.mean(says_wrong(task, arrays, box)):.2f}",
                    f"{np.mean(arrays['simulations']):.0f}", f"{np.mean(arrays['seconds']):.1f}",
                ]  # fmt: skip
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def load(name: str) -> Task:
    """The task of an example."""
    return TASKS.load(f"mujoco,config={FOLDER / name}.toml")


def main() -> None:
    """Run what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", default=EXAMPLES, choices=EXAMPLES)
    parser.add_argument("--boxes", nargs="+", default=tuple(BOXES), choices=tuple(BOXES))
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--recordings", type=int, default=10, help="of each example (default: 10)")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/mujoco-sysid"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.examples:
        task = load(name)
        found = recordings(arguments.out / f"{name}-recordings.npz", task, name, arguments.recordings)
        for box in arguments.boxes:
            beside = lambda method, name=name, box=box: arguments.out / f"{name}-{box}-{method}.npz"
            for method in arguments.methods:
                run(method, task, found, box, beside)
        with (FOLDER / f"{name}.toml").open("rb") as file:
            config = {"example": tomllib.load(file), "first_seed": FIRST_SEED, **environment()}
        (arguments.out / f"{name}.json").write_text(json.dumps(config, indent=2) + "\n")
    text = table(arguments.out)
    (arguments.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
