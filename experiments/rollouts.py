"""The whip: several rollouts of one object, each under its own actions, combined into one posterior.

    python -m experiments.rollouts known --first-seed 0 --out experiments/results/rollouts
    python -m experiments.rollouts objects --first-seed 0 --out experiments/results/rollouts

`known` observes simulated DLOs inside Theta_0 once, twice and four times, and infers each with the settings of
`experiments.sim2sim`, EDGE and the detector `mask`. It compares two ways of combining the summaries of several rollouts
(the whip's option `pooling`) and four rollouts under the same actions. The first rollouts of an object are the same in
all candidates. Arrays that are there are not made again.

`objects` infers the four FEM reference objects with the same settings from one and from four recorded rollouts each
(envs/whip/data, and `experiments.reference_objects --seeds 1 2 3`), as `jaxlfi infer whip --object dlo-2 dlo-2-1.npz
dlo-2-2.npz dlo-2-3.npz` does for one object. All objects had the same actions, so they are run as one batch. Both write
a table and its arrays.
"""

import argparse
import csv
import io
import sys
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from experiments.sim2sim import HEURISTICS, SETTINGS
from experiments.widths import Cases, final_states, save
from jaxlfi.bayessim.batch import posterior_after
from jaxlfi.bayessim.settings import Settings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import INITIAL
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.real2sim import NUISANCES, whip_task
from jaxlfi.envs.whip.real2sim import task as load_task
from jaxlfi.envs.whip.reference_objects.objects import TABLE
from jaxlfi.envs.whip.reference_objects.objects import load as reference_object
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance
from jaxlfi.studies.calibration.repeat import described
from jaxlfi.tasks.simulation import trajectory_and_outcome
from jaxlfi.tasks.task import Task

CANDIDATES = {
    "1": ((0,), "all"),
    "2 all": ((0, 1), "all"),
    "2 mean": ((0, 1), "mean"),
    "4 all": ((0, 1, 2, 3), "all"),
    "4 mean": ((0, 1, 2, 3), "mean"),
    "4 same, mean": ((0, 0, 0, 0), "mean"),
}
"""Seeds of the rollouts' exploratory actions, and the pooling of their summaries."""
DRAWS = 500
WIDTH = np.array([110.0, np.log(50.0)])
"""Width of Theta_0 in length (mm) and ln E."""
RECORDED = Path(__file__).parent / "results" / "real2sim" / "rollouts"
"""Folder of the reference objects' further rollouts."""


def problem(seeds: tuple[int, ...], pooling: str) -> Task:
    """The whip under the actions of these seeds, through the side camera."""
    actions = np.stack([exploratory_actions(seed) for seed in seeds])
    parts = pick("native"), DETECTORS["mask"], NUISANCES["fixed"]
    return whip_task(*parts, actions[0] if len(seeds) == 1 else actions, pooling=pooling)


def truths(first: int, count: int) -> np.ndarray:
    """Lengths (mm) and moduli (Pa): uniform over Theta_0 in length and log-modulus, shape [count, 2]."""
    low, high = (np.array([1e3 * float(end[0]), np.log(float(end[1]))]) for end in (INITIAL.low, INITIAL.high))
    drawn = low + (high - low) * np.random.default_rng(first).uniform(size=(count, 2))
    return np.stack([drawn[:, 0], np.exp(drawn[:, 1])], axis=-1)


def cases(task: Task, first: int, count: int, most: tuple[int, ...], rollouts: int) -> Cases:
    """The cases of a candidate: for every truth, the first of the rollouts that all candidates share."""
    theta = task.space.to_inference(jnp.asarray(truths(first, count), jnp.float32))
    everything = problem(most, "all")
    observe = jax.jit(jax.vmap(lambda key, theta: trajectory_and_outcome(everything, key, theta)))
    seeds = first + np.arange(count)
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(1), jnp.asarray(seeds))
    observed, failure = observe(keys, theta)
    if np.any(failure):
        raise SystemExit(f"{int(np.sum(failure != 0))} of the observed simulations failed")
    observed = np.asarray(observed)[:, : observed.shape[1] // len(most) * rollouts]
    return Cases(seeds, np.asarray(theta), observed, np.asarray(jax.vmap(task.summary)(jnp.asarray(observed))))


def inferred(task: Task, settings: Settings, own: Cases, console: Console) -> dict[str, np.ndarray]:
    """Draws from the posteriors of all cases with EDGE from Theta_0, in one batch, and their final supports."""

    @jax.jit
    @jax.vmap
    def one(key, truth, x, state):
        return described(key, truth, posterior_after(settings.correction, state.reported, state.network, x), DRAWS)

    state, seconds = final_states(
        task, settings, task.support("initial"), HEURISTICS["edge"], own, len(own.seeds), console
    )
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(77), jnp.asarray(own.seeds))
    found = one(keys, own.theta, own.x, state) | {"low": state.belief.support.low, "high": state.belief.support.high}
    return jax.device_get(found) | {"seeds": own.seeds, "theta": own.theta, "seconds": np.asarray(seconds)}


def file_of(folder: Path, name: str) -> Path:
    """The file of a candidate's arrays."""
    return folder / f"{name.replace(', ', ' ').replace(' ', '-')}.npz"


