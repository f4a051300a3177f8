"""False alarms and detection rates of the test of an observation against its simulations.

    python -m experiments.misspecification
    python -m experiments.misspecification --runs 36 --out experiments/results/misspecification

For each of six simulators, truths are drawn from a box and an observation is simulated at each. The observation is left
unchanged (any report is then a false alarm) or altered: it is moved by ten of the simulations' standard deviations,
multiplied by 1000, by 0.001 or by 180 / pi, or its records are shuffled; or a constant is observed at another value. It
is compared with `--simulations` simulations from the uniform prior over the box, as in a run of a single round; the
network does not matter for the test.

`--runs` additionally makes whole runs of several rounds, with EDGE and the settings `quick`, each for an unchanged
observation, and compares it with all simulations of its run.
"""

import argparse
import functools
import json
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.presets import QUICK
from jaxlfi.diagnostics import unlike
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear, lotka_volterra, mg1
from jaxlfi.heuristics import Edge
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment
from jaxlfi.runs.infer import infer
from jaxlfi.runs.unlike import names_of
from jaxlfi.studies.calibration.truths import simulated_truths
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.task import Task

KINDS = ("own", "far", "x1000", "x0.001", "degrees", "shuffled", "constant")
"""Alterations of an observation."""
FOUND = ("nothing", "constant", "range", "joint")
"""Possible reports; saved as the index of the first finding's kind."""
POOL = 4000
"""Number of simulations over the box, from which each case takes its own subset."""
BOX = "ok"


def oscillator(key: jax.Array, theta: jax.Array) -> jax.Array:
    """Position and velocity of a damped oscillator at 25 times, with noise, shape [25, 2]."""
    frequency, damping = theta
    time = 0.2 * jnp.arange(25)
    fall = jnp.exp(-damping * time)
    states = jnp.stack([fall * jnp.cos(frequency * time), -frequency * fall * jnp.sin(frequency * time)], axis=1)
    return states + jnp.array([0.05, 0.15]) * jax.random.normal(key, (25, 2))


def autoregression(key: jax.Array, theta: jax.Array) -> jax.Array:
    """Forty values of a stationary autoregressive process of order one, shape [40, 1]."""
    level, memory = theta
    noise = jax.random.normal(key, (40,))

    def advance(value, noise):
        value = memory * value + noise
        return value, value

    _, values = jax.lax.scan(advance, noise[0] / jnp.sqrt(1 - memory**2), noise)
    return (level + values)[:, None]


def heavy_tails(key: jax.Array, theta: jax.Array) -> jax.Array:
    """Three values about each of two locations, with Student's t of 1.5 degrees of freedom, shape [6]."""
    return jnp.repeat(theta, 3) + jax.random.t(key, 1.5, (6,))


def _task(simulate, names, low, high, channels=()) -> Task:
    box = Support(low, high)
    return Task(simulate, names, {BOX: box}, box, name=simulate.__name__, channels=channels)


TASKS = {
    "gaussian_linear": gaussian_linear.task,
    "lotka_volterra": lotka_volterra.task,
    "mg1": mg1.task,
    "oscillator": functools.partial(
        _task, oscillator, ("frequency", "damping"), [1.0, 0.0], [5.0, 1.0], ("position", "velocity")
    ),
    "autoregression": functools.partial(
        _task, autoregression, ("level", "memory"), [-3.0, 0.0], [3.0, 0.95], ("value",)
    ),
    "heavy_tails": functools.partial(_task, heavy_tails, ("first", "second"), [-5.0, -5.0], [5.0, 5.0]),
}
"""Tasks by name. Lotka-Volterra and M/G/1 are observed through summaries, the others directly."""


