"""Milliseconds per frame."""

import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jaxlfi.envs.whip.vision import detectors
from jaxlfi.envs.whip.vision.segmenter import segment

FRAMES = 200
"""Number of frames that are timed, after ten that are not."""


def measured(weights: Path | None) -> list[dict]:
    """A row for the network alone and for each whole detector, on random pictures of an empty scene."""
    learnt, both = (detectors.pick(name, weights) for name in ("learnt", "learnt-transporter"))
    rgb = np.random.default_rng(0).integers(0, 256, (256, 256, 3)).astype(np.uint8)
    grip = np.array([0.4, 0.3])
    network = learnt.segmenter
    cases = {
        "network": lambda: segment(network.module, network.params, rgb),
        "network, and parts that lie apart": lambda: learnt.labels(rgb),
        "learnt": lambda: learnt(rgb, grip),
        "learnt-transporter": lambda: both(rgb, grip),
    }
    return [{"what": name, **_timed(work)} for name, work in cases.items()]


def _timed(work: Callable) -> dict[str, float]:
    times = []
    for _ in range(FRAMES + 10):
        begun = time.perf_counter()
        jax.block_until_ready(work())
        times.append(1e3 * (time.perf_counter() - begun))
    return {"median (ms)": float(np.median(times[10:])), "99 % (ms)": float(np.quantile(times[10:], 0.99))}
