"""Environments with unknown parameters as gymnasium environments, single or vectorised.

    gymnasium.make("jaxlfi.rl.gym:jaxlfi/Environment-v0", environment="mujoco,config=arm.toml")
    gymnasium.make_vec("jaxlfi.rl.gym:jaxlfi/Environment-v0", num_envs=12, environment="mujoco,config=arm.toml",
                       theta=domain.theta, vectorization_mode="vector_entry_point")

Observations and actions are in their units; `gymnasium.wrappers.RescaleAction` brings actions to [-1, 1].
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.rl.course import Course, Episode
from jaxlfi.rl.environment import Environment

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("jaxlfi.rl.gym needs gymnasium: pip install 'jaxlfi[whip]'") from error

Theta = Float[Array | np.ndarray, "*batch dim"] | Sequence[float] | Callable[[jax.Array], Array]
"""One point in natural units, one per environment, or a function that draws a point for every episode from a key."""


class GymEnvironment(gymnasium.Env):
    """A gymnasium environment.

    `info` contains the environment's facts and the episode's parameters by name. Actions beyond their limits are
    clipped; an action of a wrong shape or with numbers that are not finite is refused, and the episode continues. An
    episode is truncated when its time is up or its simulation fails.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, environment: Environment | str, theta: Theta | None = None, render_mode: str | None = None):
        """Nothing is simulated yet.

        Args:
            environment: environment, which runs one episode at a time, or its name, as for `jaxlfi train`.
            theta: parameters, or a function that draws those of every episode; by default the nominal point.
            render_mode: None, as nothing is rendered.

        Raises:
            ValueError: for unknown names, other render modes, and parameters outside Phi.
        """
        self._set(Course.of(environment, theta), theta, render_mode)

    def _set(self, course: Course, theta: Any, render_mode: str | None) -> None:
        modes = (*self.metadata["render_modes"], None)
        if render_mode not in modes:
            names = " or ".join(mode or "none" for mode in modes)
            raise ValueError(f"render_mode: expected {names}, got {render_mode!r}")
        self.render_mode, self._course, self._given = render_mode, course, course.points(theta)
        self.action_space, self.observation_space = _spaces(course.environment)
        self._key: jax.Array | None = None
        self._episode: Episode | None = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode, with new parameters if they are drawn; there are no options."""
        super().reset(seed=seed)
        if seed is not None:
            self._key = jax.random.key(seed)
        elif self._key is None:
            self._key = jax.random.key(_entropy(self.np_random))
        self._episode = episode = _begin(self._course, self._key, self._given)
        self._key = episode.key
        return np.array(episode.state.observation), self._info(episode)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply an action.

        Raises:
            ValueError: for an action of a wrong shape, and numbers that are not finite.
            ResetNeeded: before the first `reset`.
        """
        action = _action(action, self.action_space)
        self._episode = episode = _step(self._course, self._required("step"), action)
        self._key, state = episode.key, episode.state
        terminated, truncated = self._course.ends(episode)
        return np.array(state.observation), float(state.reward), bool(terminated), bool(truncated), self._info(episode)

    def _required(self, method: str) -> Episode:
        if self._episode is None:
            raise gymnasium.error.ResetNeeded(f"{method}: expected a reset before it, got none")
        return self._episode

    def _info(self, episode: Episode) -> dict[str, Any]:
        """Facts, with scalars as Python numbers."""
        facts = {name: np.array(value) for name, value in self._course.facts(episode).items()}
        return {name: value if value.ndim else value.item() for name, value in facts.items()}


