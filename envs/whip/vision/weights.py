"""Weights of vision's networks as files: what they are, how they were made, and their arrays. No pickles."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.vision.segmenter import BLOCK, Segmenter
from jaxlfi.envs.whip.vision.transporter import SIZE, Transporter
from jaxlfi.io import files, trees
from jaxlfi.io.formats import require_version

FORMAT, VERSION = "jaxlfi-whip-vision", 1
DATA = Path(__file__).parents[1] / "data"
"""Folder of the weights that come with the package."""
MODULES = {"segmenter": Segmenter, "transporter": Transporter}
SHIPPED = {name: DATA / f"{name}.npz" for name in MODULES}
"""The weights that come with the package."""
_HEADER = "header"


class WeightsError(ValueError):
    """Weights that are not there, damaged, or of another network or version."""


@dataclasses.dataclass(frozen=True)
class Weights:
    """A trained network.

    Attributes:
        module: the network.
        params: its weights.
        about: how they were made: command, seed, versions, figures.
    """

    module: Segmenter | Transporter
    params: Any
    about: Mapping[str, Any]


def initial(module: Segmenter | Transporter, key: jax.Array) -> Any:
    """Weights at the start of a training."""
    if isinstance(module, Segmenter):
        return module.init(key, jnp.zeros((1, 16 * BLOCK, 16 * BLOCK, 3)))
    nothing = jnp.zeros((1, SIZE, SIZE, module.channels))
    return module.init(key, nothing, nothing)


def save(path: Path, weights: Weights) -> None:
    """Write weights, in place of what is there."""
    kind = next(name for name, module in MODULES.items() if isinstance(weights.module, module))
    own = [field.name for field in dataclasses.fields(weights.module) if field.name not in ("parent", "name")]
    settings = {name: getattr(weights.module, name) for name in own}
    about = {"module": settings, "about": dict(weights.about)}
    header = {"format": FORMAT, "version": VERSION, "kind": kind, **about}
    arrays = trees.to_arrays(weights.params)
    files.write_arrays(path, {_HEADER: np.asarray(json.dumps(header))} | arrays)


def load(path: Path, kind: str) -> Weights:
    """Read weights.

    Args:
        path: their file.
        kind: "segmenter" or "transporter".

    Raises:
        WeightsError: for a file that is missing, damaged, of another network or another version.
    """
    try:
        arrays = files.read_arrays(path)
        header = json.loads(str(arrays.pop(_HEADER)))
        found = header["format"], header["version"], header["kind"]
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: expected the weights of a {kind}, got a missing or damaged file") from error
    if found[::2] != (FORMAT, kind):
        raise WeightsError(
            f"{path}: expected the weights of a {kind}, {FORMAT} version {VERSION}, got {found[0]} version {found[1]} "
            f"of a {found[2]}"
        )
    try:
        require_version(path, FORMAT, VERSION, found[1], header.get("about", {}))
    except ValueError as error:
        raise WeightsError(str(error)) from error
    try:
        settings = {
            name: tuple(value) if isinstance(value, list) else value for name, value in header["module"].items()
        }
        module = MODULES[kind](**settings)
        like = jax.eval_shape(lambda: initial(module, jax.random.key(0)))
        params = trees.from_arrays(arrays, like)
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: expected weights that fit their network: {error}") from error
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise WeightsError(f"{path}: expected finite weights, got others")
    return Weights(module, params, header["about"])
