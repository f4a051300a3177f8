"""What tests of the whipping task share."""

import dataclasses

import numpy as np

from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS
from jaxlfi.rl.policy import Policy


def a_policy(path, environment="whip"):
    """The file of a policy that always acts by (0.03, -0.03) m."""
    signals = {"observations": dataclasses.asdict(OBSERVATIONS), "actions": dataclasses.asdict(ACTIONS)}
    schema = {"environment": environment, **signals}
    bias = np.float32([0.5, -0.5])
    return Policy((np.zeros((28, 2), np.float32),), (bias,), schema).save(path)
