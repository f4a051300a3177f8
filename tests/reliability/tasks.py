"""The smallest things to infer and to train on, so that a run is mostly writing files."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.rl.environment import EnvState, Signals
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

SECONDS = 0.05
"""That one simulation on a cluster takes."""


def noisy(rng: np.random.Generator, theta: np.ndarray) -> np.ndarray:
    """The parameters with noise, made one by one."""
    time.sleep(SECONDS)
    return theta + 0.3 * rng.normal(size=2)


def one_by_one() -> Task:
    """The linear Gaussian task by a simulator that JAX cannot trace."""
    observation = np.array([0.5, 0.2], np.float32)
    simulate = HostSimulator(noisy, each=True)
    return dataclasses.replace(gaussian_linear.task(), simulate=simulate, observation=observation)


@struct.dataclass
class Place:
    """Where a cart is, and theta."""

    at: jax.Array
    theta: jax.Array


@dataclasses.dataclass(frozen=True)
class Cart:
    """A cart is to be brought to 0 m; theta is the gain of its motor."""

    name: str = "cart"
    space: Space = Space(("gain",), (False,))
    units: tuple[str, ...] = ("",)
    nominal: tuple[float, ...] = (1.0,)
    observations: Signals = Signals(("place",), ("m",), (0.0,), (1.0,))
    actions: Signals = Signals(("push",), ("m",), (0.0,), (0.5,))
    steps: int = 5

    @property
    def supports(self) -> dict[str, Support]:
        """Boxes of the gain."""
        return {"initial": Support([0.5], [1.5])}

    @property
    def feasible(self) -> Support:
        """Phi."""
        return Support([0.1], [2.0])

    def reset(self, key: jax.Array, theta: jax.Array) -> EnvState:
        """Somewhere about 1 m."""
        return self._state(Place(1.0 + 0.1 * jax.random.normal(key), theta))

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """Push it."""
        place = state.inner
        return self._state(place.replace(at=place.at + place.theta[0] * action[0]))

    def _state(self, place: Place) -> EnvState:
        return EnvState(
            inner=place,
            observation=place.at[None],
            reward=-jnp.abs(place.at),
            terminated=jnp.asarray(False),
            truncated=jnp.abs(place.at) > 9.0,
            facts={"far": jnp.abs(place.at) > 2.0},
        )
