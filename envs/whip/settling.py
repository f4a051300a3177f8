"""Settling: the scene simulated beyond the end of an episode, until what is left standing is at rest."""

import jax

from jaxlfi.envs.whip.aftermath import Aftermath, displaced, retreat
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.kinematics import frames


def aftermath(engine: Engine, parameters: WhipParameters, state: State) -> Aftermath:
    """What an episode that ended in this state leaves behind.

    Args:
        engine: the physics.
        parameters: of the scene.
        state: as the episode ended.
    """
    cubes = lambda state: frames(engine.scene, parameters, state.qpos).cubes
    first = physics.reset(engine.scene, parameters)
    last, _ = jax.lax.scan(
        lambda state, action: (physics.act(engine, parameters, state, action), None), state, retreat(state.target)
    )
    return Aftermath(displaced(cubes(first), cubes(last), parameters.cube_side), last.failed)
