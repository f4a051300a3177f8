"""Detection of one wrong bound, and false alarms on right ones, on simulators of several kinds.

    python -m experiments.wrong_bounds --out experiments/results/wrong-bounds

For each problem, equally many random boxes hold the truth or exclude it by one bound. Their width is 0.3 to 1 times a
prior's usual width, and a wrong bound excludes the truth by 0.1 to 0.5 of that. Each box is kept fixed, and one run of
1,000 simulations infers from its own observation with `quick` and fewer epochs. The truth and the box of each run are
saved, together with its evidence on the bounds.
"""

import argparse
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np

import jaxlfi
from experiments.sharpness.catalogue import PROBLEMS as OTHERS
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.diagnostics import bound_evidence
from jaxlfi.diagnostics.bounds import MASS_BEYOND
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Fixed
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment
from jaxlfi.runs.describe import settings_to_json
from jaxlfi.tasks.observation import simulate_observation

SETTINGS = QUICK.replace(rounds=10, min_rounds=0, predictive=False, estimator=QUICK.estimator.replace(epochs=40))
T40, T25, T20 = jnp.linspace(0, 4, 40), jnp.linspace(0, 5, 25), jnp.linspace(0, 10, 20)
GRID = jnp.linspace(-1, 1, 30)


def noisy(model: Callable, noise: float | np.ndarray) -> Callable:
    """A simulator: a model's series with Gaussian noise."""

    def simulate(key, theta):
        x = model(theta)
        return x + noise * jax.random.normal(key, x.shape)

    return simulate


def spring(theta):
    """A damped oscillation with zero initial velocity, by stiffness and damping."""
    stiffness, damping = theta
    frequency = jnp.sqrt(jnp.maximum(stiffness - damping * damping / 4, 1e-3))
    return jnp.exp(-damping * T40 / 2) * jnp.cos(frequency * T40)


def oscillation(theta):
    """A decaying oscillation, by amplitude and frequency."""
    return theta[0] * jnp.sin(theta[1] * T25) * jnp.exp(-0.1 * T25)


def logistic(theta):
    """Logistic growth, by rate, capacity and initial value."""
    rate, capacity, first = theta
    return capacity / (1 + (capacity / first - 1) * jnp.exp(-rate * T20))


def idle(theta):
    """Five summaries of the first two parameters; two further parameters have no effect."""
    a, b = theta[0], theta[1]
    return jnp.stack([a, a * b, b, a, b])


def ridge(theta):
    """The product of two parameters, measured precisely; their ratio, measured less precisely; and a third."""
    a, b = jnp.log(theta[0]), jnp.log(theta[1])
    return jnp.stack([a + b, a + b, 0.5 * (a - b), theta[2]])


def thermocouple(theta):
    """Voltage over time, by the rise of temperature and a time constant."""
    return 4e-5 * theta[0] * (1 - jnp.exp(-T20 / theta[1]))


@dataclasses.dataclass(frozen=True)
class Problem:
    """A simulator and its truth.

    Attributes:
        simulate: simulator, as in a task.
        truth: true parameters in natural units, shape [D].
        width: width of a usual prior, in inference space, shape [D].
        log: indices of the parameters inferred as logarithms.
        informed: number of leading parameters that the data identify: only their bounds are made wrong.
        least: minimum of the lower bounds, in inference space; None for no limit.
        seed: seed of boxes and observations.
        runs: number of runs on wrong boxes, and also of those on right ones.
        held_out: whether the problem was not looked at before the rule was chosen; otherwise, only its boxes were not.
    """

    simulate: Callable
    truth: tuple[float, ...]
    width: tuple[float, ...]
    log: tuple[int, ...] = ()
    informed: int | None = None
    least: tuple[float, ...] | None = None
    seed: int = 1000
    runs: int = 7
    held_out: bool = False


def from_catalogue(name: str) -> Problem:
    """A problem of `experiments.sharpness`, inferred from raw observations."""
    other = OTHERS[name]
    low, high = other.box
    return Problem(
        other.simulate,
        other.truth,
        tuple(high - low),
        tuple(np.flatnonzero(np.isin(other.names, other.log)).tolist()),
        informed=len(other.informed or other.names),
        held_out=True,
    )


