"""Shared by tests of the whipping task."""

import dataclasses

import numpy as np

from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS
from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.rig import START
from jaxlfi.rl.policy import Policy

EVERYWHERE = np.stack([np.linspace(0.2, 0.7, 10), np.linspace(0.3, 0.9, 10)], axis=1)
"""Ten keypoints, all different."""


class Rig:
    """Replacement for `ReferenceRig`: the gripper reaches its set-points, and nothing else moves."""

    def __init__(self, dlo, place):
        self.at = np.array(START)

    def reset(self):
        unturned = np.tile([1.0, 0, 0, 0], (6, 1))
        return Frames(gripper=self.at, dlo=np.zeros((20, 3)), cubes=np.zeros((6, 3)), orientations=unturned)

    def step(self, action):
        before, self.at = self.at, self.at + action
        frame, parts = self.reset(), np.arange(1, 11)[:, None] / 10
        every = {name: np.repeat(getattr(frame, name)[None], 10, axis=0) for name in ("dlo", "cubes", "orientations")}
        return Frames(gripper=before + parts * action, **every)


def found(key, camera, frame, side):
    """Replacement for detections in images: the DLO's points move with the gripper, and all are seen."""
    return EVERYWHERE + np.where(np.arange(10)[:, None] < 4, frame.gripper[0] - START[0], 0.0), np.ones(10, bool)


def a_policy(path, environment="whip"):
    """The file of a policy whose action is always (0.03, -0.03) m."""
    signals = {"observations": dataclasses.asdict(OBSERVATIONS), "actions": dataclasses.asdict(ACTIONS)}
    schema = {"environment": environment, **signals}
    bias = np.float32([0.5, -0.5])
    return Policy((np.zeros((28, 2), np.float32),), (bias,), schema).save(path)
