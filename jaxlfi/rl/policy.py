"""A trained policy as one file that NumPy alone can run.

This module imports neither jax nor Brax, so that a robot's computer needs neither.
"""

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from jaxlfi.io import files
from jaxlfi.io.formats import require_version

FORMAT, VERSION = "jaxlfi-policy", 1
ONE = np.float32(1)
UNIT = "unit_"
"""Prefix of the names of a recurrent unit's arrays in a file."""
TRAINED_ON = "trained_on"
"""Key of the trained ranges of parameters in a schema: `low`, `high` and `unit` of each."""
COLUMNS = ("names", "units", "centre", "scale")
"""Keys of the signals in a schema, each with one entry per number."""


class Named(Protocol):
    """Signals by their names and units."""

    @property
    def names(self) -> Sequence[str]:
        """Name of each number."""

    @property
    def units(self) -> Sequence[str]:
        """Unit of each number."""


@dataclasses.dataclass(frozen=True)
class Unit:
    """A gated recurrent unit, a policy's memory (`jaxlfi.rl.recurrent`) of H numbers from -1 to 1.

    With the observation x and the memory h, r and z = sigmoid(x W + b + h U) in the first two thirds of the columns,
    n = tanh(x W + b + r (h U + c)) in the last one, and the next memory is (1 - z) n + z h.

    Attributes:
        weight: W, shape [O - H, 3 H].
        bias: b, shape [3 H].
        memory_weight: U, shape [H, 3 H].
        memory_bias: c, shape [H].

    Raises:
        ValueError: for arrays of inconsistent shapes.
    """

    weight: np.ndarray
    bias: np.ndarray
    memory_weight: np.ndarray
    memory_bias: np.ndarray

    def __post_init__(self):
        size, seen = np.size(self.memory_bias), np.shape(self.weight)[:1]
        shapes = [(*seen, 3 * size), (3 * size,), (size, 3 * size), (size,)]
        if [np.shape(one) for one in self.arrays.values()] != shapes:
            raise ValueError(f"policy: expected a recurrent unit of {size} numbers, got arrays of other shapes")

    @staticmethod
    def of_flax(params: Mapping[str, Any]) -> "Unit":
        """The unit with the parameters of a `flax.linen.GRUCell`."""
        side = lambda kind, what: np.concatenate([params[kind + gate][what] for gate in "rzn"], axis=-1)
        return Unit(side("i", "kernel"), side("i", "bias"), side("h", "kernel"), np.asarray(params["hn"]["bias"]))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by the names of the attributes."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def size(self) -> int:
        """The number H of remembered values."""
        return len(self.memory_bias)


def remembered(unit: Unit, seen: Float[Any, "*batch obs"], xp: Any = np) -> Float[Any, "*batch obs"]:
    """The observation, followed by the next memory in place of the current one.

    Args:
        unit: recurrent unit of the policy.
        seen: scaled observation, followed by the memory.
        xp: NumPy, or `jax.numpy`.
    """
    observed, memory, size = seen[..., : -unit.size], seen[..., -unit.size :], unit.size
    given, kept = xp.matmul(observed, unit.weight) + unit.bias, xp.matmul(memory, unit.memory_weight)
    # Sigmoids by tanh, which does not overflow.
    reset, update = (0.5 + 0.5 * xp.tanh(0.5 * (given + kept)[..., k * size : (k + 1) * size]) for k in (0, 1))
    new = xp.tanh(given[..., 2 * size :] + reset * (kept[..., 2 * size :] + unit.memory_bias))
    return xp.concatenate([observed, (1 - update) * new + update * memory], axis=-1)