def altered(kind: str, trajectory: np.ndarray, scale: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An observation, altered such that it does not fit the simulator.

    Args:
        kind: one of KINDS.
        trajectory: the observation, shape [T] or [T, C].
        scale: standard deviations of simulated trajectories, of the same shape.
        rng: chooses the channel that is moved (a single number if the T numbers are no series), and shuffles.
    """
    factors = {"x1000": 1000.0, "x0.001": 0.001, "degrees": 180 / np.pi}
    if kind in factors:
        return trajectory * factors[kind]
    if kind == "shuffled":
        return rng.permutation(trajectory)
    if kind == "far":
        columns = trajectory.shape[-1] if trajectory.ndim > 1 or len(trajectory) < 10 else 1
        moved = np.arange(columns) == rng.integers(columns)
        return trajectory + np.where(moved, 10 * scale.max(axis=0) if trajectory.ndim > 1 else 10 * scale, 0.0)
    return trajectory


def found(x: np.ndarray, simulations: np.ndarray, names: tuple, channels: tuple) -> int:
    """The report for an observation, as an index of FOUND."""
    findings = unlike(x, simulations, names, channels)
    return FOUND.index(findings[0].kind) if findings else 0


def once(name: str, cases: int, simulations: int, seed: int) -> dict[str, np.ndarray]:
    """The reports in runs of one round, by kind, shape [cases] each."""
    task, rng = TASKS[name](), np.random.default_rng(seed)
    shapes = simulator_shapes(task)
    pool = simulated_truths(jax.random.key(seed), task, task.support(BOX), POOL, shapes)
    own = simulated_truths(jax.random.key(seed + 1), task, task.support(BOX), cases, shapes)["observed"]
    scale = pool["observed"].std(axis=0)
    names, channels = names_of(task, shapes.trajectory, shapes.summary)
    summary = jax.jit(jax.vmap(task.summary))
    reported = {}
    for kind in KINDS:
        x = np.asarray(summary(np.stack([altered(kind, one, scale, rng) for one in own]).astype(np.float32)))
        reported[kind] = np.zeros(cases, np.int8)
        for case in range(cases):
            rows = pool["x"][rng.choice(POOL, simulations, replace=False)]
            if kind == "constant":
                ones = np.ones((simulations, 1), np.float32)
                seen, rows = np.append(x[case], np.float32(1.001)), np.concatenate([rows, ones], axis=1)
                reported[kind][case] = found(seen, rows, (*names, "constant"), ())
            else:
                reported[kind][case] = found(x[case], rows, names, channels)
    return reported


def runs(name: str, cases: int, seed: int, epochs: int | None = None) -> np.ndarray:
    """The reports of whole runs of ten rounds, with EDGE and `quick`, for unchanged observations, shape [cases]."""
    task = TASKS[name]()
    shapes = simulator_shapes(task)
    own = simulated_truths(jax.random.key(seed + 2), task, task.support(BOX), cases, shapes)["observed"]
    settings = QUICK.replace(min_rounds=0, rounds=10, predictive=False)
    if epochs is not None:
        settings = settings.replace(estimator=settings.estimator.replace(epochs=epochs))

    @jax.jit
    @jax.vmap
    def many(key, observed):
        run = infer(key, task, observed, support=BOX, heuristic=Edge(), settings=settings)
        return run.x, run.dataset.x, run.dataset.size

    names, channels = names_of(task, shapes.trajectory, shapes.summary)
    every = jax.device_get(many(jax.random.split(jax.random.key(seed + 3), cases), jnp.asarray(own)))
    return np.array([found(x, rows[:size], names, channels) for x, rows, size in zip(*every, strict=True)], np.int8)


def rates(folder: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Numbers of reports and of cases, by the saved file's name and the kind."""
    tables = {}
    for path in sorted(folder.glob("*.npz")):
        arrays = atomic.read_arrays(path)
        tables[path.stem] = {kind: (int(np.sum(values > 0)), len(values)) for kind, values in arrays.items()}
    return tables


def table(folder: Path) -> str:
    """The rates as Markdown, a row for each simulator and number of simulations."""
    head = ["simulator", "simulations", *KINDS]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name, own in rates(folder).items():
        task, _, simulations = name.rpartition("-")
        cells = [f"{hits} of {of}" if kind == "own" else f"{100 * hits / of:.0f} %" for kind, (hits, of) in own.items()]
        lines.append(f"| {' | '.join([f'`{task}`', simulations, *cells, *[''] * (len(KINDS) - len(cells))])} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Compute and save what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), metavar="TASK")
    parser.add_argument("--cases", type=int, default=200, help="observations of each simulator and kind")
    parser.add_argument("--simulations", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--runs", type=int, default=0, help="whole runs of each simulator besides")
    parser.add_argument("--epochs", type=int, help="of these runs, in place of the preset's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/misspecification"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    console = Console()
    for name in arguments.tasks:
        for count in arguments.simulations:
            path = arguments.out / f"{name}-{count}.npz"
            if not path.exists():
                atomic.write_arrays(path, once(name, arguments.cases, count, arguments.seed))
                console.print(path, highlight=False)
        path = arguments.out / f"{name}-rounds.npz"
        if arguments.runs and not path.exists():
            atomic.write_arrays(path, {"own": runs(name, arguments.runs, arguments.seed, arguments.epochs)})
            console.print(path, highlight=False)
    config = {key: value for key, value in vars(arguments).items() if key != "out"} | environment()
    (arguments.out / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    (arguments.out / "table.md").write_text(table(arguments.out))
    print(table(arguments.out))


if __name__ == "__main__":
    main()
