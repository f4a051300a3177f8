"""Does the experiment that is chosen tell most, and is a ridge named that no experiment breaks?

    python -m experiments.design --out experiments/results/design

For each of 20 newly drawn truths, the nominal experiment is made first. Its posterior is exact: the likelihood is
known, and importance sampling that is adapted in steps from the whole box finds it, so that what is measured is the
choice of designs and not a network. From this posterior `jaxlfi.design` chooses the next experiment; it is made, as are
the nominal one again and experiments at random, and the posterior of both recordings is exact, too. What is saved is,
of each, how wide the 90 % intervals are, whether they hold the truth, and which design it was.

    arm     a motor turns an arm in a horizontal plane: mass, gear and damping are an exact ridge, whatever it does
    load    the same, and a load of known mass may be fastened to the arm's end
"""

import argparse
import functools
from collections.abc import Callable
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.design.recommendation import Recommendation, recommend
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import truncated
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.task import Task

SEED = 20_430
"""Of all truths, recordings and searches."""
TRUTHS = 20
RANDOM = 2
"""Experiments at random that the chosen one is compared with, for each truth."""
RATED = 96
"""Designs that are rated for each choice."""
SPREAD = 1.5
"""Truths are the task's by up to this factor either way."""
POINTS = 1024
"""Of a posterior by importance sampling, in each step."""
STEPS = 100
"""Of one, at most."""


def arm(load: bool) -> Task:
    """An arm in a horizontal plane on a motor's shaft, driven by a sine; a design is that, and maybe a load at its end.

    I angle'' = gear u - damping angle', I = mass / 3 + load for a length of 1 m. Without a load only two ratios of the
    three parameters act.
    """
    times, step = np.arange(1, 41) * 0.1, 0.02

    def response(theta, design):
        mass, gear, damping = theta
        inertia = mass / 3 + (design[2] if load else 0.0)

        def advance(state, t):
            angle, speed = state
            torque = gear * design[0] * jnp.sin(2 * jnp.pi * design[1] * t)
            speed = (speed + step * torque / inertia) / (1 + step * damping / inertia)
            return (angle + step * speed, speed), angle

        grid = jnp.arange(round(4.0 / step) + 1) * step
        _, angles = jax.lax.scan(advance, (0.0, 0.0), grid)
        return angles[np.round(times / step).astype(int)]

    def simulate(key, theta, design):
        clean = response(theta, design)
        return clean + 0.01 * jax.random.normal(key, clean.shape)

    truth = np.array([0.5, 2.0, 0.4])
    box = Support(truth / 4, truth * 4)
    loads = {"load": (0.0, 0.5, "kg")} if load else {}
    variables = {"amplitude": (0.05, 0.5, "N m"), "frequency": (0.2, 2.0, "Hz")} | loads
    names = ("mass", "gear", "damping")
    return Task(
        simulate,
        names,
        {"guess": box},
        box,
        units=("kg", "", "N m s/rad"),
        log=names,
        truth=truth,
        name="arm with a load" if load else "arm",
        design=Design(
            variables, {"amplitude": 0.2, "frequency": 0.5} | dict.fromkeys(loads, 0.0), response=response, noise=0.01
        ),
    )


PROBLEMS: dict[str, Callable[[], Task]] = {
    "arm": functools.partial(arm, False),
    "load": functools.partial(arm, True),
}


@functools.lru_cache
def log_likelihood(task: Task) -> Callable:
    """Of recordings [E, T, ...] made by designs [E, K], at parameters [N, D] in inference space."""
    noise = task.design.noise[0]

    @jax.jit
    def of(recorded, designs, theta):
        def one(theta):
            natural = task.space.to_natural(theta)
            clean = jax.vmap(lambda design: task.design.response(natural, design))(designs)
            return jnp.nan_to_num(-0.5 * jnp.sum((recorded - clean) ** 2) / noise**2, nan=-1e30, neginf=-1e30)

        return jax.vmap(one)(theta)

    return of


