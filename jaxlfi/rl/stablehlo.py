"""Policies as StableHLO: one file with a compiled program's source for cpu, cuda and tpu, and the policy's schema.

The file is an .npz without pickles: `program`, what `jax.export` serialised, as bytes, and `schema` as JSON.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float

from jaxlfi.io import files
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
        schema: of the policy.
    """

    exported: export.Exported
    schema: Mapping[str, Any]

    def __call__(self, observation: Float[Array, "*batch obs"]) -> Float[Array, "*batch act"]:
        """The action, in its units, for an observation in its units; it can be jitted, not vmapped over."""
        observation = jnp.asarray(observation, jnp.float32)
        rows = self.exported.call(observation.reshape(-1, observation.shape[-1]))
        return rows.reshape(*observation.shape[:-1], rows.shape[-1])


def save(policy: Policy, path: str | Path) -> None:
    """Write a policy's program for any batch size."""
    size = len(policy.observed["names"])
    rows = jax.ShapeDtypeStruct((export.symbolic_shape("batch")[0], size), jnp.float32)
    program = export.export(jax.jit(lambda observation: _act(policy, observation)), platforms=PLATFORMS)(rows)
    schema = {"format": FORMAT, "version": VERSION, **policy.schema}
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
    except Exception as error:  # flatbuffers has many for bytes that are none of its own
        raise ValueError(f"{path}: expected a program of jax.export, got {type(error).__name__}: {error}") from error


def _act(policy: Policy, observation: Float[Array, "batch obs"]) -> Float[Array, "batch act"]:
    scaling = lambda signals, name: jnp.asarray(signals[name], jnp.float32)
    # Highest precision, as accelerators otherwise multiply matrices with 10 bits.
    product = lambda layer, weight: jnp.matmul(layer, jnp.asarray(weight, jnp.float32), precision="highest")
    layer = (observation - scaling(policy.observed, "centre")) / scaling(policy.observed, "scale")
    for weight, bias in zip(policy.weights[:-1], policy.biases[:-1], strict=True):
        layer = jnp.tanh(product(layer, weight) + jnp.asarray(bias, jnp.float32))
    action = jnp.clip(product(layer, policy.weights[-1]) + jnp.asarray(policy.biases[-1], jnp.float32), -1.0, 1.0)
    return action * scaling(policy.acted, "scale") + scaling(policy.acted, "centre")
