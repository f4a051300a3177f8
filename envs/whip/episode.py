"""The whipping task as an environment: reset and step, pure, for one scene and batched by vmap."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip import rewards, rules
from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.observer import observation
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.settling import aftermath
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, ON_DLO, Detector, Tracking, begin, measured, track


class Episode(struct.PyTreeNode):
    """State of an episode between two steps.

    Attributes:
        state: state of the physics.
        tracking: state of the detector.
        start: the cubes' keypoints at the start, shape [6, 2].
        hit: cubes hit so far, bottom-up, shape [6].
        steps: number of steps so far.
    """

    state: State
    tracking: Tracking
    start: Float[Array, "*batch 6 2"]
    hit: Bool[Array, "*batch 6"]
    steps: Int[Array, "*batch"]


class Step(struct.PyTreeNode):
    """The values that a step returns to a learner.

    Attributes:
        observation: the gripper's x and z in m, four DLO and six cube keypoints in normalised pixels, six flags of
            cubes that have been hit, shape [28].
        reward: reward of this step, by the task's rule (`rewards`).
        terminated: whether the top cube has been hit or the gripper has left its workspace.
        truncated: whether the episode's time is up, or the simulation has become unstable.
        hit: cubes hit so far, bottom-up, shape [6].
        outside: whether the gripper has left its workspace.
        failed: whether the simulation has become unstable.
        seen: keypoints that were seen, shape [10]; the others are reported at their last position.
    """

    observation: Float[Array, "*batch 28"]
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    truncated: Bool[Array, "*batch"]
    hit: Bool[Array, "*batch 6"]
    outside: Bool[Array, "*batch"]
    failed: Bool[Array, "*batch"]
    seen: Bool[Array, "*batch 10"]


@dataclasses.dataclass(frozen=True)
class Whip:
    """The whipping task.

    Attributes:
        engine: the physics.
        detector: the error model of the keypoints.
        reward: name of the reward, one of `rewards.REWARDS`.

    Example:
        >>> import jax
        >>> from jaxlfi.envs.whip.physics.native import NativeEngine
        >>> from jaxlfi.envs.whip.parameters import median
        >>> whip = Whip(NativeEngine())
        >>> episode, observation = whip.reset(jax.random.key(0), median(length=0.25, young=2.5e4))
        >>> observation.shape
        (28,)
    """

    engine: Engine
    detector: Detector = DETECTORS["clean"]
    reward: str = rewards.REWARDS[0]

    def reset(self, key: jax.Array, parameters: WhipParameters) -> tuple[Episode, Float[Array, "28"]]:
        """The start of an episode in a scene, and the first observation."""
        key_begin, key_track, key_gripper = jax.random.split(key, 3)
        state = physics.reset(self.engine.scene, parameters)
        keypoints, _, tracking = self._look(key_track, parameters, begin(key_begin, self.detector), state)
        hit = jnp.zeros(6, bool)
        episode = Episode(state, tracking, keypoints[ON_DLO:], hit, jnp.asarray(0))
        return episode, observation(measured(key_gripper, self.detector, state.qpos[:2]), keypoints, hit)

    def step(
        self, key: jax.Array, parameters: WhipParameters, episode: Episode, action: Float[Array, "2"]
    ) -> tuple[Episode, Step]:
        """Apply an action (dx, dz), in m."""
        state = physics.act(self.engine, parameters, episode.state, action)
        key_track, key_gripper = jax.random.split(key)
        keypoints, seen, tracking = self._look(key_track, parameters, episode.tracking, state)
        gripper = state.qpos[:2]
        verdict = rules.judge(episode.hit, episode.start, keypoints[ON_DLO:], gripper, state.failed)
        steps = episode.steps + 1
        step = Step(
            observation=observation(measured(key_gripper, self.detector, gripper), keypoints, verdict.hit),
            reward=self._reward(parameters, episode, state, verdict, steps),
            terminated=verdict.over & ~state.failed,
            truncated=(steps >= rules.STEPS) | state.failed,
            hit=verdict.hit,
            outside=verdict.outside,
            failed=state.failed,
            seen=seen,
        )
        return Episode(state, tracking, episode.start, verdict.hit, steps), step

    def frames(self, parameters: WhipParameters, episode: Episode) -> Frames:
        """The current frame."""
        return frames(self.engine.scene, parameters, episode.state.qpos)

    def _reward(self, parameters, before, state, verdict, steps):
        if self.reward == "ordered":
            return jnp.where(state.failed, 0.0, rewards.ordered(verdict.hit, verdict.outside))
        if self.reward == "settled":
            ended = before.hit[rules.TOP] | rules.outside(before.state.qpos[:2]) | before.state.failed
            over = (verdict.over | (steps >= rules.STEPS)) & ~ended  # once, if steps go on beyond the end
            left = aftermath(self.engine, parameters, state.stopped(~over))  # other episodes are not simulated
            return jnp.where(over, rewards.settled(left, verdict.outside), 0.0)
        return verdict.reward

    def _look(self, key, parameters, tracking, state):
        seen = frames(self.engine.scene, parameters, state.qpos)
        return track(key, self.detector, side_camera(parameters), tracking, seen)
