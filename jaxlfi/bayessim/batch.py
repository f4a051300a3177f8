"""Lanes: many inference runs (configurations times seeds) stepped together as one compiled program.

A lane is one run: a support, a heuristic, a seed and an observation. Lanes differ in leaves only, so one
compiled `vmap` of `bayessim.step` serves them all, sharded over the local devices. Each lane has its own
keys: what it gives does not depend on which other lanes run beside it, but for the rounding of differently
batched arithmetic, which training amplifies from round to round. The same lanes on the same number of
devices repeat bit for bit.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim.algorithm import Settings, State
from jaxlfi.bayessim.algorithm import algorithm as bayessim
from jaxlfi.bayessim.keys import run_keys
from jaxlfi.bayessim.record import record
from jaxlfi.diagnostics import discrepancy
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Choice, Heuristic
from jaxlfi.tasks.task import Task

AXIS = "lanes"


@dataclasses.dataclass(frozen=True)
class Lane:
    """One run among several.

    Attributes:
        configuration: what the run is called in tables, such as "misspecified+edge".
        support_name: the support's name, or "own".
        support: Theta_0, in coordinates.
        heuristic: how it is adapted.
        seed: the run's seed.
    """

    configuration: str
    support_name: str
    support: Support
    heuristic: Heuristic
    seed: int


@struct.dataclass
class Inputs:
    """What a lane brings to the compiled program; stacked along a leading axis for several.

    Attributes:
        key: the run's key.
        support: Theta_0.
        heuristic: the rule, or a `Choice` among all lanes' rules.
        observed: the observed trajectory, shape [T, C] or [T].
        x: its summary x^r, shape [S].
    """

    key: jax.Array
    support: Support
    heuristic: Heuristic
    observed: Float[Array, "*shape"]
    x: Float[Array, "*batch obs"]


@runtime_checkable
class Engine(Protocol):
    """Steps all lanes by one round. Arrays that leave it have a leading axis of one entry a lane."""

    def start(self) -> State:
        """The state before the first round."""
        ...

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """The next state, and the round's record (`jaxlfi.bayessim.record.record`)."""
        ...


def stack_heuristics(rules: Sequence[Heuristic]) -> tuple[Heuristic, list[int | None]]:
    """Rules of several lanes as one stacked pytree.

    Rules of the same structure differ in leaves only. Where there are more structures than one, each lane
    gets a `Choice` of one rule of each structure and follows its own.

    Returns:
        The stacked rule, and for each lane its place in the choice (None without a choice).
    """
    structures = [_structure(rule) for rule in rules]
    kinds = list(dict.fromkeys(structures))
    if len(kinds) == 1:
        return stack(rules), [None] * len(rules)
    places = [kinds.index(structure) for structure in structures]
    examples = [rules[structures.index(kind)] for kind in kinds]
    choices = [
        Choice(index=place, rules=tuple(rule if place == slot else other for slot, other in enumerate(examples)))
        for rule, place in zip(rules, places, strict=True)
    ]
    return stack(choices), places


def stack_inputs(lanes: Sequence[Lane], observed: np.ndarray, x: np.ndarray) -> tuple[Inputs, list[int | None]]:
    """Inputs of all lanes, and each lane's place in the choice of heuristics.

    Args:
        lanes: the runs.
        observed: their observed trajectories, shape [L, T, C] or [L, T].
        x: the summaries, shape [L, S].
    """
    heuristic, places = stack_heuristics([lane.heuristic for lane in lanes])
    keys = jax.vmap(jax.random.key)(jnp.asarray([lane.seed for lane in lanes], jnp.uint32))
    support = stack([lane.support for lane in lanes])
    return Inputs(keys, support, heuristic, jnp.asarray(observed), jnp.asarray(x)), places


def start_one(task: Task, settings: Settings, lane: Inputs) -> State:
    """The state before the first round; the keys are those of `bayessim.run`."""
    key_init, _ = jax.random.split(run_keys(lane.key).run)
    return bayessim.init(key_init, task, lane.support, settings, lane.x)


def round_key(lane: Inputs, index: Int[Array, ""] | int) -> jax.Array:
    """The key of one round."""
    _, key_rounds = jax.random.split(run_keys(lane.key).run)
    return jax.random.fold_in(key_rounds, index)


