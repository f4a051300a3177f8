"""Forward kinematics: frames from joint positions."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.scene import CUBES, Scene, cube_positions
from jaxlfi.envs.whip.quaternions import product, rotation
from jaxlfi.envs.whip.rig import START


def initial_positions(scene: Scene, parameters: WhipParameters) -> Float[Array, " nq"]:
    """Joint positions of the DLO hanging at rest, the gripper at its start and the cubes stacked.

    Returns:
        MuJoCo's qpos: the gripper's x and z in m, the angles (or quaternions) of the chain, and for each cube its
        position and quaternion.
    """
    straight = np.zeros(1) if scene.chain.planar else np.eye(1, 4)[0]
    cubes = jnp.concatenate([cube_positions(parameters, jnp), jnp.tile(jnp.eye(1, 4), (CUBES, 1))], axis=-1)
    parts = [jnp.asarray(START), jnp.tile(jnp.asarray(straight), scene.chain.elements), cubes.ravel()]
    return jnp.concatenate([part.astype(jnp.float32) for part in parts])


def frames(scene: Scene, parameters: WhipParameters, qpos: Float[Array, " nq"]) -> Frames:
    """The frame of one scene.

    Args:
        scene: the scene whose model has these joints.
        parameters: of the scene.
        qpos: joint positions as in `initial_positions`.
    """
    gripper, joints, cubes = jnp.split(qpos, [2, scene.first_cube])
    cubes = cubes.reshape(CUBES, 7)
    steps = scene.chain.fractions[:, None] * parameters.length * _directions(scene.chain, joints)
    grip = jnp.stack([gripper[0], jnp.zeros_like(gripper[0]), gripper[1]])
    nodes = grip + jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(steps, axis=0)])
    return Frames(gripper=gripper, dlo=nodes, cubes=cubes[:, :3], orientations=cubes[:, 3:])


def _directions(chain: Chain, joints: Float[Array, " positions"]) -> Float[Array, "links 3"]:
    """Unit vectors along the links; the stub's points down."""
    down = jnp.array([[0.0, 0.0, -1.0]])
    if chain.planar:
        angles = jnp.cumsum(joints)
        return jnp.concatenate([down, jnp.stack([-jnp.sin(angles), 0 * angles, -jnp.cos(angles)], axis=-1)])
    grip = jnp.array([0.5, 0.0, 0.5, 0.0]) * 2**0.5  # points the cable's x axis downwards

    def bend(orientation, joint):
        orientation = product(orientation, joint)
        return orientation, orientation

    _, orientations = jax.lax.scan(bend, grip, joints.reshape(chain.elements, 4))
    return jnp.concatenate([down, rotation(orientations)[..., 0]])
