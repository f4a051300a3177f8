"""Policies on the reference objects, as on a robot: they see keypoints of noisy images, and act in a closed loop."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.episode import observation
from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import HIGHEST, LOWEST
from jaxlfi.envs.whip.recording import Recording
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.observation import HEX, IMAGE_SIZE, found
from jaxlfi.envs.whip.reference_objects.scene import PLACE, SIMULATOR
from jaxlfi.envs.whip.reference_objects.simulation import ReferenceRig, UnstableError, stacked
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.envs.whip.vision.keypoints import ON_DLO

POINTS = 29
"""Points of a centreline as it is rendered: those of the longest DLO of Phi, so that one program serves all objects."""

Act = Callable[[np.ndarray], np.ndarray]
"""From an observation [28] to an action (dx, dz) in m."""


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
    recording: Recording | None = None
    frames: Frames | None = None

    @property
    def clean_hit(self) -> bool:
        """Whether the top cube was hit and no other."""
        return bool(self.hit[rules.TOP] and not self.hit[: rules.TOP].any())


class Eye:
    """The camera of an episode: keypoints found in images; those not seen stay where they were seen last."""

    def __init__(self, key: jax.Array, camera: Camera, cube_side: float):
        """Nothing is seen yet."""
        self._key, self._camera, self._side, self._frames = key, camera, jnp.float32(cube_side), 0
        self._last: np.ndarray | None = None

    def see(self, frame: Frames) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints of a frame [10, 2], and which of them were seen [10]."""
        frame = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frame.replace(dlo=padded(frame.dlo, POINTS)))
        keypoints, seen = _found(jax.random.fold_in(self._key, self._frames), self._camera, frame, self._side)
        self._frames += 1
        keypoints, seen = np.asarray(keypoints), np.asarray(seen)
        # What was never seen is taken to be in the middle of the image.
        before = np.full_like(keypoints, 0.5) if self._last is None else self._last
        self._last = np.where(seen[:, None], keypoints, before)
        return self._last, seen


_found = jax.jit(found)


def padded(line: Float[np.ndarray, "n 3"], points: int) -> Float[np.ndarray, "points 3"]:
    """The same polyline with more points: its first segments are halved.

    Raises:
        ValueError: if it has more points than that, or fewer than half.
    """
    line, more = np.asarray(line), points - len(line)
    if not 0 <= more < len(line):
        raise ValueError(f"points: expected {len(line)} to {2 * len(line) - 1}, got {points}")
    halves = (line[:more] + line[1 : more + 1]) / 2
    first = np.stack([line[:more], halves], axis=1).reshape(-1, 3)
    return np.concatenate([first, line[more:]])


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
    key: jax.Array, dlo: ReferenceObject, act: Act, place=PLACE, camera: Camera | None = None, whole: bool = False
) -> Deployed:
    """One episode of a policy on an object.

    Args:
        key: of the camera's noise.
        dlo: the object in the gripper.
        act: the policy.
        place: the scene.
        camera: that sees it; by default the side camera of the scene.
        whole: record 16 steps: after the episode's end, whose outcome is returned, the gripper is held still.

    Raises:
        ValueError: for actions that are too large or not finite.
        UnstableError: if the object cannot come to rest.
    """
    rig = ReferenceRig(dlo, place)
    eye = Eye(key, side_camera(place) if camera is None else camera, place.cube_side)
    frame = rig.reset()
    keypoints, seen = eye.see(frame)
    start, hit, value = keypoints[ON_DLO:], np.zeros(6, bool), 0.0
    seen_so_far, grippers, points, hits = [seen], [frame.gripper], [keypoints], [hit]
    observations, actions, outcome, film = [_observed(frame, keypoints, hit)], [], None, [stacked([frame])]
    for step in range(1, rules.STEPS + 1):
        actions.append(np.zeros(2) if outcome is not None else np.asarray(act(observations[-1]), float))
        try:
            film.append(rig.step(actions[-1]))
        except UnstableError:
            outcome = outcome or (value, hit, False, True, step)
            break
        frame = jax.tree.map(lambda leaf: leaf[-1], film[-1])
        keypoints, seen = eye.see(frame)
        hit, outside = np.asarray(rules.hits(hit, start, keypoints[ON_DLO:])), bool(rules.outside(frame.gripper))
        value += float(rules.reward(hit, outside))
        observations.append(_observed(frame, keypoints, hit))
        for rows, row in ((seen_so_far, seen), (grippers, frame.gripper), (points, keypoints), (hits, hit)):
            rows.append(row)
        if outcome is None and (hit[rules.TOP] or outside or step == rules.STEPS):
            outcome = (value, hit, outside, False, step)
        if outcome is not None and not whole:
            break
    recording = None
    if whole and len(points) == rules.STEPS + 1:
        recording = Recording(
            times=CONTROL_INTERVAL * np.arange(len(points)),
            gripper=np.stack(grippers),
            keypoints=np.clip(np.stack(points), 0.0, 1.0),
            seen=np.stack(seen_so_far),
            actions=np.stack(actions),
            camera=eye._camera,
            source="simulated",
            description=f"{dlo.name} acted on by a policy, seen through noisy segmentation images",
            frame_rate=1 / CONTROL_INTERVAL,
            image_size=IMAGE_SIZE,
            hits=np.stack(hits),
            colours=HEX,
            provenance={"simulator": SIMULATOR},
        )
    frames = jax.tree.map(lambda *parts: np.concatenate(parts), *film) if recording else None
    return Deployed(*outcome, np.stack(observations), np.stack(actions), recording, frames)


def _observed(frame: Frames, keypoints: np.ndarray, hit: np.ndarray) -> np.ndarray:
    return np.asarray(observation(jnp.asarray(frame.gripper, jnp.float32), jnp.asarray(keypoints), jnp.asarray(hit)))
