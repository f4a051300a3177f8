"""A puck on a table: it is pushed up to a line, let go, and should stop at a mark beyond it.

Mass and Coulomb friction are unknown. After the line nothing can be corrected: the speed that stops a puck at the mark
depends on its friction, and the force that gives it that speed before the line also on its mass. Motion under a
constant force is integrated in closed form, interval by interval.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.rl.environment import EnvState, Signals
from jaxlfi.rl.preparation import Command, Control, Memory, Preparation, Signal

GRAVITY = 9.81
"""Gravitational acceleration, in m/s^2."""
INTERVAL = 0.05
"""Time between two forces, in s."""
STEPS = 20
"""Largest number of forces in an episode."""
LINE = 0.3
"""Distance over which the puck can be pushed, in m."""
MARKS = (0.6, 1.2)
"""Range of the mark, in m from the start."""
STRONGEST = 25.0
"""Largest force, in N."""
NOISE = (0.002, 0.02)
"""Standard deviations of measured positions (m) and velocities (m/s)."""
SPACE = Space(("mass", "friction"), (True, True))
GUESS = Support([0.5, 0.2], [1.5, 0.5])
"""Theta_0: mass in kg, coefficient of friction."""
FEASIBLE = Support([0.3, 0.05], [2.0, 0.6])
"""Phi."""


class Puck(struct.PyTreeNode):
    """State of an episode.

    Attributes:
        position: position of the puck, in m.
        velocity: its velocity, in m/s.
        mark: position at which the puck should stop, in m.
        theta: mass and friction.
        steps: number of steps so far.
        memory: the policy's memory.
        key: key of the noise to come.
    """

    position: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    mark: Float[Array, "*batch"]
    theta: Float[Array, "*batch 2"]
    steps: Int[Array, "*batch"]
    memory: Memory
    key: jax.Array


def moved(
    theta: Float[Array, "2"], position: Float[Array, ""], velocity: Float[Array, ""], force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Position and (non-negative) velocity after an interval under a force; friction stops the puck and holds it."""
    mass, friction = theta
    acceleration = force / mass - friction * GRAVITY
    stopping = jnp.where(acceleration < 0, velocity / jnp.maximum(-acceleration, 1e-9), INTERVAL)
    time = jnp.minimum(INTERVAL, stopping)
    return position + velocity * time + 0.5 * acceleration * time**2, jnp.maximum(velocity + acceleration * time, 0.0)


def stops(theta: Float[Array, "2"], position: Float[Array, ""], squared: Float[Array, ""]) -> Float[Array, ""]:
    """The rest position of a puck that is not pushed, from a position and a squared velocity."""
    return position + squared / (2 * theta[1] * GRAVITY)


