"""Episodes of an environment for external learners, with their theta and random keys."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int

from jaxlfi.registry import ENVIRONMENTS
from jaxlfi.rl.domains import check_point
from jaxlfi.rl.environment import Environment, EnvState


class Episode(struct.PyTreeNode):
    """An episode between two steps.

    Attributes:
        key: random key of all that follows, later episodes included; None if nothing follows.
        theta: parameters of the episode.
        state: state of the environment.
        steps: number of steps so far.
    """

    key: Any
    theta: Any
    state: EnvState
    steps: Int[Array, "*batch"]


@dataclasses.dataclass(frozen=True)
class Course:
    """The episodes of an environment: pure methods for one episode, batched by `vmap`.

    Attributes:
        environment: environment, which runs one episode at a time.
        draw: function that draws an episode's theta, in natural units, from a key; None if theta is given.
    """

    environment: Environment
    draw: Callable[[jax.Array], Any] | None = None

    @classmethod
    def of(cls, environment: Environment | str, theta: Any) -> "Course":
        """The course of an environment, given itself or by name (`jaxlfi.registry.ENVIRONMENTS`)."""
        made = ENVIRONMENTS.load(environment) if isinstance(environment, str) else environment
        return cls(made, theta if callable(theta) else None)

    def points(self, theta: Any, batch: tuple[int, ...] = ()) -> Any:
        """The given theta, for a batch of episodes; the nominal point if theta is drawn or not given.

        Raises:
            ValueError: for points outside Phi, and for a wrong number of points.
        """
        given = self.environment.nominal if theta is None or callable(theta) else theta
        points = np.atleast_1d(np.asarray(given, np.float32))
        if points.shape[:-1] not in ((), batch):
            raise ValueError(f"theta: expected one point or {list(batch)}, got {list(points.shape[:-1])}")
        for point in points.reshape(-1, points.shape[-1]):
            check_point(self.environment, point)
        return jnp.broadcast_to(points, (*batch, points.shape[-1]))

    def theta(self, key: jax.Array, given: Any) -> Any:
        """The parameters of an episode."""
        return given if self.draw is None else self.draw(key)

    def reset(self, key: jax.Array, theta: Any) -> EnvState:
        """The start of an episode with these parameters."""
        return self.environment.reset(key, theta)

    def go_on(self, key: jax.Array, state: EnvState, action: Array, over: Bool[Array, ""] | bool) -> EnvState:
        """One step of the environment, which has its own keys; the step of a finished episode is not used."""
        return self.environment.step(state, action)

    def facts(self, episode: Episode) -> dict[str, Array]:
        """Facts that the environment reports about an episode, and the episode's parameters, by name."""
        names = self.environment.space.names
        return {**episode.state.facts, **{name: episode.theta[..., d] for d, name in enumerate(names)}}

    def begin(self, key: jax.Array, given: Any) -> Episode:
        """The start of an episode."""
        key, key_start, _ = jax.random.split(key, 3)
        return self._begun(key, key_start, given)

    def step(self, episode: Episode, action: Array) -> Episode:
        """The episode after a step."""
        key, _, key_step = jax.random.split(episode.key, 3)
        return episode.replace(
            key=key, state=self.go_on(key_step, episode.state, action, False), steps=episode.steps + 1
        )

    def step_or_begin(
        self, episode: Episode, given: Any, action: Array, over: Bool[Array, ""], same_step: bool
    ) -> tuple[Episode, Episode]:
        """Like `step`, but like `begin` if the episode was over or, with `same_step`, ends in this step.

        Returns:
            The episode that continues or begins, and the previous one after the step, which cannot be continued.
        """
        key, key_start, key_step = jax.random.split(episode.key, 3)
        state = self.go_on(key_step, episode.state, action, over)
        last = Episode(None, episode.theta, state, episode.steps + 1)
        if same_step:  # like `step` followed by `begin`
            terminated, truncated = self.ends(last)
            over = terminated | truncated
            later, key_start, _ = jax.random.split(key, 3)
            key = _chosen(over, later, key)
        now = jax.tree.map(functools.partial(_chosen, over), self._begun(None, key_start, given), last)
        return now.replace(key=key), last.replace(state=state.replace(inner=None))

    def ends(self, episode: Episode) -> tuple[Any, Any]:
        """Whether an episode has ended by its rules, and whether its time is up or its simulation has failed."""
        state = episode.state
        return state.terminated & ~state.truncated, state.truncated | (episode.steps >= self.environment.steps)

    def _begun(self, key: Any, key_start: jax.Array, given: Any) -> Episode:
        key_theta, key_reset = jax.random.split(key_start)
        theta = self.theta(key_theta, given)
        return Episode(key, theta, self.reset(key_reset, theta), jnp.asarray(0))


def _chosen(over: Bool[Array, ""], new: Array, old: Array) -> Array:
    """The new value if an episode is over; keys as raw data, as jax's key-reuse checker counts selection as use."""
    if jnp.issubdtype(jnp.asarray(new).dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.where(over, jax.random.key_data(new), jax.random.key_data(old)))
    return jnp.where(over, new, old)