def exact_posterior(rng: np.random.Generator, task: Task, recorded: np.ndarray, designs: np.ndarray) -> np.ndarray:
    """Draws [N, D] in inference space, by importance sampling from the box in tempered steps.

    Each step weighs draws by as much of the likelihood as leaves a fifth of them effective, and draws the next ones
    from a normal that is half as wide again, in the box.
    """
    box = task.support(None)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    of = log_likelihood(task)
    theta, log_proposal = rng.uniform(low, high, (8 * POINTS, len(low))), np.zeros(8 * POINTS)
    power = 0.0
    for _ in range(STEPS):
        log = np.concatenate(
            [np.asarray(of(jnp.asarray(recorded), jnp.asarray(designs), jnp.asarray(part, jnp.float32)), float)
             for part in np.split(theta, len(theta) // POINTS)]
        )  # fmt: skip
        done, power = power, _power(log, log_proposal, len(theta) / 5)
        weight = _weights(power * log - log_proposal)
        if power == 1.0 and done == 1.0:
            return theta[rng.choice(len(theta), POINTS, p=weight)]
        mean = weight @ theta
        centred = theta - mean
        factor = np.linalg.cholesky(1.5**2 * (weight[:, None] * centred).T @ centred + 1e-12 * np.eye(len(mean)))
        kept = np.empty((0, len(mean)))
        while len(kept) < POINTS:
            tried = mean + rng.standard_normal((4 * POINTS, len(mean))) @ factor.T
            kept = np.concatenate([kept, tried[((tried > low) & (tried < high)).all(axis=1)]])
        theta = kept[:POINTS]
        log_proposal = -0.5 * np.sum(np.linalg.solve(factor, (theta - mean).T) ** 2, axis=0)
    raise RuntimeError(f"{task.name}: expected a posterior after {STEPS} steps, got none")


def _power(log: np.ndarray, log_proposal: np.ndarray, effective: float) -> float:
    """How much of the likelihood leaves so many draws effective; all of it where it can."""
    enough = lambda power: 1 / np.sum(_weights(power * log - log_proposal) ** 2) >= effective
    if enough(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return max(low, 1e-6)


def _weights(log: np.ndarray) -> np.ndarray:
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def recorded_at(key: jax.Array, task: Task, truth: np.ndarray, design: np.ndarray) -> np.ndarray:
    """A recording of an experiment."""
    return np.asarray(task.simulate.function(key, jnp.asarray(truth, jnp.float32), jnp.asarray(design, jnp.float32)))


def chosen_for(key: jax.Array, task: Task, draws: np.ndarray) -> Recommendation:
    """What is recommended for a posterior's draws."""
    mean, factor = draws.mean(axis=0), np.linalg.cholesky(np.cov(draws, rowvar=False))
    one = GaussianMixture(jnp.zeros(1), jnp.asarray(mean[None], jnp.float32), jnp.asarray(factor[None], jnp.float32))
    box = task.support(None)
    return recommend(key, task, truncated(one, one, box, task.space), box, box, box, rated=RATED)


def measured(task: Task, truths: int, seed: int) -> dict[str, np.ndarray]:
    """Widths [truths, experiments, D] and whether the truth is inside, of the first experiment and each second one."""
    rng = np.random.default_rng(seed)
    found: dict[str, list] = {name: [] for name in ("truth", "design", "width", "held", "reach", "bits", "narrower")}
    for number in range(truths):
        keys = jax.random.split(jax.random.key(seed + number), 3)
        truth = task.truth * SPREAD ** rng.uniform(-1, 1, task.dim)
        inner = np.asarray(task.space.to_inference(truth))
        nominal = np.array(task.design.nominal)
        first = recorded_at(keys[0], task, truth, nominal)
        draws = exact_posterior(rng, task, first[None], nominal[None])
        advice = chosen_for(keys[1], task, draws)
        others = task.design.of_unit(rng.random((RANDOM, len(nominal))))
        second = np.concatenate([advice.designs, nominal[None], others])
        posteriors = [draws]
        for design, key in zip(second, jax.random.split(keys[2], len(second)), strict=True):
            both = np.stack([first, recorded_at(key, task, truth, design)])
            posteriors.append(exact_posterior(rng, task, both, np.stack([nominal, design])))
        low, high = np.quantile(np.stack(posteriors), [0.05, 0.95], axis=1)
        row = {
            "truth": truth,
            "design": second,
            "width": high - low,
            "held": (inner > low) & (inner < high),
            "reach": advice.reach,
            "bits": advice.together[0],
            "narrower": advice.narrower,
        }
        for name, value in row.items():
            found[name].append(value)
        print(f"{task.name}: truth {number + 1} of {truths}, chosen {np.round(second[0], 2)}", flush=True)
    return {name: np.array(values) for name, values in found.items()}


def table(folder: Path) -> str:
    """The study's tables, from the arrays."""
    lines = [
        "| problem | second experiment | 90 % intervals, as a fraction of the first's | against random | truths held |",
        "|---|---|---|---|---|",
    ]
    for name in PROBLEMS:
        kept = np.load(folder / f"{name}.npz")
        width = np.exp(np.mean(np.log(kept["width"]), axis=2))  # [truths, experiments], geometric mean of parameters
        ratio = width[:, 1:] / width[:, :1]
        groups = {"chosen": ratio[:, :1], "nominal again": ratio[:, 1:2], "at random": ratio[:, 2:]}
        held = {"chosen": kept["held"][:, 1:2], "nominal again": kept["held"][:, 2:3], "at random": kept["held"][:, 3:]}
        at_random = np.exp(np.mean(np.log(groups["at random"]), axis=1))
        for what, values in groups.items():
            own = np.exp(np.mean(np.log(values), axis=1))
            low, high = np.quantile(own, [0.1, 0.9])
            better = "" if what == "at random" else f"{np.exp(np.mean(np.log(own / at_random))):.2f} times"
            lines.append(
                f"| {name} | {what} | {np.exp(np.mean(np.log(own))):.2f} [{low:.2f}, {high:.2f}] | {better or '–'} | "
                f"{held[what].mean():.0%} of {held[what].size} |"
            )
    lines += ["", "| problem | best of all rated, on the ridge | predicted by the chosen one |", "|---|---|---|"]
    for name in PROBLEMS:
        kept = np.load(folder / f"{name}.npz")
        lines.append(
            f"| {name} | {np.median(kept['reach']):.2f} times narrower (at most {kept['reach'].max():.2f}) | "
            f"{np.median(kept['narrower']):.2f} times |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, and write arrays and tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--truths", type=int, default=TRUTHS, metavar="N")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N")
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=PROBLEMS)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.problems:
        found = measured(PROBLEMS[name](), arguments.truths, arguments.seed)
        files.write_arrays(arguments.out / f"{name}.npz", found)
    config = {"truths": arguments.truths, "seed": arguments.seed, "rated": RATED, "random": RANDOM} | environment()
    files.write_json(arguments.out / "config.json", config)
    files.write_bytes(arguments.out / "table.md", table(arguments.out).encode())


if __name__ == "__main__":
    main()
