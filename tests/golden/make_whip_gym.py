"""Write whip_gym.npz: episodes of the whip's gymnasium environments, as they were before these had a common adapter.

python tests/golden/make_whip_gym.py
"""

from pathlib import Path

import numpy as np

from jaxlfi.envs.whip.gym import WhipGym, WhipVector, initial_domain
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.native import NativeEngine

PATH = Path(__file__).with_name("whip_gym.npz")
ENGINE = NativeEngine(threads=1)
WHIP = np.array([[-0.06, 0.0]] * 2 + [[0.06, 0.0]] * 4 + [[0.0, 0.0]] * 10, np.float32)
"""Back and forth: mu's DLO hits the top cube only, with the seventh."""
ENDS = np.array([[0.0, 0.05], [-0.02, 0.0], [0.01, 0.0]], np.float32)
"""The first two leave the workspace, at times of their own."""


def single(environment, seed, actions):
    """Rows of observation, reward, ends, modulus and length: of resets, and of steps."""
    rows = []

    def reset(seed=None):
        seen, info = environment.reset(seed=seed)
        rows.append([*seen, 0, 0, 0, info["young"], info["length"]])

    reset(seed)
    for action in actions:
        seen, reward, terminated, truncated, info = environment.step(action)
        rows.append([*seen, reward, terminated, truncated, info["young"], info["length"]])
        if terminated or truncated:
            reset()
    return np.array(rows, np.float32)


def several(environments, seed, steps):
    """The same of three side by side, and the last observations, hits and moduli of what ended in the same step."""
    seen, info = environments.reset(seed=seed)
    rows, finals = [np.stack([*seen.T, *np.zeros((3, 3)), info["young"], info["length"]], axis=1)], []
    for t in range(steps):
        seen, *results, info = environments.step(ENDS * np.float32([[1], [1], [(-1.0) ** t]]))
        rows.append(np.stack([*seen.T, *results, info["young"], info["length"]], axis=1))
        for i in np.flatnonzero(info.get("_final_obs", np.zeros(3, bool))):
            final = info["final_info"]
            finals.append([*info["final_obs"][i], *final["hit"][i], final["young"][i]])
    return np.array(rows, np.float32), np.array(finals, np.float32)


def fixed():
    """In mu's scene, without noise."""
    return single(WhipGym(engine=ENGINE), 0, WHIP)


def drawn():
    """In scenes that are drawn, with noise."""
    return single(WhipGym(initial_domain, "transporter", ENGINE), 1, np.tile(ENDS[:1], (6, 1)))


def in_the_next_step():
    """Three of these, which begin anew in the step after the end."""
    return several(WhipVector(3, initial_domain, "transporter", ENGINE), 7, 18)[0]


def in_the_same_step():
    """Three of given lengths, whose nuisances are drawn, and which begin anew in the step in which they end."""
    lengths, given = np.array([0.2, 0.25, 0.3]), {"nuisances": "random", "autoreset_mode": "SameStep"}
    return several(WhipVector(3, median(lengths, 1e4), "mask", ENGINE, **given), 7, 17)


if __name__ == "__main__":
    same, final = in_the_same_step()
    np.savez_compressed(PATH, fixed=fixed(), drawn=drawn(), next=in_the_next_step(), same=same, final=final)
