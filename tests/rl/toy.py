"""An environment small enough for tests: a point on a line is to be moved to a target."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.io import files
from jaxlfi.rl.environment import EnvState, Signals
from jaxlfi.rl.settings import PPO

SETTINGS = PPO(
    learning_rate=3e-3, environments=4, unroll=5, segments=2, minibatches=4, epochs=3, total_steps=160, hidden=(8, 8)
)
"""Two segments of five steps in each of four minibatches, which are two of each environment; four updates."""


@struct.dataclass
class Point:
    """Where the point is, and theta."""

    position: jax.Array
    theta: jax.Array


@dataclasses.dataclass(frozen=True)
class Line:
    """theta: the gain of actions, and where the target is, in m. Beyond 3 m the simulation is unstable."""

    name: str = "line"
    space: Space = Space(("gain", "target"), (True, False))
    units: tuple[str, ...] = ("", "m")
    nominal: tuple[float, ...] = (1.0, 0.5)
    observations: Signals = Signals(("position", "goal"), ("m", "m"), (0.5, 0.0), (2.0, 1.0))
    actions: Signals = Signals(("push",), ("m",), (0.1,), (0.5,))
    steps: int = 7

    @property
    def supports(self):
        return {"initial": Support([0.5, -1.0], [2.0, 1.0]), "wide": self.feasible}

    @property
    def feasible(self):
        return Support([0.25, -2.0], [4.0, 2.0])

    def reset(self, key, theta):
        position = 0.1 * jax.random.normal(key)
        return self._state(Point(position, theta), jnp.asarray(0.0), jnp.asarray(False))

    def step(self, state, action):
        point = state.inner
        point = point.replace(position=point.position + point.theta[0] * action[0])
        distance = jnp.abs(point.position - point.theta[1])
        unstable = jnp.abs(point.position) > 3.0
        return self._state(point, jnp.where(unstable, 0.0, -distance), unstable)

    def _state(self, point, reward, unstable):
        there = jnp.abs(point.position - point.theta[1]) < 0.05
        return EnvState(
            inner=point,
            observation=jnp.stack([point.position, point.theta[1]]),
            reward=reward,
            terminated=there & ~unstable,
            truncated=unstable,
            facts={"there": there, "failed": unstable},
        )


def assert_same_results(out, again):
    """Of two trainings in folders: equal to the last bit, but for the seconds that they took."""
    for path in out.rglob("*.npz"):
        first, second = files.read_arrays(path), files.read_arrays(again / path.relative_to(out))
        for name in first.keys() - {"seconds", "schema"}:
            np.testing.assert_array_equal(first[name], second[name], err_msg=f"{path} {name}")
    assert (out / "table.csv").read_text() == (again / "table.csv").read_text()