PROBLEMS = {
    "spring": Problem(noisy(spring, 0.05), (12.0, 0.4), (3.7, 3.7), (0, 1)),
    "oscillation": Problem(noisy(oscillation, 0.1), (1.5, 1.7), (4.0, 2.5)),
    "logistic": Problem(noisy(logistic, 2.0), (0.8, 100.0, 3.0), (3.4, 2.7, 3.7), (0, 1, 2)),
    "idle": Problem(noisy(idle, 0.1), (1.0, 1.0, 0.0, 5.0), (3.0, 3.0, 4.0, 8.0), informed=2),
    "polynomial": Problem(
        noisy(lambda theta: sum(theta[i] * GRID**i for i in range(5)), 0.2), (0.5, -1.0, 0.8, 0.3, -0.6), (6.0,) * 5
    ),
    "ridge": Problem(noisy(ridge, np.array([0.03, 0.03, 0.15, 0.2])), (2.0, 3.0, 1.0), (3.0, 3.0, 4.0), (0, 1)),
    "thermocouple": Problem(noisy(thermocouple, 1e-4), (100.0, 2.0), (120.0, 2.5), least=(5.0, 0.2)),
    **{name: from_catalogue(name) for name in ("linear_8", "poisson_regression", "epidemic", "lotka_volterra")},
}
"""Problems by name."""


def problem_task(problem: Problem) -> jaxlfi.Task:
    """The task of a problem, with a Phi that is wider than all of its boxes."""
    truth, width, log = _arrays(problem)
    natural = lambda bound: np.where(log, np.exp(np.where(log, bound, 0.0)), bound).tolist()
    phi = Support(natural(truth - 2 * width), natural(truth + 2 * width))
    names = [f"p{d}" for d in range(len(truth))]
    log_names = tuple(names[d] for d in problem.log)
    return jaxlfi.Task(
        problem.simulate, names=names, log=log_names, supports={"box": phi}, feasible=phi, truth=list(problem.truth)
    )


