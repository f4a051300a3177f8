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
    """An environment of Brax, to be wrapped for training with `episode_length=environment.steps`.

    Observations and actions are as policies see them: scaled by the environment's schema, actions to [-1, 1], to which
    they are limited. The environment's facts are its metrics. Brax's `AutoResetWrapper` goes back to the first state of
    each environment, so that theta, nuisances and noise are those of its first episode; whoever does not want that
    resets by a new key.

    Example:
        >>> from brax.envs.wrappers.training import wrap                                       # doctest: +SKIP
        >>> draw = lambda key: domain.theta[jax.random.randint(key, (), 0, len(domain.theta))]  # doctest: +SKIP
        >>> env = wrap(ToBrax("whip", draw), episode_length=16)                                # doctest: +SKIP
    """

    def __init__(self, environment: Environment | str, theta: Any = None):
        """Nothing is simulated yet.

        Args:
            environment: for one episode, or its name, as of `jaxlfi train`.
            theta: the parameters in natural units, shape [D], or what draws those of every episode with a key; by
                default the nominal point.

        Raises:
            ValueError: for unknown names, and parameters outside of Phi.
        """
        self._course = Course.of(environment, theta)
        self._given = self._course.points(theta)

    def reset(self, rng: jax.Array) -> State:
        """The start of an episode; the key may be a typed one or, as Brax's are, a raw one."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        return self._as_state(self._course.begin(key, self._given), {}, {})

    def step(self, state: State, action: Float[Array, " act"]) -> State:
        """One step. Episodes end by their rules and where simulations fail; by length, Brax's wrapper ends them."""
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
        """How many numbers an observation has."""
        return self._course.environment.observations.size

    @property
    def action_size(self) -> int:
        """How many numbers an action has."""
        return self._course.environment.actions.size

    @property
    def backend(self) -> str:
        """The environment's name."""
        return self._course.environment.name