def known(arguments: argparse.Namespace, console: Console) -> None:
    """Run all candidates on known truths."""
    for name in arguments.candidates:
        path = file_of(arguments.out, name)
        if path.exists():
            continue
        seeds, pooling = CANDIDATES[name]
        task, most = problem(seeds, pooling), (0, 0, 0, 0) if len(set(seeds)) < len(seeds) else (0, 1, 2, 3)
        own = cases(task, arguments.first_seed, arguments.truths, most, len(seeds))
        console.print(f"{name}, {arguments.truths} truths", highlight=False)
        save(path, inferred(task, SETTINGS, own, console), SETTINGS, actions=str(seeds), pooling=pooling)
    kept = [(name, file_of(arguments.out, name)) for name in CANDIDATES]
    write(arguments.out / "known.csv", [line(name, atomic.read_arrays(path)) for name, path in kept if path.exists()])


def line(name: str, arrays: dict[str, np.ndarray]) -> dict[str, object]:
    """A candidate's row of the table: means over truths, of length in mm and of ln E."""
    draws, theta = arrays["draws"], arrays["theta"]
    low, high = np.quantile(draws, [0.05, 0.95], axis=1)
    error, deviation = np.abs(draws.mean(axis=1) - theta), draws.std(axis=1)
    held = (low <= theta) & (theta <= high)
    columns = {"error": error.mean(axis=0), "median error": np.median(error, axis=0), "sd": deviation.mean(axis=0)}
    both = {
        f"{what} of {d}": float(values[i]) for what, values in columns.items() for i, d in enumerate(("mm", "ln E"))
    }
    inside = {f"{d} in 90 %": int(held[:, i].sum()) for i, d in enumerate(("length", "ln E"))}
    return {"rollouts": name, "truths": len(theta), **both, **inside, "seconds": float(arrays["seconds"]) / len(theta)}


def objects(arguments: argparse.Namespace, console: Console) -> None:
    """Run all candidates on the reference objects."""
    names = [dlo.name for dlo in TABLE]
    for candidate in arguments.candidates:
        path = file_of(arguments.out, f"objects {candidate}")
        if path.exists():
            continue
        seeds, pooling = CANDIDATES[candidate]
        tasks = [load_task((name, *further(name, seeds)), engine="native", pooling=pooling) for name in names]
        task = tasks[0]  # all had the same actions and camera
        sag = [[1e3 * reference_object(name).length, reference_object(name).light_young] for name in names]
        count = arguments.seeds
        observed = np.repeat(np.stack([one.observation for one in tasks]), count, axis=0)
        own = Cases(
            np.tile(arguments.first_seed + np.arange(count), len(names)),
            np.asarray(task.space.to_inference(jnp.repeat(jnp.asarray(sag, jnp.float32), count, axis=0))),
            observed,
            np.asarray(jax.vmap(task.summary)(jnp.asarray(observed))),
        )
        console.print(f"{candidate}, {len(own.seeds)} runs of reference objects", highlight=False)
        save(path, inferred(task, SETTINGS, own, console), SETTINGS, actions=str(seeds), pooling=pooling)
    kept = {name: file_of(arguments.out, f"objects {name}") for name in CANDIDATES}
    lines = [row for name, path in kept.items() if path.exists() for row in found(name, atomic.read_arrays(path))]
    write(arguments.out / "objects.csv", lines)


def further(name: str, seeds: tuple[int, ...]) -> list[str]:
    """The recordings of a reference object under the actions of these seeds, except 0, which has the object's name."""
    return [str(RECORDED / f"{name}-{seed}.npz") for seed in seeds if seed]


def found(candidate: str, arrays: dict[str, np.ndarray]) -> list[dict[str, object]]:
    """A row of the table for each run: medians and 90 % intervals, and the final support."""
    length, logs = np.moveaxis(np.quantile(arrays["draws"], [0.05, 0.5, 0.95], axis=1), -1, 0)
    stiffness = np.exp(logs) / 1e3
    each = len(arrays["theta"]) // len(TABLE)
    return [
        {
            "object": TABLE[i // each].name,
            "rollouts": candidate,
            "seed": int(arrays["seeds"][i]),
            "length at rest [mm]": round(float(theta[0])),
            "E by sag [kPa]": round(float(np.exp(theta[1])) / 1e3, 1),
            "length [mm]": f"{length[1, i]:.0f} [{length[0, i]:.0f}, {length[2, i]:.0f}]",
            "E [kPa]": f"{stiffness[1, i]:.1f} [{stiffness[0, i]:.1f}, {stiffness[2, i]:.1f}]",
            "holds E by sag": bool(logs[0, i] <= theta[1] <= logs[2, i]),
            "support E [kPa]": "[{:.2g}, {:.2g}]".format(*(np.exp(arrays[end][i, 1]) / 1e3 for end in ("low", "high"))),
        }
        for i, theta in enumerate(arrays["theta"])
    ]


def write(path: Path, lines: list[dict[str, object]]) -> None:
    """Write a table as .csv, and the command and versions as .json."""
    for row in lines:
        print(" | ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, lines[0])
    writer.writeheader()
    writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in lines)
    atomic.write_bytes(path, stream.getvalue().encode())
    command = provenance.command_line(["python", "-m", "experiments.rollouts", *sys.argv[1:]])
    atomic.write_json(path.with_suffix(".json"), provenance.environment() | {"command_line": command})


def main() -> None:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("known", "objects"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--candidates", nargs="+", choices=list(CANDIDATES), default=list(CANDIDATES))
    parser.add_argument("--truths", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=1000, help="0 to report, from 1000 to choose")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each object")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    {"known": known, "objects": objects}[arguments.what](arguments, Console(width=160))


if __name__ == "__main__":
    main()