def _arrays(problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth and widths in inference space, and which parameters are inferred as logarithms, shape [D] each."""
    log = np.isin(np.arange(len(problem.truth)), problem.log)
    truth = np.asarray(problem.truth)
    return np.where(log, np.log(np.where(log, truth, 1.0)), truth), np.asarray(problem.width), log


def boxes(problem: Problem, seed: int, wrong: bool) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds in inference space, shape [runs, D] each; one bound of each box is wrong, or none."""
    truth, width, _ = _arrays(problem)
    rng, shape = np.random.default_rng(seed), (problem.runs, len(truth))
    place = rng.uniform(0.15, 0.85, shape)  # of the truth, as a fraction of the box
    for row in place if wrong else ():
        d, side = rng.integers(len(truth)), rng.integers(2)
        d = rng.integers(problem.informed) if problem.informed else d
        beyond = rng.uniform(0.1, 0.5)
        row[d] = -beyond if side == 0 else 1 + beyond
    width = width * rng.uniform(0.3, 1.0, shape)
    low = truth - place * width
    high = low + width
    low = low if problem.least is None else np.maximum(low, problem.least)
    return low.astype(np.float32), high.astype(np.float32)


def judged(task: jaxlfi.Task, runs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Evidence of runs on their bounds, by name, each with a leading axis over runs.

    Args:
        task: task of the runs.
        runs: `logits`, `means`, `scale_tril` of the last posteriors, `low` and `high` of the boxes, `theta` and `x` of
            all simulations, `size`, their number, and `xo`, the observed summaries.
    """
    found = []
    for i in range(len(runs["low"])):
        mixture = GaussianMixture(*(jnp.asarray(runs[name][i]) for name in ("logits", "means", "scale_tril")))
        belief = Belief(mixture, Support(runs["low"][i], runs["high"][i]), jnp.asarray(True))
        rows = slice(int(runs["size"][i]))
        found.append(bound_evidence(belief, runs["theta"][i, rows], runs["x"][i, rows], runs["xo"][i]))
    truth = np.asarray(task.inference.truth)
    return {
        "truth": truth,
        "low": runs["low"],
        "high": runs["high"],
        "excludes": np.stack([truth < runs["low"], truth > runs["high"]], axis=1),
        **{name: np.stack([getattr(one, name) for one in found]) for name in ("mass", "gain", "wrong")},
    }


def infer_all(problem: Problem) -> dict[str, np.ndarray]:
    """Run a problem on all of its boxes, as one batch."""
    task = problem_task(problem)
    wrong, right = boxes(problem, problem.seed, True), boxes(problem, problem.seed + 1000, False)
    low, high = (np.concatenate(pair) for pair in zip(wrong, right, strict=True))
    keys = jax.random.split(jax.random.key(problem.seed + 7), len(low))
    observed = jnp.stack(
        [simulate_observation(jax.random.key(10_000 * (problem.seed + 1) + i), task) for i in range(len(low))]
    )

    @jax.jit
    @jax.vmap
    def one(key, observation, low, high):
        run = jaxlfi.infer(
            key, task, observation, support=Support(low, high), space="inference", heuristic=Fixed(), settings=SETTINGS
        )
        return run.belief.mixture, run.dataset, run.x

    mixture, dataset, x = jax.device_get(one(keys, observed, low, high))
    arrays = {name: getattr(mixture, name) for name in ("logits", "means", "scale_tril")}
    data = {"theta": dataset.theta, "x": dataset.x, "size": dataset.size}
    return judged(task, {**arrays, **data, "low": low, "high": high, "xo": x})


def counts(found: Mapping[str, np.ndarray], named: np.ndarray) -> dict[str, tuple[int, int]]:
    """Numbers of bounds named and of all: wrong bounds, right bounds of wrong boxes, and right bounds of right boxes.

    Args:
        found: results of one problem, as by `judged`.
        named: bounds that a rule names, shape [runs, 2, D].
    """
    excludes = found["excludes"]
    spoilt = np.broadcast_to(excludes.any(axis=(1, 2), keepdims=True), excludes.shape)
    parts = {"wrong": excludes, "right of wrong boxes": spoilt & ~excludes, "right of right boxes": ~spoilt}
    return {name: (int(np.sum(named & part)), int(np.sum(part))) for name, part in parts.items()}


def table(out: Path) -> str:
    """Markdown: one row per problem and rule, and sums."""
    lines = ["| problem | held out | rule | wrong bounds named | right ones of wrong boxes | of right boxes |"]
    lines.append("|---|---|---|---|---|---|")
    rules = {
        "the posterior's mass alone": lambda found: found["mass"] > MASS_BEYOND,
        "now": lambda found: found["wrong"],
    }
    sums: dict[tuple[bool, str], np.ndarray] = {}
    for name, problem in PROBLEMS.items():
        if not (out / f"{name}.npz").exists():
            continue
        found = atomic.read_arrays(out / f"{name}.npz")
        for rule, named in rules.items():
            own = np.array(list(counts(found, named(found)).values()))
            key = problem.held_out, rule
            sums[key] = sums.get(key, 0) + own
            lines.append(_line(name, problem.held_out, rule, own))
    lines += [_line("all", held_out, rule, own) for (held_out, rule), own in sums.items()]
    return "\n".join(lines) + "\n"


def _line(name: str, held_out: bool, rule: str, own: np.ndarray) -> str:
    cells = [f"{hits} of {of}" for hits, of in own]
    return f"| {name} | {'yes' if held_out else 'no'} | {rule} | {' | '.join(cells)} |"


def main(argv: list[str] | None = None) -> None:
    """Run the problems whose arrays are missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS), metavar="PROBLEM")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/wrong-bounds"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.problems:
        if not (arguments.out / f"{name}.npz").exists():
            atomic.write_arrays(arguments.out / f"{name}.npz", infer_all(PROBLEMS[name]))
            atomic.write_json(
                arguments.out / f"{name}.json",
                {"problem": name, "settings": settings_to_json(SETTINGS), **environment()},
            )
    text = table(arguments.out)
    (arguments.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