class GymVector(VectorEnv):
    """Many environments stepped together; the i-th is equivalent to a `GymEnvironment` with the seed `seed + i`.

    An environment whose episode has ended is reset in the next step, whose action it ignores (gymnasium's
    `AutoresetMode.NEXT_STEP`), or in the same step (`AutoresetMode.SAME_STEP`). In the latter case, the observation is
    that of the new episode, and the old episode's last observation is in the info as `final_obs`, beside `final_info`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - each has its own

    def __init__(
        self,
        num_envs: int,
        environment: Environment | str,
        theta: Theta | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        """Nothing is simulated yet.

        Args:
            num_envs: number of environments N.
            environment: see `GymEnvironment`.
            theta: see `GymEnvironment`; or N points along a leading axis, which the environments keep.
            autoreset_mode: when a new episode begins; see above.

        Raises:
            ValueError: see `GymEnvironment`, and for other modes.
        """
        self._set(num_envs, Course.of(environment, theta), theta, autoreset_mode)

    def _set(self, num_envs: int, course: Course, theta: Any, autoreset_mode: AutoresetMode | str) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: expected at least 1, got {num_envs}")
        known = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
        mode = next((mode for mode in known if autoreset_mode in (mode, mode.value)), None)
        if mode is None:
            raise ValueError(f"autoreset_mode: expected NextStep or SameStep, got {autoreset_mode!r}")
        self.num_envs, self.render_mode, self.metadata = num_envs, None, {"autoreset_mode": mode}
        self.single_action_space, self.single_observation_space = single = _spaces(course.environment)
        self.action_space, self.observation_space = (batch_space(space, num_envs) for space in single)
        self._same_step = mode is AutoresetMode.SAME_STEP
        self._course, self._given = course, course.points(theta, (num_envs,))
        self._keys: jax.Array | None = None
        self._episodes: Episode | None = None
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin all episodes.

        Args:
            seed: seed of the first environment, or one for each.
            options: unused.

        Raises:
            ValueError: for a wrong number of seeds.
        """
        given: Any = seed
        seeds = (
            [given if given is None else given + i for i in range(self.num_envs)] if np.ndim(given) == 0 else [*given]
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} of them, got {len(seeds)}")
        super().reset(seed=seeds[0])
        if self._keys is None:
            self._keys = jax.random.split(jax.random.key(_entropy(self.np_random)), self.num_envs)
        for i, own in enumerate(seeds):
            if own is not None:
                self._keys = self._keys.at[i].set(jax.random.key(own))
        self._episodes = _begin_many(self._course, self._keys, self._given)
        self._keys, self._over = self._episodes.key, np.zeros(self.num_envs, bool)
        return np.array(self._episodes.state.observation), self._infos(self._episodes)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Apply actions, shape [N, A].

        Raises:
            ValueError: for a wrong shape, and numbers that are not finite.
            ResetNeeded: before the first `reset`.
        """
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("step: expected a reset before it, got none")
        actions = _action(actions, self.action_space)
        now, last = _step_many(self._course, self._same_step, self._episodes, self._given, actions, self._over)
        self._episodes, self._keys = now, now.key
        ended = last if self._same_step else now
        terminated, truncated = (np.array(ends) for ends in self._course.ends(ended))
        over, info = terminated | truncated, dict[str, Any](self._infos(now))
        if not self._same_step:
            self._over = over
        elif over.any():
            final = np.full(self.num_envs, None, object)
            for place in np.flatnonzero(over):
                final[place] = np.array(last.state.observation[place])
            info |= {"final_obs": final, "_final_obs": over, "final_info": self._infos(last, over), "_final_info": over}
        return np.array(now.state.observation), np.array(ended.state.reward), terminated, truncated, info

    def _infos(self, episodes: Episode, those: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Facts, with masks of the environments that report them, by default all, as in gymnasium."""
        facts = {name: np.array(value) for name, value in self._course.facts(episodes).items()}
        return facts | {f"_{name}": np.ones(self.num_envs, bool) if those is None else those for name in facts}


# Programs are compiled per course, not per environment.
_begin, _step = (jax.jit(method, static_argnums=0) for method in (Course.begin, Course.step))
_begin_many = jax.jit(lambda course, keys, given: jax.vmap(course.begin)(keys, given), static_argnums=0)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _step_many(course: Course, same_step: bool, episodes: Episode, given: Any, actions: Array, over: Array):
    return jax.vmap(functools.partial(course.step_or_begin, same_step=same_step))(episodes, given, actions, over)


def _spaces(environment: Environment) -> tuple[spaces.Box, spaces.Box]:
    """Spaces of actions and observations; the latter is an environment's attribute `bounds` [2, O], or unbounded."""
    box = lambda low, high: spaces.Box(np.asarray(low, np.float32), np.asarray(high, np.float32))
    centre, scale = (np.asarray(numbers) for numbers in (environment.actions.centre, environment.actions.scale))
    everything = np.outer([-np.inf, np.inf], np.ones(environment.observations.size))
    return box(centre - scale, centre + scale), box(*getattr(environment, "bounds", everything))


def _action(action: Any, space: spaces.Box) -> np.ndarray:
    """The action, checked and clipped to the limits."""
    shape = list(space.shape)
    try:
        checked = np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"action: expected numbers of shape {shape}, got {action!r}") from None
    if checked.shape != space.shape:
        raise ValueError(f"action: expected numbers of shape {shape}, got shape {list(checked.shape)}")
    if not np.isfinite(checked).all():
        raise ValueError(f"action: expected finite numbers, got {checked.tolist()}")
    return np.clip(checked, space.low, space.high)


def _entropy(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


gymnasium.register(
    "jaxlfi/Environment-v0", entry_point="jaxlfi.rl.gym:GymEnvironment", vector_entry_point="jaxlfi.rl.gym:GymVector"
)
