"""load: read a run folder back as the run that `infer` returned."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.keys import key_of
from jaxlfi.bayessim.record import FINAL
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import validity
from jaxlfi.estimators.averages import LONG
from jaxlfi.estimators.base import Network, untrained
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.flows import PRECISION, SPREAD
from jaxlfi.estimators.inverse_regression import MANY
from jaxlfi.io import files as atomic
from jaxlfi.io import formats, trees, workfolder
from jaxlfi.io.formats import written_by
from jaxlfi.io.shell import quoted
from jaxlfi.io.workfolder import StoreError
from jaxlfi.registry import TASKS
from jaxlfi.runs import describe
from jaxlfi.runs import folder as folders
from jaxlfi.runs.result import Origin, PolishNotes
from jaxlfi.runs.run import Run
from jaxlfi.tasks import failures
from jaxlfi.tasks.executors import one_by_one
from jaxlfi.tasks.observation import with_gaps_of
from jaxlfi.tasks.task import Task

COEFFICIENTS = ".regression.coefficients"
"""Array in network.npz whose shape gives the number of statistics of a series: earlier versions had fewer."""
ESTIMATES = ".regression.inverse.directions"
"""Array in network.npz of networks that receive estimates from many numbers; earlier versions had none."""
KERNEL_ROWS = ".regression.parts[0][0].rows"
"""Array in network.npz with one row for each simulation that the kernel regression was fitted to."""
LINEAR_TERMS = tuple(f"['{name}']" for name in (PRECISION, SPREAD))
"""Endings of the names in network.npz of spline flows' linear maps and scales, which earlier versions lack."""
VALIDITY = ".validity"
"""Prefix of the names in network.npz of the learnt probability of success, which earlier versions lack."""


def load(folder: str | Path, task: Task | None = None) -> Run:
    """Read back a finished run of one seed, as written by `infer`, `run.save` or the command line.

    Args:
        folder: folder of one run, such as "runs/edge" or "runs/comparison/misspecified+edge/seed_000".
        task: the run's task, if it was made in Python and cannot be found by name.

    Raises:
        ValueError: for a folder that holds no finished run or a damaged one, or for another task.

    Example:
        >>> run = load("runs/demo/misspecified+edge/seed_000")  # doctest: +SKIP
        >>> run.posterior.sample(jax.random.key(0), 1000)  # doctest: +SKIP
    """
    try:
        folder = Path(folder)
    except TypeError as error:
        raise TypeError(f"folder: expected a path, got {type(folder).__name__}") from error
    config = folders.read_config(folder)
    if config["format"] != formats.RUN:
        one = next((run["folder"] for run in config.get("runs", ())), "seed_000")
        raise StoreError(f"{folder}: expected the folder of one run, such as {folder / one}")
    if not workfolder.is_finished(config) or not (folder / "posterior.npz").exists():
        raise StoreError(f"{folder}: expected a finished run; continue it with {quoted('jaxlfi', 'resume', folder)}")
    try:
        return _read(folder, config, task)
    except StoreError as error:
        if author := written_by(config):
            raise StoreError(f"{error}; {author} wrote the folder") from error
        raise


def _read(folder: Path, config: dict[str, Any], task: Task | None) -> Run:
    try:
        space = Space(tuple(config["parameters"]), tuple(config["log"]))
        settings = describe.settings_from_json(config["settings"])
        heuristic = describe.heuristic_from_json(config["heuristic"])
        support = describe.support_from_json(config["support"])
        if support.dim != space.dim:
            raise ValueError(f"support: expected bounds for {space.dim} parameters, got {support.dim}")
        feasible = Support(config["feasible_low"], config["feasible_high"]).hull(support)
        origin = Origin(
            config["task"],
            config["configuration"],
            config["support"]["name"],
            config["preset"],
            config.get("given_simulations"),
        )
        key = key_of(config["seed"])
        units = tuple(map(str, config["units"])) if config.get("units") is not None else None
        if units is not None and len(units) != space.dim:
            raise ValueError(f"units: expected one for each of the {space.dim} parameters, got {len(units)}")
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise StoreError(f"{folder / 'config.json'}: expected a complete description of the run: {error}") from error
    task = _task(folder, config, task, space)
    prior = _prior(folder, config, task, settings)
    observation = _arrays(folder / "observation.npz", ("trajectory", "x"))
    history = _arrays(folder / "history.npz", ("theta",))
    observed, x = _precise(observation["trajectory"]), _precise(observation["x"])
    if task is not None:
        task = with_gaps_of(task, observation["trajectory"], settings.estimator.embedding != "none")
    layout = tuple(map(int, observation.get("layout", (len(x), 1))))
    return Run(
        belief=_belief(folder / "posterior.npz", space),
        polish=_polish(folder / folders.POLISH),
        unpolished=_unpolished(folder / "posterior.npz", space),
        history=_records(history),
        dataset=_dataset(folder / "dataset.npz", settings),
        network=_network(folder / "network.npz", settings, layout, feasible, space, prior, config["version"]),
        observed=observed,
        x=x,
        key=key,
        support=support,
        feasible=feasible,
        heuristic=heuristic,
        settings=settings,
        space=space,
        task=task,
        origin=origin,
        units=units,
        failure_log=_failure_log(folder, history),
        reference=observation.get("reference"),
    )