@dataclasses.dataclass(frozen=True)
class Policy:
    """A deterministic policy, from an observation to an action, both in their units.

    Scaled observations go through layers with tanh between them; the result is limited to [-1, 1] and scaled to the
    limits of the actions. A policy with memory has a recurrent unit before the layers: its observations and actions end
    with the memory, which is zero at first.

    Attributes:
        weights: weights of the layers, shapes [in, out].
        biases: biases of the layers, shapes [out].
        schema: description of the signals: `environment`, and `observations` and `actions` with their `names`, `units`,
            `centre` and `scale` (`jaxlfi.rl.environment.Signals`); `deployment`, what a robot must keep to
            (`jaxlfi.rl.deployment`); `preparation`, how observations are made from signals, and controls from actions
            (`jaxlfi.rl.preparation`); `trained_on`, the ranges of the parameters in training; and whatever else was
            recorded with the policy, such as `versions`.
        unit: recurrent unit of a policy with memory; None without memory.

    Raises:
        ValueError: for layers that do not match each other or the schema, numbers that are not finite, and a schema
            without the environment or the scaling.

    Example:
        >>> signals = {"names": ["x"], "units": ["m"], "centre": [1.0], "scale": [0.5]}
        >>> schema = {"environment": "line", "observations": signals, "actions": signals}
        >>> policy = Policy((np.array([[-1.0]]),), (np.array([0.5]),), schema)
        >>> policy([1.5]).tolist()
        [0.75]
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    schema: Mapping[str, Any]
    unit: Unit | None = None

    def __post_init__(self):
        _check_schema(self.schema)
        sizes = [len(self.observed["names"]), *(np.size(bias) for bias in self.biases)]
        actions = len(self.acted["names"]) - self.memory
        if self.unit is not None and len(self.unit.weight) + self.memory != sizes[0]:
            seen = sizes[0] - self.memory
            raise ValueError(f"policy: expected a recurrent unit that sees {seen} numbers, got one of others")
        shapes = [np.shape(weight) for weight in self.weights]
        flat = all(np.ndim(bias) == 1 for bias in self.biases)
        if shapes != list(itertools.pairwise(sizes)) or sizes[-1] != actions or not flat:
            raise ValueError(
                f"policy: expected layers from {sizes[0]} observations to {actions} actions, "
                f"got weights of shapes {shapes} and biases of shapes {[np.shape(bias) for bias in self.biases]}"
            )
        for array in (*self.weights, *self.biases, *(self.unit.arrays.values() if self.unit else ())):
            if np.asarray(array).dtype.kind not in "fiu" or not np.isfinite(array).all():
                raise ValueError("policy: expected layers of finite numbers, got others")

    @property
    def memory(self) -> int:
        """Number of remembered values."""
        return 0 if self.unit is None else self.unit.size

    @property
    def observed(self) -> Mapping[str, Any]:
        """The schema of observations."""
        return self.schema["observations"]

    @property
    def acted(self) -> Mapping[str, Any]:
        """The schema of actions."""
        return self.schema["actions"]

    def __call__(self, observation: Sequence[float] | np.ndarray) -> np.ndarray:
        """The action, float32 [..., A], for an observation [..., O]."""
        inputs, outputs = self.scaling
        layer = (np.asarray(observation, np.float32) - inputs[0]) / inputs[1]
        if self.unit is not None:
            layer = remembered(self.unit, layer)
            memory = layer[..., -self.memory :]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            layer = np.tanh(np.dot(layer, weight) + bias)
        # For so few numbers np.dot, maximum and minimum take half as long as @ and np.clip.
        action = np.dot(layer, self.weights[-1]) + self.biases[-1]
        action = np.minimum(np.maximum(action, -ONE), ONE)
        action = action if self.unit is None else np.concatenate([action, memory], axis=-1)
        return action * outputs[1] + outputs[0]

    def require(self, environment: str | None, observations: Named, actions: Named) -> "Policy":
        """Refuse a policy for another environment.

        Args:
            environment: name of the environment; None to accept any.
            observations: names and units of its observations, such as `jaxlfi.rl.environment.Signals`.
            actions: names and units of its actions, likewise.

        Raises:
            ValueError: saying what differs.
        """
        pairs = {"environment": (environment or self.schema["environment"], self.schema["environment"])}
        for what, signals in (("observations", observations), ("actions", actions)):
            pairs[what] = list(signals.names), list(self.schema[what]["names"])
            pairs[f"units of {what}"] = list(signals.units), list(self.schema[what]["units"])
        for what, (expected, got) in pairs.items():
            if expected != got:
                raise ValueError(f"policy: expected {what} {expected!r}, got one of {got!r}")
        return self

    def save(self, path: str | Path) -> Path:
        """Write an .npz: `weight_0`, `bias_0`, ... and the schema as JSON."""
        schema = {"format": FORMAT, "version": VERSION, **self.schema}
        arrays = {"schema": np.asarray(json.dumps(schema))}
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{index}": weight, f"bias_{index}": bias}
        if self.unit is not None:
            arrays |= {f"{UNIT}{name}": array for name, array in self.unit.arrays.items()}
        files.write_arrays(Path(path), arrays, compress=False, durable=True)
        return Path(path)

    @functools.cached_property
    def scaling(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Centre and scale of observations, float32 [O] each, and of actions, [A] each."""
        of = lambda signals: tuple(np.asarray(signals[name], np.float32) for name in ("centre", "scale"))
        return of(self.observed), of(self.acted)


