"""Environments whose policies see several of the last observations and actions.

A policy can thus adapt to theta during an episode, without being given it (Peng et al. 2018, who use a recurrent
network instead of a fixed window).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.rl.environment import Environment, EnvState, Signals
from jaxlfi.rl.preparation import MOST_BEFORE, before


class Past(struct.PyTreeNode):
    """An episode and its recent past, the latest first.

    Attributes:
        inner: the environment's own internal state.
        frames: last observations, shape [F, O].
        acted: last actions, shape [F - 1, A].
    """

    inner: Any
    frames: Float[Array, "*batch frames obs"]
    acted: Float[Array, "*batch acted act"]


@dataclasses.dataclass(frozen=True)
class History:
    """An environment whose observations are its last F observations and then its last F - 1 actions, the latest first.

    At the start of an episode, earlier observations are set to the first one, and earlier actions to the middle of
    their range. `deployment` and `preparation`, which robots need, are left out: they describe single observations, so
    these policies act in simulation only.

    Attributes:
        environment: environment to act in.
        frames: number of observations that are seen, at least 2.

    Raises:
        ValueError: for other numbers of frames, and environments whose policies have memory (`jaxlfi.rl.recurrent`).

    Example:
        >>> from jaxlfi.envs.whip.environment import make  # doctest: +SKIP
        >>> History(make(), 6).observations.size  # doctest: +SKIP
        178
    """

    environment: Environment
    frames: int

    def __post_init__(self):
        if type(self.frames) is not int or not 2 <= self.frames <= MOST_BEFORE:
            raise ValueError(f"history: expected a whole number from 2 to {MOST_BEFORE}, got {self.frames!r}")
        if getattr(self.environment, "memory", 0):
            raise ValueError("history: expected an environment whose policies do not remember")

    @property
    def name(self) -> str:
        """Name of the environment."""
        return self.environment.name

    @property
    def space(self) -> Space:
        """Space of theta."""
        return self.environment.space

    @property
    def units(self) -> tuple[str, ...]:
        """Units of theta."""
        return self.environment.units

    @property
    def feasible(self) -> Support:
        """Phi."""
        return self.environment.feasible

    @property
    def supports(self) -> Mapping[str, Support]:
        """Boxes of theta by name."""
        return self.environment.supports

    @property
    def nominal(self) -> tuple[float, ...]:
        """The point theta for training without a distribution."""
        return self.environment.nominal

    @property
    def actions(self) -> Signals:
        """Signals of the environment's actions."""
        return self.environment.actions

    @property
    def steps(self) -> int:
        """Largest number of steps of an episode."""
        return self.environment.steps

    @property
    def observations(self) -> Signals:
        """Signals of the last observations and actions, scaled as in the environment."""
        seen, acted = self.environment.observations, self.environment.actions
        last = self.frames - 1
        together = lambda what: (*getattr(seen, what) * self.frames, *getattr(acted, what) * last)
        names = [f"{name}{before(k)}" for k in range(self.frames) for name in seen.names]
        names += [f"{name}{before(k + 1)}" for k in range(last) for name in acted.names]
        return Signals(tuple(names), together("units"), together("centre"), together("scale"))

    @property
    def bounds(self) -> np.ndarray:
        """Smallest and largest observations, for environments that declare theirs."""
        seen, acted = getattr(self.environment, "bounds"), self.environment.actions  # noqa: B009 - it may lack them
        limits = np.asarray(acted.centre) + np.array([[-1.0], [1.0]]) * np.asarray(acted.scale)
        return np.concatenate([np.tile(seen, self.frames), np.tile(limits, self.frames - 1)], axis=1)

    @property
    def reward(self) -> str | None:
        """Name of the reward, if the environment has several."""
        return getattr(self.environment, "reward", None)

    def reset(self, key: jax.Array, theta: Float[Array, " dim"]) -> EnvState:
        """Start an episode with these parameters."""
        state = self.environment.reset(key, theta)
        frames = jnp.stack([state.observation] * self.frames)
        rest = jnp.asarray(self.actions.centre, jnp.float32)
        return _seeing(state, frames, jnp.stack([rest] * (self.frames - 1)))

    def step(self, state: EnvState, action: Float[Array, " act"]) -> EnvState:
        """Take one step with an action in its units."""
        past = state.inner
        after = self.environment.step(self._own(state), action)
        frames = jnp.concatenate([after.observation[None], past.frames[:-1]])
        return _seeing(after, frames, jnp.concatenate([action[None], past.acted[:-1]]))

    def concluded(self, state: EnvState) -> dict[str, Any]:
        """Facts that the environment reports about an episode's end, if any."""
        more: Any = getattr(self.environment, "concluded", None)
        return {} if more is None else dict(more(self._own(state)))

    def _own(self, state: EnvState) -> EnvState:
        """The environment's own state."""
        return state.replace(inner=state.inner.inner, observation=state.inner.frames[0])


def _seeing(state: EnvState, frames: Array, acted: Array) -> EnvState:
    seen = jnp.concatenate([frames.ravel(), acted.ravel()])
    return state.replace(inner=Past(state.inner, frames, acted), observation=seen)
