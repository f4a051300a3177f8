"""Regenerates gillespie.npz, draws of the NumPy oracle (about a minute).

Run as `python -m tests.golden.make_gillespie`.
"""

import pathlib

import numpy as np

from tests.oracles import gillespie

PATH = pathlib.Path(__file__).with_name("gillespie.npz")
SIMULATIONS = 800
RECORDS = (1, 30, 150)  # whose states are kept beside the summaries
RATES = {
    "truth": (0.01, 0.5, 1.0, 0.01),
    "asymmetric": (0.004, 0.25, 0.4, 0.009),
}


def draw(name: str) -> np.ndarray:
    """Summaries and states at `RECORDS` of successful simulations, [S, 9 + 2 len(RECORDS)]."""
    rng = np.random.default_rng(20240607)
    rows = []
    while len(rows) < SIMULATIONS:
        trajectory = gillespie.simulate(rng, np.log(RATES[name]))
        if trajectory is not None:
            states = trajectory[list(RECORDS)].ravel()
            rows.append(np.concatenate([gillespie.nine_summaries(trajectory), states]))
    return np.array(rows, np.float32)


if __name__ == "__main__":
    np.savez_compressed(PATH, **{name: draw(name) for name in RATES})