def load(path: str | Path) -> Policy:
    """A policy from its file.

    Raises:
        ValueError: for a file that is missing, damaged, of another format or a newer version.
    """
    arrays, schema = read(path, FORMAT, VERSION)
    count = sum(name.startswith("weight_") for name in arrays)
    try:
        layers = [(arrays[f"weight_{index}"], arrays[f"bias_{index}"]) for index in range(count)]
        weights, biases = zip(*layers, strict=True)
        unit = {name.removeprefix(UNIT): array for name, array in arrays.items() if name.startswith(UNIT)}
        return Policy(weights, biases, schema, Unit(**unit) if unit else None)
    except TypeError as error:
        raise ValueError(f"{path}: expected a complete policy, got other arrays of a recurrent unit") from error
    except (KeyError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: expected a complete policy, got: {error}") from error


def read(path: str | Path, kind: str, version: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and schema of a policy's .npz, in whichever form it holds the policy.

    Args:
        path: the file.
        kind: format that its schema must name.
        version: version of this format.

    Raises:
        ValueError: for a file that is missing, damaged, of another format or version.
    """
    arrays = files.read_arrays(Path(path))
    try:
        schema = json.loads(str(arrays["schema"]))
        got, its_version = schema.pop("format"), schema.pop("version")
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a policy that jaxlfi saved, got an .npz without its schema") from error
    if got != kind:
        raise ValueError(f"{path}: expected {kind} of version {version}, got {got} of version {its_version}")
    require_version(path, kind, version, its_version, schema)
    return arrays, schema


def _check_schema(schema: Mapping[str, Any]) -> None:
    """Refuse a schema with which a policy cannot act.

    Raises:
        ValueError: for one without the environment's name, or whose signals lack equal numbers of names, units, finite
            centres and positive scales.
    """
    if not isinstance(schema.get("environment"), str):
        raise ValueError(f"environment: expected a name in the schema, got {schema.get('environment')!r}")
    for what in ("observations", "actions"):
        signals = schema.get(what)
        columns = [signals.get(name) for name in COLUMNS] if isinstance(signals, Mapping) else [None]
        if not all(isinstance(column, list | tuple) for column in columns):
            raise ValueError(f"{what}: expected {', '.join(COLUMNS)} in the schema, got {signals!r}")
        names, units, centre, scale = columns
        if not len(names) == len(units) == len(centre) == len(scale):
            raise ValueError(f"{what}: expected as many of {', '.join(COLUMNS)}, got {[len(one) for one in columns]}")
        if not all(_is_number(number) for number in (*centre, *scale)) or not all(number > 0 for number in scale):
            raise ValueError(f"{what}: expected finite centres and positive scales, got {centre} and {scale}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and math.isfinite(value)
