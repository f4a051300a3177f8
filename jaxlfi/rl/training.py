"""Parallel trainings: domains times seeds as one compiled program, in a folder that can be resumed.

config.json domains.npz start.npz      the request, the points for training and evaluation, and an earlier policy if
                                       trainings start from one
checkpoint.npz                         while it runs: all trainings, and their learning curves so far
curves.npz table.csv                   learning curves; performance of each policy on its own domain
DOMAIN/seed_000/policy.npz ...         the policies (`jaxlfi.rl.policy`)
DOMAIN/seed_000/events...              if they were requested (`jaxlfi.rl.tensorboard`)
"""

import contextlib
import csv
import dataclasses
import functools
import io
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxlfi.bayessim.programs import side_by_side
from jaxlfi.io import files, formats, provenance, serialise, trees, workfolder
from jaxlfi.io.formats import TRAINING
from jaxlfi.io.processes import ALONE, Partition, Processes
from jaxlfi.io.workfolder import StoreError
from jaxlfi.rl import fine_tuning, ppo
from jaxlfi.rl.domains import POOL, Domain, Draw
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.policy import TRAINED_ON, Policy, load
from jaxlfi.rl.ppo import Training, Update
from jaxlfi.rl.settings import PPO
from jaxlfi.runs.execute import devices_of

