"""A reference object in the gripper, to be acted on like a real rig: one object, one episode after another."""

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.scene import PLACE, TIMESTEP, centreline, whip_model
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, START
from jaxlfi.envs.whip.rules import ACTION_LIMIT

FRAME_INTERVAL = 0.016
"""Between two frames, in s: 62.5 Hz, the frame rate nearest to a camera's 60 Hz that divides the control interval."""
SETTLING = 1.5
"""Time for which the object hangs before an episode begins, in s: soft objects stretch and bounce."""
FATAL = ("mjWARN_CONTACTFULL", "mjWARN_CNSTRFULL", "mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
"""Warnings of MuJoCo after which a simulation is invalid."""


class UnstableError(RuntimeError):
    """The simulation has become unstable."""


class ReferenceRig:
    """One object in its scene, by MuJoCo's finite elements: none of the physics that inference simulates with.

    Example:
        >>> from jaxlfi.envs.whip.reference_objects.objects import load
        >>> rig = ReferenceRig(load("dlo-1"))
        >>> rig.reset().gripper.round(3)
        array([0.4 , 0.36])
        >>> rig.step([0.03, 0.0]).dlo.shape  # frames, points, x y z
        (10, 17, 3)
    """

    def __init__(self, dlo: ReferenceObject, place: WhipParameters = PLACE):
        """Let the object come to rest.

        Args:
            dlo: the object in the gripper.
            place: the scene, of which the cubes and the position of the stack are used.

        Raises:
            UnstableError: if the simulation becomes unstable.
        """
        self.dlo, self.place = dlo, place
        self._model = whip_model(dlo, place)
        self._data = mujoco.MjData(self._model)
        self._target = np.array(START)
        self._data.ctrl[:] = START
        self._advance(round(SETTLING / TIMESTEP))
        self._data.time = 0.0
        self._rest = self._state()

    def reset(self) -> Frames:
        """Begin an episode: all at rest, seen in one frame."""
        mujoco.mj_resetData(self._model, self._data)  # forgets warnings
        mujoco.mj_setState(self._model, self._data, self._rest, mujoco.mjtState.mjSTATE_INTEGRATION)
        self._target = np.array(START)
        return self._look()

    def step(self, action: Float[np.ndarray, "2"]) -> Frames:
        """Apply one action, over one control interval.

        Args:
            action: displacement dx, dz of the gripper's set-point, in m, at most 0.06 each way.

        Returns:
            The ten frames of the interval, the last of which is its end.

        Raises:
            ValueError: for an action that is too large, or not two numbers.
            UnstableError: if the simulation becomes unstable.
        """
        action = np.asarray(action, float)
        if action.shape != (2,) or not (np.abs(action) <= ACTION_LIMIT + 1e-6).all():  # also refuses NaN
            raise ValueError(f"action: expected dx, dz of at most {ACTION_LIMIT} m, got {action.tolist()}")
        before, self._target = self._target, self._target + action
        seen, substeps = [], round(CONTROL_INTERVAL / TIMESTEP)
        for i in range(1, substeps + 1):
            self._data.ctrl[:] = before + i / substeps * action
            self._advance()
            if i % round(FRAME_INTERVAL / TIMESTEP) == 0:
                seen.append(self._look())
        return stacked(seen)

    def rollout(self, actions: Float[np.ndarray, "time 2"]) -> tuple[Float[np.ndarray, " frames"], Frames]:
        """One episode.

        Args:
            actions: as in `step`, shape [T, 2].

        Returns:
            Times of the 10 T + 1 frames from 0 on, in s, and the frames.

        Raises:
            ValueError: for actions that are too large.
            UnstableError: if the simulation becomes unstable.
        """
        frames = [stacked([self.reset()]), *(self.step(action) for action in np.asarray(actions, float))]
        together = jax.tree.map(lambda *parts: np.concatenate(parts), *frames)
        return np.arange(len(together.gripper)) * FRAME_INTERVAL, together

    def _look(self) -> Frames:
        # mj_step does not update positions in the world.
        mujoco.mj_fwdPosition(self._model, self._data)
        bodies = [self._data.body(colour) for colour in COLOURS]
        return Frames(
            gripper=self._data.body("gripper").xpos[[0, 2]],
            dlo=centreline(self.dlo, self._data),
            cubes=np.stack([body.xpos for body in bodies]),
            orientations=np.stack([body.xquat for body in bodies]),
        )

    def _state(self) -> np.ndarray:
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self._model, kind))
        mujoco.mj_getState(self._model, self._data, state, kind)
        return state

    def _advance(self, steps: int = 1) -> None:
        try:
            mujoco.mj_step(self._model, self._data, nstep=steps)
        except mujoco.FatalError as error:  # the first broken contact
            raise UnstableError(f"{self.dlo.name}: {error}") from error
        broken = [name for name in FATAL if self._data.warning[getattr(mujoco.mjtWarning, name)].number]
        if broken or not np.isfinite(self._data.qpos).all():
            raise UnstableError(f"{self.dlo.name}: became unstable at {self._data.time:.3f} s: {broken}")


def stacked(frames: list[Frames]) -> Frames:
    """Frames one after another."""
    return jax.tree.map(lambda *parts: np.stack(parts), *frames)
