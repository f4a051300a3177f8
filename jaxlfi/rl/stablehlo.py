"""Policies as StableHLO: one file with a program for cpu, cuda and tpu, and the policy's schema.

The file is an .npz without pickles: `program`, the bytes serialised by `jax.export`, and `schema` as JSON.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float

from jaxlfi.io import files
from jaxlfi.rl.evaluation import acting, layers_of
from jaxlfi.rl.policy import Policy, read

try:
    import flatbuffers  # noqa: F401
except ImportError as error:
    raise ImportError("a StableHLO file needs the package flatbuffers: pip install 'jaxlfi[stablehlo]'") from error

FORMAT, VERSION = "jaxlfi-policy-stablehlo", 1
PLATFORMS = ("cpu", "cuda", "tpu")


@dataclasses.dataclass(frozen=True)
class Program:
    """A policy's program.

    Attributes:
        exported: maps observations float32 [batch, O] to actions float32 [batch, A], both in their units.
        schema: schema of the policy.
    """

    exported: export.Exported
    schema: Mapping[str, Any]

    def __call__(self, observation: Float[Array, "*batch obs"]) -> Float[Array, "*batch act"]:
        """The action, in its units, for an observation in its units; it can be jitted, but not vmapped."""
        observation = jnp.asarray(observation, jnp.float32)
        rows = self.exported.call(observation.reshape(-1, observation.shape[-1]))
        return rows.reshape(*observation.shape[:-1], rows.shape[-1])


def save(policy: Policy, path: str | Path) -> None:
    """Write a policy's program for any batch size."""
    size = len(policy.observed["names"])
    rows = jax.ShapeDtypeStruct((export.symbolic_shape("batch")[0], size), jnp.float32)
    act = acting(jax.tree.map(lambda array: np.asarray(array, np.float32), layers_of(policy)))
    with jax.default_matmul_precision("highest"):  # accelerators otherwise multiply matrices with 10 bits
        write(path, act, rows, {"format": FORMAT, "version": VERSION, **policy.schema})


def write(path: str | Path, function: Callable, given: jax.ShapeDtypeStruct, schema: Mapping[str, Any]) -> None:
    """Write a function of one array as a program for all platforms, with its schema."""
    program = export.export(jax.jit(function), platforms=PLATFORMS)(given)
    arrays = {"schema": np.asarray(json.dumps(schema)), "program": np.frombuffer(program.serialize(), np.uint8)}
    files.write_arrays(Path(path), arrays, compress=False, durable=True)


def load(path: str | Path) -> Program:
    """A policy's program from its file.

    Raises:
        ValueError: for a file that is missing, damaged, of another format or a newer version.
    """
    arrays, schema = read(path, FORMAT, VERSION)
    try:
        return Program(export.deserialize(bytearray(arrays["program"].tobytes())), schema)
    except Exception as error:  # flatbuffers raises many kinds of errors for other bytes
        raise ValueError(f"{path}: expected a program of jax.export, got {type(error).__name__}: {error}") from error