def diagnose_key(lane: Inputs, index: Int[Array, ""] | int) -> jax.Array:
    """The key by which a round's posterior is compared with the truth."""
    return jax.random.fold_in(run_keys(lane.key).diagnose, index)


def round_one(
    task: Task, settings: Settings, lane: Inputs, state: State, index: Int[Array, ""] | int
) -> tuple[State, dict[str, Array]]:
    """One round of one lane, and how far its posterior is from the truth."""
    key = round_key(lane, index)
    state, info = bayessim.step(key, task, settings, lane.heuristic, lane.x, state, index)
    seen = discrepancy(diagnose_key(lane, index), task, info.belief, lane.observed, settings.restriction)
    return state, record(info, seen)


class LaneEngine:
    """All lanes as one compiled program: a `vmap` over lanes, sharded over the local devices."""

    def __init__(self, task: Task, settings: Settings, inputs: Inputs, devices: Sequence[Any] | None = None):
        """Prepare, without compiling.

        Args:
            task: a task whose simulator is in JAX.
            settings: the same for all lanes.
            inputs: stacked.
            devices: defaults to all local devices, at most one a lane.
        """
        self.lanes = inputs.x.shape[0]
        devices = (devices or jax.local_devices())[: self.lanes]
        self._mesh = Mesh(np.asarray(devices), (AXIS,))
        self._padded = len(devices) * math.ceil(self.lanes / len(devices))
        self._inputs = self.place(inputs)
        self._start = self._program(functools.partial(start_one, task, settings), (0,))
        self._round = self._program(functools.partial(round_one, task, settings), (0, 0, None), donate=(1,))

    def start(self) -> State:
        """The state before the first round."""
        return self._start(self._inputs)

    def compile(self, state: State) -> None:
        """Compile a round ahead of its first use, so that it can be timed by itself."""
        self._round = self._round.lower(self._inputs, state, jnp.asarray(0)).compile()

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every lane; `state` is consumed."""
        state, rows = self._round(self._inputs, state, jnp.asarray(index))
        rows = jax.device_get(rows)
        return state, {name: value[: self.lanes] for name, value in rows.items()}

    def fetch(self, state: State) -> State:
        """The state of the lanes on the host, without padding."""
        return jax.tree.map(lambda leaf: leaf[: self.lanes], jax.device_get(state))

    def place(self, tree: Any) -> Any:
        """Lay stacked lanes out over the devices, the last one repeated to fill them."""
        sharding = NamedSharding(self._mesh, PartitionSpec(AXIS))
        rows = np.minimum(np.arange(self._padded), self.lanes - 1)
        return jax.tree.map(lambda leaf: jax.device_put(jnp.asarray(leaf)[rows], sharding), tree)

    def _program(self, one, in_axes: tuple[int | None, ...], donate: tuple[int, ...] = ()):
        # The round's index is not batched: loops over minibatches then have one trip count for all lanes. And
        # lanes are divided by shard_map, as while-loops must not get predicates that cross devices.
        many = jax.vmap(one, in_axes=in_axes)
        if self._mesh.size > 1:
            specs = tuple(PartitionSpec() if axis is None else PartitionSpec(AXIS) for axis in in_axes)
            many = jax.shard_map(many, mesh=self._mesh, in_specs=specs, out_specs=PartitionSpec(AXIS), check_vma=False)
        return jax.jit(many, donate_argnums=donate)


def rounds(engine: Engine, state: State, first: int, last: int) -> Iterator[tuple[int, State, dict[str, np.ndarray]]]:
    """Step the rounds from `first` up to but not including `last`, yielding each as it ends."""
    for index in range(first, last):
        state, rows = engine.round(state, index)
        yield index, state, rows


def _structure(rule: Heuristic) -> tuple:
    leaves, treedef = jax.tree.flatten(rule)
    return treedef, tuple(np.shape(leaf) for leaf in leaves)


def stack(trees: Sequence[Any]) -> Any:
    """Pytrees of the same structure as one, with a leading axis: what `vmap` maps over.

    Example:
        >>> from jaxlfi.heuristics import Edge
        >>> stack([Edge(mass_threshold=tau) for tau in (0.005, 0.5)]).mass_threshold.shape
        (2,)
    """

    def leaf_stack(*leaves):
        array = np.stack([np.asarray(leaf) for leaf in leaves])
        return jnp.asarray(array)

    return jax.tree.map(leaf_stack, *trees)
