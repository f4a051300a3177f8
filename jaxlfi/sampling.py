"""Draws from the posterior of a finished run folder, in the parameters' natural units."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi import atomic, describe, run_store
from jaxlfi.belief import rejected
from jaxlfi.dataset import empty
from jaxlfi.estimator import Network, initialise, normalisers
from jaxlfi.posterior import draws_within
from jaxlfi.support import Support

LOG = "ln "
"""Prefix of the coordinates that are logarithms (`jaxlfi.task.Task.coordinates`)."""


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
    config = run_store.read_config(folder)
    if config.get("format") != run_store.RUN:
        raise run_store.StoreError(f"{folder}: expected the folder of one run, such as {folder / 'seed_000'}")
    belief = run_store.read_belief(folder)
    key = jax.random.key(seed)
    settings = describe.settings_from_json(config["settings"])
    if settings.estimator.is_flow:
        scale = Support(config["feasible_low"], config["feasible_high"]).hull(
            describe.support_from_json(config["support"])
        )
        x = jnp.asarray(atomic.read_arrays(folder / "observation.npz")["x"])
        network = read_network(folder / "network.npz", settings.estimator, scale, x.shape[0])
        draws, inside = draws_within(key, settings.estimator, network, x, scale, belief.support, n)
    else:
        draws = rejected(key, belief, n)
        inside = jnp.mean(belief.support.contains(belief.mixture.sample(key, n)))
    natural = np.array(draws, np.float64)
    names = []
    for d, name in enumerate(config["names"]):
        if name.startswith(LOG):
            natural[:, d] = np.exp(natural[:, d])
        names.append(name.removeprefix(LOG))
    return natural, names, float(inside)


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
    return jax.tree.unflatten(structure, [jnp.asarray(array) for array in found])
