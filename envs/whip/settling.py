"""Settling: the scene is simulated beyond the end of an episode, until the cubes are at rest."""

import jax
import jax.numpy as jnp

from jaxlfi.envs.whip.aftermath import Aftermath, displaced, retreat
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.scene import CUBES

REST = 1e-3
"""Speed of cubes, in m/s, below which the stack has come to rest."""
REST_SPIN = 0.08
"""Angular speed of cubes, in rad/s, likewise: the middle of a side of a small cube then moves at about `REST`."""


def aftermath(engine: Engine, parameters: WhipParameters, state: State) -> Aftermath:
    """What an episode that ended in this state leaves behind.

    Args:
        engine: the physics.
        parameters: parameters of the scene.
        state: state at the end of the episode.
    """
    cubes = lambda state: frames(engine.scene, parameters, state.qpos).cubes
    first = physics.reset(engine.scene, parameters)
    step = lambda state, action: (asleep(physics.act(engine, parameters, state, action)), None)
    last, _ = jax.lax.scan(step, state, retreat(state.target))
    return Aftermath(displaced(cubes(first), cubes(last), parameters.cube_side), last.failed)


def asleep(state: State) -> State:
    """The state, with the cubes' velocities set to zero if all cubes are nearly at rest.

    Cubes at rest stay where they are until something comes near, and the native engine leaves their contacts out.
    """
    speeds = jnp.abs(state.qvel[-6 * CUBES :].reshape(CUBES, 6))
    rest = jnp.all(speeds[:, :3] < REST) & jnp.all(speeds[:, 3:] < REST_SPIN)
    return state.replace(qvel=state.qvel.at[-6 * CUBES :].multiply(jnp.where(rest, 0.0, 1.0)))