def _failure_log(folder: Path, history: dict[str, np.ndarray]) -> failures.FailureLog:
    try:
        return failures.FailureLog([*map(str, history.get("reasons", ()))], failures.read(folder))
    except ValueError as error:
        raise StoreError(str(error)) from error


def _precise(array: np.ndarray) -> Any:
    """An array of JAX, or of NumPy for a host simulator's numbers in double precision."""
    return array if array.dtype == np.float64 else jnp.asarray(array)


def _task(folder: Path, config: dict[str, Any], given: Task | None, space: Space) -> Task | None:
    """The task of a run, if it is given or can be found; it must be the one that the run was made with."""
    task = given
    if task is None and config["task"] is not None:
        try:
            task = TASKS.load(config["task"])
        except ValueError:  # the posterior can be used without it
            return None
    if task is not None and (task.space != space or list(task.units) != list(config.get("units") or task.units)):
        raise StoreError(
            f"{folder}: expected the task as it was when the run was made, with parameters {list(space.labels)}, "
            f"got {list(task.space.labels)}"
        )
    if task is not None and config.get("one_by_one", False):
        return one_by_one(task, timeout=config["simulation_timeout"])
    return task


def _prior(folder: Path, config: dict[str, Any], task: Task | None, settings: Settings) -> Any:
    """The prior that a posterior needs, which is part of the task and not in any file."""
    if task is not None:
        return task.inference.prior
    needed = settings.estimator.is_likelihood or config.get("prior_bounded", False)
    if needed and config.get("prior") is not None:
        why = (
            "the posterior by a likelihood needs" if settings.estimator.is_likelihood else "is zero in parts of the box"
        )
        raise StoreError(f"{folder}: expected the task, whose prior ({config['prior']}) {why}: pass task=...")
    return None


def _polish(path: Path) -> PolishNotes | None:
    if not path.exists():
        return None
    try:
        found = atomic.read_json(path)
        return PolishNotes(
            tuple(map(str, found["sentences"])), tuple(map(str, found["steps"])), int(found["simulations"])
        )
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path}: expected how the posterior was polished, got a damaged file: {error}") from error


def _unpolished(path: Path, space: Space) -> Belief | None:
    """The belief before it was polished; None if it was not."""
    polished = any(name.startswith(folders.UNPOLISHED) for name in _arrays(path, ()))
    return _belief(path, space, folders.UNPOLISHED) if polished else None


def _belief(path: Path, space: Space, prefix: str = "") -> Belief:
    names = ("logits", "means", "scale_tril", "support_low", "support_high")
    arrays = _arrays(path, tuple(prefix + name for name in names))
    arrays = {name: arrays[prefix + name] for name in names}
    components, dim = arrays["logits"].size, space.dim
    shapes = (components,), (components, dim), (components, dim, dim), (dim,), (dim,)
    for name, shape in zip(names, shapes, strict=True):
        array = arrays[name]
        if array.shape != shape or array.dtype.kind not in "biuf" or np.isnan(array).any():
            raise StoreError(f"{path}: expected numbers {name} of shape {list(shape)}, got others")
    logits, means, scale_tril, low, high = (jnp.asarray(arrays[name]) for name in names)
    if not (low < high).all():
        raise StoreError(f"{path}: expected support_low below support_high, got others")
    return Belief(GaussianMixture(logits, means, scale_tril), Support(low, high), jnp.asarray(True))


