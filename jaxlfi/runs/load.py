"""Draws from the posterior of a finished run folder, in the parameters' natural units."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.algorithm import Settings
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.dataset import empty
from jaxlfi.estimators.estimator import Network, initialise, normalisers
from jaxlfi.estimators.posterior import truncated_draws
from jaxlfi.io import files as atomic
from jaxlfi.io import serialise as describe
from jaxlfi.runs import folder as run_store

LOG = "ln "
"""Prefix of the coordinates that are logarithms (`jaxlfi.tasks.task.Task.coordinates`)."""


def posterior_samples(folder: Path, n: int, seed: int = 0) -> tuple[np.ndarray, list[str], float]:
    """`n` draws from a run's posterior, truncated to the support it ended with.

    A mixture density network's are drawn from its mixture, a flow's from the flow itself.

    Args:
        folder: of one run: what `infer` wrote, or one seed's folder of several.
        n: number of draws.
        seed: of the draws.

    Returns:
        The draws in natural units, shape [n, D], the parameters' names, and the share of the untruncated posterior
        that lies in the support.

    Raises:
        StoreError: for a folder that holds no finished run, or a damaged one.
        ValueError: for fewer than one draw.
    """
    if n < 1:
        raise ValueError(f"n: expected at least 1, got {n}")
    run = read_run(folder)
    draws, inside = run.draws(jax.random.key(seed), n)
    natural = np.array(draws, np.float64)
    names = []
    for d, name in enumerate(run.config["names"]):
        if name.startswith(LOG):
            natural[:, d] = np.exp(natural[:, d])
        names.append(name.removeprefix(LOG))
    return natural, names, float(inside)


@dataclasses.dataclass(frozen=True)
class Finished:
    """A finished run as its folder tells of it.

    Attributes:
        folder: where it was read from.
        config: config.json.
        settings: the numbers of the run.
        support: Theta_0.
        scale: the box the network's [-1, 1]^D stands for: Phi, widened by Theta_0.
        belief: the posterior and the support it ended with.
        observed: the observed trajectory, shape [T, C] or [T].
        x: its summary, shape [S].
    """

    folder: Path
    config: dict[str, Any]
    settings: Settings
    support: Support
    scale: Support
    belief: Belief
    observed: jax.Array
    x: jax.Array

    @functools.cached_property
    def network(self) -> Network | None:
        """Trained weights; None for an MDN's that were not kept.

        Raises:
            StoreError: where they are damaged, or a flow's are missing.
        """
        path = self.folder / "network.npz"
        if not self.settings.estimator.is_flow and not path.exists():
            return None
        return read_network(path, self.settings.estimator, self.scale, self.x.shape[0])

    def draws(self, key: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
        """`n` draws of the posterior in coordinates, truncated to its support, and its share in there."""
        estimator = self.settings.estimator
        network = self.network if estimator.is_flow else None
        return truncated_draws(key, estimator, network, self.x, self.scale, self.belief, n)


def read_run(folder: Path) -> Finished:
    """What `infer` left in a folder.

    Raises:
        StoreError: for a folder that holds no finished run, or a damaged one.
    """
    config = run_store.read_config(folder)
    if config.get("format") != run_store.RUN:
        one = next((lane["folder"] for lane in config.get("lanes", ())), "seed_000")
        raise run_store.StoreError(f"{folder}: expected the folder of one run, such as {folder / one}")
    if config.get("status", "finished") != "finished" or not (folder / "posterior.npz").exists():
        raise run_store.StoreError(f"{folder}: expected a finished run; go on with it by 'jaxlfi resume'")
    belief = run_store.read_belief(folder)
    settings = describe.settings_from_json(config["settings"])
    support = describe.support_from_json(config["support"])
    scale = Support(config["feasible_low"], config["feasible_high"]).hull(support)
    try:
        seen = atomic.read_arrays(folder / "observation.npz")
        observed, x = jnp.asarray(seen["trajectory"]), jnp.asarray(seen["x"])
    except (ValueError, KeyError) as error:
        raise run_store.StoreError(f"{folder / 'observation.npz'}: expected a whole observation: {error}") from error
    return Finished(folder, config, settings, support, scale, belief, observed, x)


def network_arrays(network: Network) -> dict[str, Any]:
    """A network as named arrays, by the places of its leaves."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(network)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def read_network(path: Path, estimator: Any, scale: Support, obs: int) -> Network:
    """The network that `network_arrays` told of.

    Raises:
        StoreError: where it is missing, damaged, or another estimator's.
    """
    nothing = empty(1, scale.dim, obs)
    like = Network(initialise(jax.random.key(0), estimator, scale.dim, obs), *normalisers(estimator, nothing, scale))
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    try:
        arrays = atomic.read_arrays(path)
        found = [arrays[jax.tree_util.keystr(place)] for place, _ in leaves]
    except (OSError, ValueError, KeyError) as error:
        raise run_store.StoreError(f"{path}: expected a whole network, got {error}") from error
    for (place, leaf), array in zip(leaves, found, strict=True):
        if leaf.shape != array.shape:
            raise run_store.StoreError(
                f"{path}: expected shape {leaf.shape} at {jax.tree_util.keystr(place)}, got {array.shape}"
            )
    with jax.ensure_compile_time_eval():  # so that it can be read, and kept, while a function is traced
        return jax.tree.unflatten(structure, [jnp.asarray(array) for array in found])
