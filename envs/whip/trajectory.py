"""Open-loop trajectories of states and actions, which inference compares."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.observer import hits_so_far, observation
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.envs.whip.vision.keypoints import Detector, detect, measured


def seen(engine: Engine, parameters: WhipParameters, actions: Float[Array, "time 2"]) -> tuple[Frames, Bool[Array, ""]]:
    """Frames of one scene before each action and after the last, T + 1 of them.

    All actions are applied, even after a hit or outside of the workspace.

    Returns:
        The frames, and whether the simulation has become unstable.
    """
    act = functools.partial(physics.act, engine, parameters)
    states = physics.scan_states(act, physics.reset(engine.scene, parameters), actions)
    view = jax.vmap(lambda qpos: frames(engine.scene, parameters, qpos))(states.qpos)
    return view, states.failed[-1]


def trajectory(
    key: jax.Array,
    engine: Engine,
    detector: Detector,
    camera: Camera,
    parameters: WhipParameters,
    actions: Float[Array, "time 2"],
) -> tuple[Float[Array, "time 30"], Bool[Array, ""]]:
    """One trajectory x = (S, A): the state before each action, and the action (section VI-F).

    Returns:
        The trajectory, and whether the simulation is valid.
    """
    # The last action takes effect after the last state.
    view, failed = seen(engine, parameters, actions[:-1])
    return as_seen(key, detector, camera, view, actions), ~failed


def as_seen(
    key: jax.Array, detector: Detector, camera: Camera, view: Frames, actions: Float[Array, "time 2"]
) -> Float[Array, "time 30"]:
    """The trajectory as a detector sees the frames before each action."""
    key_keypoints, key_gripper = jax.random.split(key)
    keypoints, _ = detect(key_keypoints, detector, camera, view)
    gripper = measured(key_gripper, detector, view.gripper)
    states = observation(gripper, keypoints, hits_so_far(keypoints))
    return jnp.concatenate([states, actions], axis=-1)