def _records(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The record of the rounds: numeric arrays with one entry for each round, and those of the last round."""
    rounds = arrays["theta"].shape[:1]
    return {
        name: array
        for name, array in arrays.items()
        if array.dtype.kind not in "SU" and (name.startswith(FINAL) or array.shape[:1] == rounds)
    }


def _dataset(path: Path, settings: Settings) -> Dataset:
    arrays = _arrays(path, ("theta", "x", "round", "weight"))
    size = arrays["round"].size
    for name, axes in {"theta": 2, "x": 2, "round": 1, "weight": 1}.items():
        array = arrays[name]
        if array.ndim != axes or len(array) != size or array.dtype.kind not in "biuf":
            raise StoreError(f"{path}: expected {size} rows of numbers as {name}, got {list(array.shape)}")
    first = int(np.sum(arrays["round"] == 0))
    room = max(first, settings.simulations_per_round) + (settings.rounds - 1) * settings.simulations_per_round
    empty = max(room - size, 0)
    padded = lambda array: np.concatenate([array, np.zeros((empty, *array.shape[1:]), array.dtype)])
    filled = {name: _precise(padded(arrays[name])) for name in ("theta", "x", "weight")}
    return Dataset(round=jnp.asarray(padded(arrays["round"])), size=jnp.asarray(size, jnp.int32), **filled)


def _network(
    path: Path, settings: Settings, layout: tuple[int, ...], feasible: Support, space: Space, prior: Any, version: int
) -> Network | None:
    """The trained network; None if a mixture density network was not kept.

    Raises:
        StoreError: if it is damaged, is another estimator's, or is missing for a flow or a likelihood.
    """
    if not path.exists() and settings.estimator.closed_form:
        return None
    estimator, obs = settings.estimator.for_layout(layout), math.prod(layout)
    arrays = _arrays(path, ())
    rows = len(arrays[KERNEL_ROWS]) if KERNEL_ROWS in arrays else 1
    make: Callable[[], Network] = lambda: untrained(jax.random.key(0), estimator, obs, feasible, space, prior, rows)
    if any(name.startswith(VALIDITY) for name in arrays):
        plain, key = make, jax.random.key(0)
        make = lambda: plain().replace(validity=validity.unknown(key, feasible, space))
    template = jax.eval_shape(make)
    # Flows of earlier versions had equal weights.
    if ".log_weights" not in arrays and estimator.active_reduction == "none":
        template = template.replace(log_weights=None)
    for earlier in template.regression.of_earlier_versions(obs) if template.regression else ():
        if COEFFICIENTS in arrays and arrays[COEFFICIENTS].shape == earlier.coefficients.shape:
            template = template.replace(regression=earlier)
    if ESTIMATES not in arrays and getattr(template.regression, "inverse", None) is not None:
        raise StoreError(
            f"{path}: expected a network that sees estimates from its {MANY} numbers or more, got one of an earlier "
            "version: infer again"
        )
    expected = trees.named_leaves(template)
    nothing = {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in expected.items() if not leaf.size}
    lacking = nothing | _without_linear_terms(expected, arrays) | ({} if version > 2 else _counted_from_zero(expected))
    arrays = lacking | _arrays(path, tuple(name for name in expected if name not in lacking))
    for name, leaf in expected.items():
        if arrays[name].shape != leaf.shape:
            by_means = obs > LONG and estimator.active_reduction != "none"
            earlier = f"; earlier versions saw all of its {obs:,} numbers: infer again" if by_means else ""
            raise StoreError(f"{path}: expected shape {leaf.shape} at {name}, got {arrays[name].shape}{earlier}")
    return jax.tree.unflatten(jax.tree.structure(template), [jnp.asarray(arrays[name]) for name in expected])


def _without_linear_terms(
    expected: Mapping[str, jax.ShapeDtypeStruct], arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The linear terms that spline flows of earlier versions lack: zeros, which give the identity."""
    return {
        name: np.zeros(leaf.shape, leaf.dtype)
        for name, leaf in expected.items()
        if name.endswith(LINEAR_TERMS) and name not in arrays
    }


def _counted_from_zero(expected: Mapping[str, jax.ShapeDtypeStruct]) -> dict[str, np.ndarray]:
    """The origins and units that normalisers of format version 2 lack: zero, and the summaries' own units."""
    return {
        name: np.full(leaf.shape, name.endswith("unit"), leaf.dtype)
        for name, leaf in expected.items()
        if name.endswith(("normaliser.origin", "normaliser.unit"))
    }


def _arrays(path: Path, needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        arrays = atomic.read_arrays(path)
    except ValueError as error:
        raise StoreError(str(error)) from error
    if missing := [name for name in needed if name not in arrays]:
        raise StoreError(f"{path}: expected an array {missing[0]}, got none")
    return arrays
