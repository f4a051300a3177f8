"""Policies on the reference objects, as on a robot: they see keypoints of noisy images, and act in a closed loop."""

import contextlib
import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.control import LOOP, is_over, recording_of
from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.observer import FLAGS
from jaxlfi.envs.whip.parameters import HIGHEST, LOWEST
from jaxlfi.envs.whip.recording import Recording
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.observation import Perception
from jaxlfi.envs.whip.reference_objects.robot import ReferenceRobot
from jaxlfi.envs.whip.reference_objects.scene import PLACE
from jaxlfi.envs.whip.reference_objects.simulation import UnstableError
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.rl.deployment import Limits

Act = Callable[[np.ndarray], np.ndarray]
"""From an observation [28] to an action (dx, dz) in m."""
UNLIMITED = dataclasses.replace(LOOP, limits=Limits.none(2), margin=np.inf)
"""The loop without limits of its own: the rig refuses large actions, and leaving the workspace ends an episode."""


@dataclasses.dataclass(frozen=True)
class Deployed:
    """One episode on an object.

    Attributes:
        value: the return by the rules of section VI-G, hits being what the camera sees of them.
        hit: cubes hit by the end, bottom-up, shape [6].
        outside: whether it ended because the gripper left its workspace.
        failed: whether it ended because the simulation became unstable.
        steps: its number of control steps.
        observations: before each action and after the last one, shape [T + 1, 28].
        actions: shape [T, 2].
        left: what the episode leaves behind, once the gripper has retracted and the cubes have come to rest.
        recording: of all 16 steps, where these were asked for.
        frames: likewise, all true frames, ten to a step, shape [161].
    """

    value: float
    hit: Bool[np.ndarray, "6"]
    outside: bool
    failed: bool
    steps: int
    observations: Float[np.ndarray, "times 28"]
    actions: Float[np.ndarray, "steps 2"]
    left: Aftermath
    recording: Recording | None = None
    frames: Frames | None = None

    @property
    def clean_hit(self) -> bool:
        """Whether the top cube was hit and no other."""
        return bool(self.hit[rules.TOP] and not self.hit[: rules.TOP].any())


def places(key: jax.Array, n: int) -> tuple[list, list[Camera]]:
    """Scenes that are displaced as in training: the stack by up to 2 cm and 5 mm, the camera by up to 2.5 cm an axis.

    The first is the nominal one.
    """
    key_stack, key_camera = jax.random.split(key)
    draw = lambda key, low, high: np.array(
        jax.random.uniform(key, (n, len(low)), minval=jnp.asarray(low), maxval=jnp.asarray(high))
    )
    stacks, cameras = draw(key_stack, LOWEST.stack, HIGHEST.stack), draw(key_camera, LOWEST.camera, HIGHEST.camera)
    stacks[0], cameras[0] = 0.0, 0.0
    scenes = [PLACE.replace(stack=tuple(stack.tolist())) for stack in stacks]
    views = [
        side_camera(scene.replace(camera=tuple(camera.tolist()))) for scene, camera in zip(scenes, cameras, strict=True)
    ]
    return scenes, views


def deploy(
    key: jax.Array,
    dlo: ReferenceObject,
    act: Act,
    place=PLACE,
    camera: Camera | None = None,
    whole: bool = False,
    perception: Perception | None = None,
) -> Deployed:
    """One episode of a policy on an object.

    Args:
        key: of the camera's noise.
        dlo: the object in the gripper.
        act: the policy.
        place: the scene.
        camera: that sees it; by default the side camera of the scene.
        whole: record 16 steps: after the episode's end, whose outcome is returned, the gripper is held still.
        perception: what finds keypoints in a frame; by default `observation.found`.

    Raises:
        ValueError: for actions that are too large or not finite.
        UnstableError: if the object cannot come to rest.
    """
    robot = ReferenceRobot(key, dlo, place, camera, perception)
    log = None
    with contextlib.suppress(UnstableError):
        log = dataclasses.replace(UNLIMITED, clock=robot.simulated_clock).run(robot, act, whole)
    observations, actions = np.stack(robot.observations), np.stack(robot.actions)
    value, hit, outside, failed, steps = _outcome(observations)
    left = robot.aftermath()
    outcome = value, hit, outside, failed, steps, observations, actions, left.replace(failed=left.failed | failed)
    if not whole or log is None:
        return Deployed(*outcome)
    frames = jax.tree.map(lambda *parts: np.concatenate(parts), *robot.film)
    recording = recording_of(log, robot.about)
    return Deployed(*outcome, recording, frames)


def _outcome(observations: Float[np.ndarray, "times 28"]) -> tuple[float, np.ndarray, bool, bool, int]:
    """Return, cubes hit, whether outside, whether failed and number of steps, of an episode or as far as it came."""
    value, hit = 0.0, np.zeros(6, bool)
    for step, seen in enumerate(observations[1:], start=1):
        hit, outside = seen[FLAGS:] > 0.5, bool(rules.outside(seen[:2]))
        value += float(rules.reward(hit, outside))
        if is_over(seen) or step == rules.STEPS:
            return value, hit, outside, False, step
    return value, hit, False, True, len(observations)