HELD_OUT = 128
"""Number of held-out points of each domain on which its policies are evaluated."""
MAX_CHUNK = 16
"""Largest number of updates between two checkpoints."""
NOT_FACTS = ("value", "steps", "theta")
"""Arrays of `outcomes` other than the facts that an environment reports of an episode."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """A plan of trainings.

    Attributes:
        reference: name by which the environment is found (`jaxlfi.registry.ENVIRONMENTS`); None for one made in Python.
        environment: environment to train in.
        settings: settings of PPO.
        preset: name of the preset that the settings were made from, or None.
        domains: functions that draw the points of each domain, by the domain's name.
        seeds: seeds of the trainings on each domain.
        tensorboard: whether the learning curves are also written for TensorBoard (`jaxlfi.rl.tensorboard`).
        start: earlier policy from which all trainings start (`jaxlfi.rl.fine_tuning`).
    """

    reference: str | None
    environment: Environment
    settings: PPO
    preset: str | None
    domains: Mapping[str, Draw]
    seeds: tuple[int, ...]
    tensorboard: bool = False
    start: Policy | None = None


@dataclasses.dataclass(frozen=True)
class Result:
    """Results of trainings, which are ordered by domain, and by seed within a domain.

    Attributes:
        names: domain and seed of each of the R trainings.
        curves: metrics of each update, by the names of `ppo.Update`, shape [updates, R].
        outcomes: returns and facts of the deterministic policies at held-out points of their domains, shape [R, M].
        params: final parameters of the networks, stacked.
    """

    names: tuple[tuple[str, int], ...]
    curves: Mapping[str, np.ndarray]
    outcomes: Mapping[str, np.ndarray]
    params: Any

    def fared(self, place: int) -> dict[str, float]:
        """The performance of one policy at the held-out points, and at the start of its training.

        Returns:
            The mean return, that of the worst tenth of the points, the mean return of the first update in which an
            episode ended (NaN if there was none), and the mean of each fact.
        """
        values = np.asarray(self.outcomes["value"][place])
        learning = np.asarray(self.curves["value"])[:, place]
        known = learning[np.isfinite(learning)]
        worst = np.sort(values)[: max(len(values) // 10, 1)]
        facts = {name: float(np.mean(value[place])) for name, value in self.outcomes.items() if name not in NOT_FACTS}
        first = float(known[0]) if len(known) else math.nan
        return {"return": float(values.mean()), "worst tenth": float(worst.mean()), "at first": first} | facts


def begin(plan: Plan, out: Path, processes: Processes = ALONE) -> None:
    """Make the folder of a training, with all that is needed to resume it.

    Args:
        plan: plan of the trainings.
        out: folder of the training.
        processes: processes that share the trainings; the one that writes calls this.

    Raises:
        StoreError: if something is there already.
        ValueError: if there are more processes than trainings, and for an initial policy that does not fit.
    """
    first = None if plan.start is None else fine_tuning.started(plan.start, plan.environment, plan.settings)
    names = [(domain, seed) for domain in plan.domains for seed in plan.seeds]
    points = POOL if plan.settings.redrawn else plan.settings.environments
    drawn = []
    for name, seed in names:
        key_trained, key_held_out, *_ = _keys(jax.random.key(seed))
        drawn.append((plan.domains[name](key_trained, points), plan.domains[name](key_held_out, HELD_OUT)))
    arrays = {
        "trained": np.stack([np.asarray(domain.theta) for domain, _ in drawn]),
        "held_out": np.stack([np.asarray(domain.theta) for _, domain in drawn]),
        "parameters": np.asarray(plan.environment.space.names),
        "units": np.asarray(plan.environment.units),
    }
    config = {
        "format": TRAINING,
        "version": formats.FORMATS[TRAINING].version,
        "environment": plan.reference,
        "environment_name": plan.environment.name,
        "reward": getattr(plan.environment, "reward", None),
        "preset": plan.preset,
        "settings": serialise.fields_to_json(plan.settings, serialise.class_name),
        "trainings": [{"domain": domain, "seed": seed} for domain, seed in names],
        "tensorboard": plan.tensorboard,
        "start": first is not None,
        "devices": devices_of(len(names), processes),
        "processes": processes.count,
        **provenance.environment(),
    }

    def fill(staging: Path) -> None:
        files.write_sealed(staging / "domains.npz", arrays)
        if first is not None:
            first.save(staging / "start.npz")

    workfolder.create(out, config, fill)


def resumed(
    out: Path,
    environment: Environment,
    on_chunk: Callable[[int, Mapping[str, np.ndarray]], Any],
    processes: Processes = ALONE,
) -> Result | None:
    """Train, from the beginning or from the last checkpoint, to the end.

    Args:
        out: folder that `begin` made; with several processes, only the one that writes needs it.
        environment: environment of the folder.
        on_chunk: called after each checkpoint by the process that writes it, with the number of updates since the last
            one and the curves so far.
        processes: processes that share the trainings.

    Returns:
        Results of the trainings, which are in the folder as well; None if another process writes.

    Raises:
        StoreError: for a folder that is not a training, is damaged, or has another environment.
    """
    config = processes.broadcast_json(read_config(out) if processes.writes else None)
    settings = settings_of(config)
    names = tuple((one["domain"], one["seed"]) for one in config["trainings"])
    if config["environment_name"] != environment.name:
        raise StoreError(f"{out}: expected a training of {environment.name}, got one of {config['environment_name']}")
    if (known := config.get("reward")) != (own := getattr(environment, "reward", None)) and known is not None:
        raise StoreError(f"{out}: expected a training with the reward {own}, got one with {known}")
    points = _read(out / "domains.npz") if processes.writes else dict.fromkeys(("trained", "held_out"), 0)
    trained, held_out = processes.broadcast((points["trained"], points["held_out"]))
    # Stacked as raw data: jax's key-reuse checker counts the stacking of keys as their use.
    seeds = np.stack([jax.random.key_data(jax.random.key(seed)) for _, seed in names])
    keys = jax.vmap(_keys)(jax.random.wrap_key_data(jnp.asarray(seeds)))
    learning, evaluating = keys[:, 2], keys[:, 3]

    partition = Partition(processes, len(names), jax.local_device_count())
    mesh = Mesh(np.asarray(jax.local_devices()[: partition.devices]), ("trainings",))
    chunk = min(MAX_CHUNK, settings.updates)
    first = processes.broadcast_json(_first_layers(out, config) if processes.writes else None)
    start = functools.partial(_start, environment, settings, first)
    some = side_by_side(functools.partial(_some, environment, settings, chunk), mesh, (None, 0))
    fares = side_by_side(functools.partial(_fares, environment, settings), mesh, (0, 0, 0))

    given = learning, jnp.asarray(trained)
    state = jax.jit(side_by_side(start, mesh, (0, 0)))(*partition.local(given))
    done, curves, saved = 0, {}, trees.to_arrays(state)
    checkpoint = out / "checkpoint.npz"
    if processes.writes and checkpoint.exists():
        done, curves, saved = _read_checkpoint(checkpoint, jax.eval_shape(jax.vmap(start), *given))
    done = int(processes.broadcast(np.asarray(done)))
    if done:
        state = trees.from_arrays(partition.scatter(saved), state)
    advance = jax.jit(some, donate_argnums=1)
    while done < settings.updates:
        began, count = time.monotonic(), min(chunk, settings.updates - done)
        state, made = advance(count, state)
        done += count
        rows, saved = partition.gather((_rows(made), trees.to_arrays(state)))
        if processes.writes:
            rows["seconds"] = np.full((len(names), chunk), (time.monotonic() - began) / count)
            rows = {name: row[:, :count].T for name, row in rows.items()}
            curves = {name: np.concatenate([curves[name], row]) if curves else row for name, row in rows.items()}
            _write_checkpoint(checkpoint, done, curves, saved)
            on_chunk(count, curves)

    outcomes = jax.jit(fares)(*partition.local((evaluating, jnp.asarray(held_out))), state.params)
    outcomes, params = partition.gather((outcomes, state.params))
    if not processes.writes:
        return None
    result = Result(names, curves, {name: np.asarray(value) for name, value in outcomes.items()}, params)
    _write_result(out, environment, config, result)
    clean(out)
    return result


def read_config(out: Path) -> dict[str, Any]:
    """The config.json of a training.

    Raises:
        StoreError: for folders that are not trainings.
    """
    config = workfolder.read(out, TRAINING)
    try:
        settings_of(config)
        domains, seeds = zip(*((one["domain"], one["seed"]) for one in config["trainings"]), strict=True)
        texts = all(isinstance(text, str) for text in (*domains, config["environment_name"]))
        if not texts or not all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds):
            raise ValueError("names or seeds that are none")
        config["environment"], config["versions"]
    except (KeyError, TypeError, ValueError) as error:
        what = "a complete description of a training"
        raise StoreError(f"{out / 'config.json'}: expected {what}, got: {error}") from error
    return config


def settings_of(config: Mapping[str, Any]) -> PPO:
    """The settings of a training from its config.json."""
    return serialise.made_of(PPO, "settings", config["settings"], serialise.dataclass_of)


def updates_done(out: Path) -> int:
    """Number of updates in the checkpoint of a training."""
    return int(_read(out / "checkpoint.npz")["done"]) if (out / "checkpoint.npz").exists() else 0


def clean(out: Path) -> None:
    """Remove what only unfinished trainings need from a finished folder, if it is writable."""
    with contextlib.suppress(OSError):
        (out / "checkpoint.npz").unlink(missing_ok=True)


def finished(out: Path) -> bool:
    """Whether the trainings of a folder are finished."""
    return (out / "table.csv").exists()


def _keys(key: jax.Array) -> jax.Array:
    """Keys of a training: for the training points, the held-out points, the training and the evaluation."""
    return jax.random.split(key, 4)


def _first_layers(out: Path, config: Mapping[str, Any]) -> list[Any] | None:
    """Weights and biases of the policy from which trainings start, as lists; None if each draws its own."""
    if not config.get("start"):
        return None
    try:
        first = load(out / "start.npz")
    except ValueError as error:
        raise StoreError(str(error)) from error
    return [[weight.tolist(), bias.tolist()] for weight, bias in zip(first.weights, first.biases, strict=True)]


def _start(
    environment: Environment, settings: PPO, layers: list[Any] | None, key: jax.Array, theta: jax.Array
) -> Training:
    return ppo.init(key, environment, settings, Domain(theta), layers)


def _some(
    environment: Environment, settings: PPO, updates: int, count: int, state: Training
) -> tuple[Training, Update]:
    return ppo.train(environment, settings, state, updates, count)


def _fares(environment: Environment, settings: PPO, key: jax.Array, theta: jax.Array, params: Any) -> dict[str, Any]:
    act = ppo.deterministic(environment, settings, params)
    outcomes = evaluate(key, environment, act, Domain(theta))
    return {"value": outcomes.value, "steps": outcomes.steps, "theta": theta} | outcomes.facts


def _rows(made: Update) -> dict[str, np.ndarray]:
    made = jax.device_get(made)
    plain = {"value": made.value, "length": made.length, "episodes": made.episodes}
    return {**plain, **made.facts, **{f"loss/{name}": value for name, value in made.losses.items()}}


# ------------------------------------------------------------------------------------------------------------- files


def _write_checkpoint(path: Path, done: int, curves: Mapping[str, np.ndarray], state: Mapping[str, np.ndarray]) -> None:
    parts = {"curve/": curves, "state": state}
    named = {prefix + name: array for prefix, part in parts.items() for name, array in part.items()}
    files.write_sealed(path, {"done": np.asarray(done)} | named)


def _read_checkpoint(path: Path, like: Training) -> tuple[int, dict[str, np.ndarray], dict[str, np.ndarray]]:
    arrays = _read(path)
    try:
        state = trees.to_arrays(trees.from_arrays(arrays, like, "state"))
    except ValueError as error:
        raise StoreError(f"{path}: {error}") from error
    curves = {name.removeprefix("curve/"): row for name, row in arrays.items() if name.startswith("curve/")}
    return int(arrays["done"]), curves, state


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        return files.read_sealed(path)
    except ValueError as error:
        raise StoreError(str(error)) from error


def _write_result(out: Path, environment: Environment, config: Mapping[str, Any], result: Result) -> None:
    files.write_arrays(out / "curves.npz", dict(result.curves), durable=True)
    files.write_arrays(out / "outcomes.npz", dict(result.outcomes), durable=True)
    facts, trained = [name for name in result.outcomes if name not in NOT_FACTS], _read(out / "domains.npz")["trained"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["domain", "seed", "return", *facts])
    for place, (domain, seed) in enumerate(result.names):
        folder = out / domain / f"seed_{seed:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        params = jax.tree.map(lambda leaf, place=place: leaf[place], result.params)
        recorded = {"reference": config["environment"], "domain": domain, "seed": seed, "versions": config["versions"]}
        recorded |= {"reward": config["reward"]} if config.get("reward") else {}
        recorded[TRAINED_ON] = {
            name: {"low": float(column.min()), "high": float(column.max()), "unit": unit}
            for name, unit, column in zip(environment.space.names, environment.units, trained[place].T, strict=True)
        }
        ppo.as_file(environment, params, **recorded).save(folder / "policy.npz")
        means = [float(np.mean(result.outcomes[name][place])) for name in ("value", *facts)]
        writer.writerow([domain, seed, *(f"{mean:.4f}" for mean in means)])
    files.write_bytes(out / "table.csv", text.getvalue().encode(), durable=True)