@dataclasses.dataclass(frozen=True)
class Slide:
    """Episodes of a puck.

    Attributes:
        history: number of states that the policy sees, one more than of past forces; 1 is only the current state.
    """

    history: int = 1
    name: str = "slide"
    space: Space = SPACE
    units: tuple[str, ...] = ("kg", "")
    nominal: tuple[float, ...] = (0.866, 0.316)  # the middle of the guess, of logarithms
    steps: int = STEPS

    @property
    def supports(self) -> Mapping[str, Support]:
        """Theta_0 and Phi."""
        return {"initial": GUESS, "feasible": FEASIBLE}

    @property
    def feasible(self) -> Support:
        """Phi."""
        return FEASIBLE

    @property
    def preparation(self) -> Preparation:
        """The observed signals, and the commands."""
        return Preparation(
            signals=(Signal("position", "m"), Signal("velocity", "m/s")),
            controls=(Control("push", 0.0, STRONGEST, "N"),),
            interval=INTERVAL,
            steps=STEPS,
            history=self.history,
            actions=self.history - 1,
            commands=(Command("mark", *MARKS, "m"),),
        )

    @property
    def observations(self) -> Signals:
        """Positions and velocities, the latest first; forces in the same order; the mark."""
        frames, forces = self.history, self.history - 1
        middle, half = (MARKS[0] + MARKS[1]) / 2, (MARKS[1] - MARKS[0]) / 2
        return Signals(
            names=self.preparation.names,
            units=(*("m", "m/s") * frames, *("N",) * forces, "m"),
            centre=(*(LINE / 2, 1.0) * frames, *(STRONGEST / 2,) * forces, middle),
            scale=(*(LINE / 2, 1.0) * frames, *(STRONGEST / 2,) * forces, half),
        )

    @property
    def actions(self) -> Signals:
        """The force."""
        return Signals(("push",), ("N",), (STRONGEST / 2,), (STRONGEST / 2,))

    def reset(self, key: jax.Array, theta: Float[Array, "2"]) -> EnvState:
        """A puck at rest at the start, and a mark."""
        key_mark, key_noise, key = jax.random.split(key, 3)
        mark, zero = jax.random.uniform(key_mark, minval=MARKS[0], maxval=MARKS[1]), jnp.asarray(0.0)
        measured = _measured(key_noise, zero, zero, mark)
        memory, seen = self.preparation.observed(self.preparation.start(measured, jnp), measured, jnp)
        puck = Puck(zero, zero, mark, theta, jnp.asarray(0), memory, key)
        no = jnp.asarray(False)
        return EnvState(puck, seen, zero, no, no, {"off": jnp.abs(mark), "released": no})

    def step(self, state: EnvState, action: Float[Array, "1"]) -> EnvState:
        """An interval of pushing. If the puck passes the line or time is up, it slides until it stops."""
        puck = state.inner
        key, key_noise = jax.random.split(puck.key)
        memory, (force,) = self.preparation.commanded(puck.memory, action, jnp)
        position, velocity = moved(puck.theta, puck.position, puck.velocity, force)
        released = position >= LINE
        acceleration = force / puck.theta[0] - puck.theta[1] * GRAVITY
        at_line = jnp.maximum(puck.velocity**2 + 2 * acceleration * (LINE - puck.position), 0.0)
        rest = jnp.where(released, stops(puck.theta, LINE, at_line), stops(puck.theta, position, velocity**2))
        steps = puck.steps + 1
        over: Bool[Array, ""] = released | (steps >= STEPS)
        off = jnp.abs(rest - puck.mark)
        memory, seen = self.preparation.observed(memory, _measured(key_noise, position, velocity, puck.mark), jnp)
        after = Puck(position, velocity, puck.mark, puck.theta, steps, memory, key)
        reward = jnp.where(over, -off, 0.0)
        return EnvState(after, seen, reward, over, jnp.asarray(False), {"off": off, "released": released})


def _measured(key: jax.Array, position: Array, velocity: Array, mark: Array) -> Float[Array, "3"]:
    noise = jnp.asarray(NOISE) * jax.random.normal(key, (2,))
    return jnp.append(jnp.stack([position, velocity]) + noise, mark)


def trajectory(theta: Float[Array, "2"], forces: Float[Array, " time"]) -> Float[Array, "after 2"]:
    """Positions and velocities of a puck, initially at rest, at the start and after each force; there is no line."""

    def one(state, force):
        state = jnp.stack(moved(theta, *state, force))
        return state, state

    first = jnp.zeros(2)
    return jnp.concatenate([first[None], jax.lax.scan(one, first, forces)[1]])


def recorded(key: jax.Array, theta: Float[Array, "2"], forces: Float[Array, " time"]) -> Float[Array, "after 2"]:
    """The trajectory with measurement noise."""
    return trajectory(theta, forces) + jnp.asarray(NOISE) * jax.random.normal(key, (len(forces) + 1, 2))


EXPLORING = np.array([12.0] * 4 + [0.0] * 6 + [14.0] * 3 + [0.0] * 7, np.float32)
"""Forces of the recording that parameters are inferred from, in N."""
