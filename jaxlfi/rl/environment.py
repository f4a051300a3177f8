"""Environments with unknown parameters theta, and the signals that they exchange with policies."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support


@dataclasses.dataclass(frozen=True)
class Signals:
    """Names, units and scaling of the numbers that an environment and a policy exchange.

    A policy works with `(value - centre) / scale`. The scaling is part of the environment and not learnt: with running
    statistics, a flag that has never been raised would be scaled to a million when it is raised for the first time.

    Attributes:
        names: name of each number.
        units: unit of each number; "" without one.
        centre: value of each number that is scaled to 0, in its unit.
        scale: deviation of each number from its centre that is scaled to 1, in its unit; positive.

    Raises:
        ValueError: for unequal lengths, and scales that are not positive.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    centre: tuple[float, ...]
    scale: tuple[float, ...]

    def __post_init__(self):
        lengths = {name: len(getattr(self, name)) for name in ("names", "units", "centre", "scale")}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"signals: expected as many of each, got {lengths}")
        if not all(math.isfinite(scale) and scale > 0 for scale in self.scale):
            raise ValueError(f"signals: expected positive scales, got {list(self.scale)}")

    @property
    def size(self) -> int:
        """Number of signals."""
        return len(self.names)

    def to_unit(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Scale values from their units to those of a policy."""
        return (values - np.asarray(self.centre, np.float32)) / np.asarray(self.scale, np.float32)

    def from_unit(self, values: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """The inverse of `to_unit`."""
        return values * np.asarray(self.scale, np.float32) + np.asarray(self.centre, np.float32)


class EnvState(struct.PyTreeNode):
    """An episode between two steps.

    Attributes:
        inner: the environment's internal state: its physics, its key, its theta.
        observation: observation in its units, shape [O].
        reward: reward of the step that led here.
        terminated: whether the episode has ended, by its rules or at its time limit.
        truncated: whether it has ended in a state that says nothing about future rewards, such as an unstable
            simulation. The value of a step into such a state is not learnt.
        facts: facts about the episode so far, by name, such as whether a target has been hit; recorded at the episode's
            end.
    """

    inner: Any
    observation: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    truncated: Bool[Array, "*batch"]
    facts: Mapping[str, Array]


@runtime_checkable
class Environment(Protocol):
    """An environment with unknown parameters: pure methods for one episode, batched by `vmap`.

    Optional attributes tell a robot what it must know; policies carry them: `deployment`, if actions displace
    set-points (`jaxlfi.rl.deployment.Deployment`), and `preparation`, if observations and actions are computed from
    signals and controls (`jaxlfi.rl.preparation.Preparation`). Further optional attributes: `bounds`, the smallest and
    largest observations [2, O], for learners that require them (`jaxlfi.rl.gym`); `reward`, the name of the selected
    reward, which trainings and policies record; `training`, settings of PPO by the name of a preset, which replace the
    preset's own (`jaxlfi.rl.settings`). An optional method `concluded(state)` maps the last state of an episode to
    facts that evaluations add. The last `memory` numbers of an observation and of an action are the policy's memory:
    those of an action are observed in the next step, and an episode begins with zeros (`jaxlfi.rl.recurrent`).

    Attributes:
        name: name of the environment.
        space: names of the parameters theta [D], and which are inferred as logarithms.
        units: unit of each parameter.
        feasible: Phi, in natural units.
        supports: boxes of theta by name, in natural units; the first is Theta_0.
        nominal: the point theta for training without a distribution, in natural units.
        observations: signals of an observation.
        actions: signals of an action, which is limited to `centre` +- `scale`.
        steps: maximum length of an episode.
    """

    name: str
    space: Space
    units: tuple[str, ...]
    feasible: Support
    supports: Mapping[str, Support]
    nominal: tuple[float, ...]
    observations: Signals
    actions: Signals
    steps: int

    def reset(self, key: jax.Array, theta: Float[Array, " dim"]) -> EnvState:
        """Start an episode with these parameters, in natural units; nuisance parameters are redrawn."""

    def step(self, state: EnvState, action: Float[Array, " act"]) -> EnvState:
        """Take one step with an action in its units."""
