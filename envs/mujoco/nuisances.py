"""Random numbers of a policy's episodes besides the first state: commands, delays, offsets and measurement errors."""

from collections.abc import Mapping

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.goal import Goal


class Drawn(struct.PyTreeNode):
    """The draws of an episode with C commands and S observed signals.

    Attributes:
        commands: in their units, shape [C].
        action_delay: time from an action to when the actuators get it, in s.
        observation_delay: the age of a measurement when the policy acts on it, in s.
        offsets: of the signals, shape [S].
        errors: current errors of the model in the signals, which change over the episode, shape [S].
    """

    commands: Float[Array, "*batch commands"]
    action_delay: Float[Array, "*batch"]
    observation_delay: Float[Array, "*batch"]
    offsets: Float[Array, "*batch signals"]
    errors: Float[Array, "*batch signals"]


class Nuisances:
    """The distributions of these draws."""

    def __init__(self, goal: Goal, discrepancies: Mapping[str, Discrepancy]):
        """Look up the discrepancy of each signal.

        Args:
            goal: of the policy.
            discrepancies: of the model, by signal.
        """
        self._goal = goal
        self._commands = np.array([*goal.commands.values()], np.float32).reshape(-1, 2).T
        processes = [discrepancies.get(name, Discrepancy(0.0, 1.0)) for name in goal.observed]
        self._deviations = np.array([one.deviation for one in processes], np.float32)
        self._keep = np.exp(-goal.interval / np.array([one.time for one in processes])).astype(np.float32)

    def draw(self, key: jax.Array, noise: Float[Array, " signals"]) -> Drawn:
        """The draws of an episode whose signals have noise of these standard deviations."""
        keys = jax.random.split(key, 5)
        uniform = lambda key, low, high: jax.random.uniform(key, np.shape(low), minval=low, maxval=high)
        return Drawn(
            commands=uniform(keys[0], *self._commands),
            action_delay=uniform(keys[1], *self._goal.action_delay),
            observation_delay=uniform(keys[2], *self._goal.observation_delay),
            offsets=self._goal.bias * noise * jax.random.normal(keys[3], noise.shape),
            errors=jax.random.normal(keys[4], noise.shape) * self._deviations,
        )

    def later(self, key: jax.Array, drawn: Drawn) -> Drawn:
        """The same a control interval later: errors are Ornstein-Uhlenbeck processes, simulated exactly."""
        if not self._deviations.any():
            return drawn
        fresh = jax.random.normal(key, drawn.errors.shape) * self._deviations
        return drawn.replace(errors=drawn.errors * self._keep + fresh * np.sqrt(1 - self._keep**2))
