"""Objects of known truth, and the domains that each arm of the study is trained on."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxlfi
from jaxlfi.bayessim.presets import settings_for
from jaxlfi.cli.domains import domain
from jaxlfi.envs.whip.environment import WhipEnvironment
from jaxlfi.envs.whip.real2sim import task
from jaxlfi.io import files
from jaxlfi.rl.domains import Domain, Draw, point
from jaxlfi.tasks.simulation import trajectory_and_outcome
from jaxlfi.tasks.task import Task

SEED = 2026
"""Seed of the objects."""
OBJECTS = tuple(f"object-{i:02d}" for i in range(12))
BROAD: Mapping[str, str] = {"guess": "uniform", "wide": "uniform:feasible", "history": "uniform:feasible"}
"""Arms that do not depend on an object, with their domains as named by `jaxlfi train`."""
HEURISTICS: Mapping[str, str] = {"posterior": "edge", "fixed": "none"}
"""Arms that are trained on a posterior, with the heuristic that adapts its support."""


@functools.cache
def whip() -> Task:
    """The task of inferring length and modulus from one whip."""
    return task()


def truths() -> Float[np.ndarray, "objects 2"]:
    """Lengths (mm) and moduli (Pa), uniform over Phi in length and ln E."""
    box = whip().space.box_to_inference(whip().feasible)
    drawn = np.random.default_rng(SEED).uniform(np.asarray(box.low), np.asarray(box.high), (len(OBJECTS), 2))
    return np.asarray(whip().space.to_natural(drawn), float)


def recordings() -> Float[np.ndarray, "objects time channels"]:
    """One whip of each object under the exploratory actions, as the camera sees it; nuisances are those of mu.

    Raises:
        RuntimeError: if a simulation became unstable.
    """
    keys = jax.random.split(jax.random.key(1), len(OBJECTS))
    theta = whip().space.to_inference(jnp.asarray(truths(), jnp.float32))
    rows, failure = jax.jit(jax.vmap(functools.partial(trajectory_and_outcome, whip())))(keys, theta)
    if np.any(failure):
        raise RuntimeError(f"recordings: expected stable simulations, got failures {np.asarray(failure).tolist()}")
    return np.asarray(rows)


def infer(folder: Path, arm: str) -> None:
    """Infer the posteriors of all objects, one run each; finished runs are kept, and interrupted ones continued.

    Args:
        folder: folder of the study.
        arm: one of `HEURISTICS`.
    """
    for name, recording in zip(OBJECTS, recordings(), strict=True):
        jaxlfi.infer(
            0, whip(), recording, support="initial", heuristic=HEURISTICS[arm], settings=settings_for(whip()),
            out=run_folder(folder, arm, name),
        )  # fmt: skip
        print(f"{arm} of {name}", flush=True)


def run_folder(folder: Path, arm: str, name: str) -> Path:
    """The folder of an object's inference."""
    return folder / "runs" / "posteriors" / arm / name


def draws(folder: Path, environment: WhipEnvironment, arm: str) -> dict[str, Draw]:
    """Functions that draw the points that an arm's policies are trained on, by the names of their domains.

    Args:
        folder: folder of the study.
        environment: environment to train in.
        arm: "oracle", or one of `BROAD` or `HEURISTICS`.
    """
    if arm in BROAD:
        return {arm: domain(environment, BROAD[arm])[1]}
    if arm == "oracle":
        at: Callable[[np.ndarray], Draw] = lambda theta: lambda key, n: point(theta, n)
        return {f"{arm}-{name}": at(theta) for name, theta in zip(OBJECTS, truths(), strict=True)}
    return {f"{arm}-{name}": domain(environment, str(run_folder(folder, arm, name)))[1] for name in OBJECTS}


def drawn(folder: Path, arm: str) -> dict[str, Draw]:
    """Functions that return only the points that an arm's policies were trained on in an earlier pass.

    Args:
        folder: folder of that pass.
        arm: one of `HEURISTICS`.
    """
    points = files.read_arrays(folder / "learning.npz")[f"{arm}/trained"][: len(OBJECTS)]
    of_object: Callable[[np.ndarray], Draw] = lambda own: lambda key, n: Domain(jnp.resize(own, (n, own.shape[1])))
    return {f"{arm}-{name}": of_object(own) for name, own in zip(OBJECTS, points, strict=True)}
