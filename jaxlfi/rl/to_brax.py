"""Environments with unknown parameters as Brax environments; `from_brax` does the opposite."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.io.quiet_imports import quiet_imports
from jaxlfi.rl.course import Course, Episode
from jaxlfi.rl.environment import Environment

try:
    with quiet_imports():
        from brax.envs.base import Env, State
except ImportError as error:
    raise ImportError("jaxlfi.rl.to_brax needs Brax: pip install 'jaxlfi[policy]'") from error


class ToBrax(Env):
    """A Brax environment, to be wrapped for training with `episode_length=environment.steps`.

    Observations and actions are scaled by the environment's schema, and actions are limited to [-1, 1]. The
    environment's facts are the metrics. Brax's `AutoResetWrapper` returns to the first state of each environment, so
    that theta, nuisances and noise are those of its first episode; to redraw them, reset with a new key.

    Example:
        >>> from brax.envs.wrappers.training import wrap                                       # doctest: +SKIP
        >>> draw = lambda key: domain.theta[jax.random.randint(key, (), 0, len(domain.theta))]  # doctest: +SKIP
        >>> env = wrap(ToBrax("whip", draw), episode_length=16)                                # doctest: +SKIP
    """

    def __init__(self, environment: Environment | str, theta: Any = None):
        """Nothing is simulated yet.

        Args:
            environment: environment, which runs one episode at a time, or its name, as for `jaxlfi train`.
            theta: parameters in natural units, shape [D], or a function that draws those of every episode from a key;
                by default the nominal point.

        Raises:
            ValueError: for unknown names, and parameters outside Phi.
        """
        self._course = Course.of(environment, theta)
        self._given = self._course.points(theta)

    def reset(self, rng: jax.Array) -> State:
        """The start of an episode; the key may be typed or, like Brax's, raw."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        return self._as_state(self._course.begin(key, self._given), {}, {})

    def step(self, state: State, action: Float[Array, " act"]) -> State:
        """One step. Episodes end by their rules and if simulations fail; Brax's wrapper limits their length."""
        scaled = self._course.environment.actions.from_unit(jnp.clip(action, -1.0, 1.0))
        return self._as_state(self._course.step(state.pipeline_state, scaled), state.metrics, state.info)

    def _as_state(self, episode: Episode, metrics: dict[str, Array], info: dict[str, Any]) -> State:
        state = episode.state
        return State(
            pipeline_state=episode,
            obs=self._course.environment.observations.to_unit(state.observation),
            reward=jnp.asarray(state.reward, jnp.float32),
            done=(state.terminated | state.truncated).astype(jnp.float32),
            metrics={**metrics, **{name: jnp.asarray(fact, jnp.float32) for name, fact in state.facts.items()}},
            info=info,
        )

    @property
    def observation_size(self) -> int:
        """Number of values in an observation."""
        return self._course.environment.observations.size

    @property
    def action_size(self) -> int:
        """Number of values in an action."""
        return self._course.environment.actions.size

    @property
    def backend(self) -> str:
        """The environment's name."""
        return self._course.environment.name
