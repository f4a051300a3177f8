"""Where keypoints are along the DLO, on lines drawn by hand and keypoints put on them."""

import numpy as np
import pytest

from jaxlfi.envs.whip.vision.following import follow

ARCS = np.array([0.9, 0.2, 0.6, 0.35])
"""Places of four keypoints, in an order that is not that along the DLO."""
SHAPES = {
    "straight": [[0.3, 0.2], [0.7, 0.5]],
    "L": [[0.4, 0.1], [0.4, 0.4], [0.5, 0.4]],
    "Z": [[0.2, 0.2], [0.5, 0.2], [0.4, 0.6], [0.8, 0.7]],
}
"""Corners, from the grip to the tip."""


def line(corners, points: int = 61) -> np.ndarray:
    """Points that are equally far apart along the corners, shape [points, 2]."""
    corners = np.array(corners)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    return np.stack([np.interp(np.linspace(0, arc[-1], points), arc, corners[:, i]) for i in range(2)], axis=-1)


def on(drawn, arcs) -> np.ndarray:
    """Points of a line at fractions of its length, shape [..., 2]."""
    places = np.linspace(0, 1, len(drawn))
    return np.stack([np.interp(arcs, places, drawn[:, i]) for i in range(2)], axis=-1)


def followed(arcs, corners=SHAPES["L"], beside=0.0):
    """What follows of keypoints at these arcs, shape [N, T, K], on one line; each is so far to the right of it."""
    drawn = line(corners)
    places = on(drawn, arcs) + np.array([beside, 0.0])
    return follow(places, np.broadcast_to(drawn, (*np.shape(arcs)[:2], *drawn.shape)))


@pytest.mark.parametrize("name", SHAPES)
def test_places_on_a_line(name):
    """In any order, between its points."""
    arcs = np.random.default_rng(0).uniform(0.0, 1.0, (3, 5, 4))
    found = followed(arcs, SHAPES[name])
    np.testing.assert_allclose(found.arcs, arcs, atol=1e-9)
    np.testing.assert_allclose(found.away, 0, atol=1e-9)
    assert found.arcs.shape == found.away.shape == (3, 5, 4)


def test_each_frame_has_its_line():
    """Two rollouts of three frames: of the same keypoints, each frame tells another story."""
    places = np.tile([[0.4, 0.25], [0.45, 0.4]], (2, 3, 1, 1))
    lines = np.empty((2, 3, 61, 2))
    lines[:] = line(SHAPES["L"])
    lines[1, 2] = lines[1, 2, ::-1]
    lines[0, 1] += [0.05, 0.0]
    found = follow(places, lines)
    np.testing.assert_allclose(found.arcs[0, 0], [0.375, 0.875], atol=1e-9)  # of 0.3 down and 0.1 to the right
    np.testing.assert_allclose(found.arcs[1, 2], [0.625, 0.125], atol=1e-9)
    np.testing.assert_allclose(found.arcs[0, 1], [0.375, 0.75], atol=1e-9)
    np.testing.assert_allclose(found.away[0], [[0, 0], [0.05, 0], [0, 0]], atol=1e-9)


def test_places_beside_and_beyond_a_line():
    """The nearest point, which is an end for what is beyond it."""
    drawn = line(SHAPES["L"])
    places = np.array([[0.37, 0.2], [0.42, 0.45], [0.4, 0.02], [0.56, 0.48], [0.43, 0.38]])
    found = follow(places[None, None], drawn[None, None])
    np.testing.assert_allclose(found.arcs[0, 0], [0.25, 0.8, 0.0, 1.0, 0.825], atol=1e-9)
    np.testing.assert_allclose(found.away[0, 0], [0.03, 0.05, 0.08, 0.1, 0.02], atol=1e-9)


def test_points_that_coincide():
    """A line that has two in one place, as one of a failed simulation has."""
    drawn = line(SHAPES["straight"], 5)
    drawn[2] = drawn[1]
    found = follow(np.array([[[[0.7, 0.5], [0.3, 0.2]]]]), drawn[None, None])
    np.testing.assert_allclose(found.arcs[0, 0], [1, 0], atol=1e-9)


def test_drift_within_and_between_rollouts():
    """A keypoint that goes to and fro, one that is elsewhere in each rollout, one that does both, one that stays."""
    swing = 0.03 * np.array([1, -1, 1, -1, 1, -1])[None, :, None] * [0, 1, 1, 0]
    offset = np.array([0.05, -0.01, -0.04])[:, None, None] * [1, 0, 1, 0]
    found = followed(ARCS[None, None] + swing + offset)
    spread = np.std([0.05, -0.01, -0.04])
    np.testing.assert_allclose(found.mean, ARCS, atol=1e-9)
    np.testing.assert_allclose(found.within, [0, 0.03, 0.03, 0], atol=1e-9)
    np.testing.assert_allclose(found.between, [spread, 0, spread, 0], atol=1e-9)


def test_drift_within_is_the_mean_of_rollouts():
    swing = np.array([0.01, 0.05])[:, None] * [1, 1, -1, -1]
    found = followed(ARCS + swing[..., None] * [1, 0, 0, 0])
    np.testing.assert_allclose(found.within, [0.03, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found.between, 0, atol=1e-9)


@pytest.mark.parametrize("swaps", [0, 3, 7])
def test_the_share_of_frames_in_another_order(swaps):
    """Two neighbours of twenty keypoints are swapped, the first and the last in the detector's order."""
    arcs = np.tile(ARCS, (4, 5, 1))
    swapped = arcs.reshape(20, 4)
    swapped[:swaps, [0, 2]] = swapped[:swaps, [2, 0]]
    found = followed(arcs)
    assert found.switched == swaps / 20


def test_keypoints_that_meet_have_no_order():
    arcs = np.tile(ARCS, (1, 4, 1))
    arcs[0, 3, 3] = arcs[0, 3, 1]
    assert followed(arcs).switched == 0.25


def test_what_is_covered():
    """The span from the first keypoint found in a frame to the last, averaged over frames."""
    arcs = np.tile(ARCS, (2, 2, 1))
    assert followed(arcs).covered == pytest.approx(0.7)
    arcs[1, 1] = [0.1, 0.2, 0.3, 0.15]
    assert followed(arcs, beside=0.0).covered == pytest.approx((3 * 0.7 + 0.2) / 4)
