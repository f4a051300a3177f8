"""Keypoints by projection: places along the DLO, and the statistics of detectors."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import MEDIAN
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.keypoints import (
    CLEAN,
    DETECTORS,
    MASK,
    NOISY,
    TRANSPORTER,
    Detector,
    along,
    begin,
    detect,
    measured,
    track,
)

CAMERA = side_camera(MEDIAN)


def swinging(steps: int) -> Frames:
    """A DLO of unequal segments that swings and bends as it goes; the cubes drift apart."""
    time = np.linspace(0, 1, steps)[:, None]
    angle = np.cumsum(np.broadcast_to(0.25 * time, (steps, 9)), axis=1) + 0.3 * time - np.pi / 2
    lengths = np.array([0.01, 0.05, 0.02, 0.03, 0.03, 0.02, 0.04, 0.01, 0.02])
    links = lengths[:, None] * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    gripper = np.concatenate([0.40 + 0.1 * time, 0.36 - 0.05 * time], axis=-1)
    start = np.stack([gripper[:, 0], 0 * gripper[:, 0], gripper[:, 1]], axis=-1)[:, None]
    dlo = np.concatenate([start, start + np.cumsum(links, axis=1)], axis=1)
    cubes = np.array([0.6, 0.0, 0.0]) + np.arange(6)[:, None] * [0.01, 0.002, 0.025] * (1 + time[..., None])
    orientations = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (steps, 6, 4))
    return Frames(*(jnp.asarray(np.float32(part)) for part in (gripper, dlo, cubes, orientations)))


FRAMES = swinging(16)
MANY = 200
one = jax.jit(detect)
many = jax.jit(jax.vmap(detect, in_axes=(0, None, None, None)))
start_many = jax.jit(jax.vmap(begin, in_axes=(0, None)))
at = jax.jit(lambda arcs: project(CAMERA, jax.vmap(along, in_axes=(0, None))(FRAMES.dlo, arcs)))
"""The true places of fractions of the DLO in all frames."""
places_along = jax.jit(along)
CUBES = jax.jit(project)(CAMERA, FRAMES.cubes)
TRUTH = np.concatenate([at(np.float32([0.25, 0.5, 0.75, 1.0])), CUBES], axis=1)


# ------------------------------------------------------------------------------------------------ along the DLO


def test_along_a_bent_line_by_hand():
    line = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [1.0, 0.0, -3.0]])
    expected = [[0, 0, 0], [0, 0, -1], [0, 0, -3], [0.5, 0, -3], [1, 0, -3]]
    np.testing.assert_allclose(places_along(line, jnp.array([0.0, 0.25, 0.75, 0.875, 1.0])), expected, atol=1e-6)


def test_more_points_on_the_same_line_change_nothing(key):
    corners = np.cumsum(np.random.default_rng(2).normal(size=(6, 3)), axis=0)
    fractions = np.sort(jax.random.uniform(key, (7,)))
    points = [corners[0]]
    for a, b in itertools.pairwise(corners):
        points += [a + part * (b - a) for part in (0.1, 0.4, 0.4, 1.0)]  # also one point twice
    np.testing.assert_allclose(
        places_along(np.float32(points), fractions),
        places_along(np.float32(corners), fractions),
        atol=1e-5,
    )


def test_along_a_circle():
    """Unequal chords of a quarter circle: the points are where the angle is in proportion."""
    angle = np.pi / 2 * np.linspace(0, 1, 400) ** 2
    arc = jnp.asarray(np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1), jnp.float32)
    expected = np.pi / 2 * np.array([0.3, 0.8])
    got = np.asarray(places_along(arc, np.float32([0.3, 0.8])))
    np.testing.assert_allclose(np.arctan2(got[:, 2], got[:, 0]), expected, atol=1e-4)


# ---------------------------------------------------------------------------------------------------- detectors


def test_clean_is_the_truth_at_quarters(key):
    keypoints, seen = one(key, CLEAN, CAMERA, FRAMES)
    assert seen.all() and keypoints.shape == (16, 10, 2)
    np.testing.assert_allclose(keypoints, TRUTH, atol=1e-6)
    np.testing.assert_allclose(keypoints[:, 3], jax.jit(project)(CAMERA, np.asarray(FRAMES.dlo)[:, -1]), atol=1e-6)


def test_a_transporters_places_are_uniform(key):
    """Order statistics of uniforms, spread by the spacing: the k-th of four is Beta(k, 5 - k) over the slack."""
    arcs = np.sort(start_many(jax.random.split(key, 2000), TRANSPORTER).arcs, axis=1)
    assert arcs.min() >= 0.1 and arcs.max() <= 1.0
    assert np.diff(arcs, axis=1).min() >= 0.1 - 1e-6
    for k in range(4):
        slack = (arcs[:, k] - 0.1 - 0.1 * k) / 0.6
        assert stats.kstest(slack, stats.beta(k + 1, 4 - k).cdf).pvalue > 1e-3


def test_a_transporters_orders_are_uniform(key):
    arcs = start_many(jax.random.split(key, 2400), TRANSPORTER).arcs
    _, counts = np.unique(np.argsort(arcs, axis=1), axis=0, return_counts=True)
    assert len(counts) == 24 and stats.chisquare(counts).pvalue > 1e-3


def test_places_and_order_stay_through_a_trajectory(key):
    """Without noise, a shuffled detector sees the same points of the DLO in all frames."""
    quiet = TRANSPORTER.replace(noise=0.0, cube_noise=0.0, missing=0.0)
    shuffled = []
    for own in jax.random.split(key, 4):
        keypoints, _ = one(own, quiet, CAMERA, FRAMES)
        arcs = begin(jax.random.fold_in(own, 0), quiet).arcs
        shuffled.append(sorted(arcs.tolist()) != arcs.tolist())
        np.testing.assert_allclose(keypoints, np.concatenate([at(arcs), CUBES], axis=1), atol=1e-6)
    assert any(shuffled)  # one in 24 is in order by chance


def test_noise_is_white(key):
    keypoints, _ = many(jax.random.split(key, MANY), NOISY, CAMERA, FRAMES)
    noise = (np.asarray(keypoints) - TRUTH) / np.array([0.01] * 4 + [0.001] * 6)[:, None]
    assert stats.kstest(noise.ravel()[::7], "norm").pvalue > 1e-3
    np.testing.assert_allclose(noise.std(axis=(0, 1)), 1.0, atol=0.06)  # every keypoint and coordinate
    for a, b in [
        (noise[:, 1:], noise[:, :-1]),
        (noise[:, :, 1:], noise[:, :, :-1]),
        (noise[..., 0], noise[..., 1]),
        (noise[1:], noise[:-1]),
    ]:
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size)


def test_missing_keypoints_stay_where_they_were(key):
    keypoints, seen = map(np.asarray, many(jax.random.split(key, MANY), Detector(missing=0.3), CAMERA, FRAMES))
    assert seen[:, 0].all() and seen[:, :, 4:].all()
    missing = ~seen[:, 1:, :4]
    assert stats.binomtest(int(missing.sum()), missing.size, 0.3).pvalue > 1e-3
    assert (missing[:, 1:] & missing[:, :-1]).any()  # also twice on end
    last = np.maximum.accumulate(np.where(seen, np.arange(16)[:, None], 0), axis=1)
    expected = np.take_along_axis(np.asarray(TRUTH)[None], last[..., None], axis=1)
    np.testing.assert_allclose(keypoints, expected, atol=1e-6)


def test_detectors_have_names():
    assert DETECTORS["transporter"] is TRANSPORTER and {"clean", "noisy"} < set(DETECTORS)
    with pytest.raises(TypeError):
        DETECTORS["mine"] = CLEAN


# ------------------------------------------------------------------------------------------------------ contract


def test_a_trajectory_is_frame_after_frame(key):
    """What an environment gets step by step is what `detect` gives."""
    tracking, frames = begin(jax.random.fold_in(key, 0), TRANSPORTER), []
    step = jax.jit(track)
    for t in range(16):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], FRAMES)
        *found, tracking = step(jax.random.fold_in(key, t + 1), TRANSPORTER, CAMERA, tracking, frame)
        frames.append(found)
    for steps, all_at_once in zip(zip(*frames, strict=True), one(key, TRANSPORTER, CAMERA, FRAMES), strict=True):
        np.testing.assert_allclose(np.stack(steps), all_at_once, atol=1e-6)


def test_batches_are_loops(key):
    keys = jax.random.split(key, MANY)
    keypoints, seen = many(keys, TRANSPORTER, CAMERA, FRAMES)
    for i in (0, 7):
        expected = one(keys[i], TRANSPORTER, CAMERA, FRAMES)
        np.testing.assert_allclose(keypoints[i], expected[0], atol=1e-6)
        np.testing.assert_array_equal(seen[i], expected[1])


def test_compiled_is_eager(key):
    frame = jax.tree.map(lambda leaf: leaf[3], FRAMES)
    tracking = begin(jax.random.fold_in(key, 0), TRANSPORTER)
    eager = track(key, TRANSPORTER, CAMERA, tracking, frame)
    compiled = jax.jit(track)(jax.random.clone(key), TRANSPORTER, CAMERA, tracking, frame)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), eager, compiled)


def test_the_numbers_of_a_detector_can_be_vmapped(key):
    levels = jnp.array([0.0, 0.01, 0.02])
    clean, less, more = jax.jit(jax.vmap(lambda noise: detect(key, Detector(noise=noise), CAMERA, FRAMES)[0]))(levels)
    np.testing.assert_allclose(more - clean, 2 * (less - clean), atol=1e-6)


def test_a_failed_simulation_is_seen_as_nothing(key):
    broken = jax.tree.map(lambda leaf: leaf.at[5:].set(jnp.nan), FRAMES)
    keypoints, _ = one(key, CLEAN, CAMERA, broken)
    assert np.isfinite(keypoints[:5]).all() and np.isnan(keypoints[5:]).all()


def test_lasting_errors_are_the_same_in_all_frames_and_others_in_every_trajectory(key):
    detector = Detector(bias=0.005)
    keypoints, _ = many(jax.random.split(key, MANY), detector, CAMERA, FRAMES)
    error = (np.asarray(keypoints) - TRUTH) / 0.005
    np.testing.assert_allclose(error, np.broadcast_to(error[:, :1], error.shape), atol=1e-3)
    lasting = error[:, 0].reshape(MANY, -1)
    assert stats.kstest(lasting.ravel(), "norm").pvalue > 1e-3
    correlation = np.corrcoef(lasting.T) - np.eye(20)
    assert np.abs(correlation).max() < 5 / np.sqrt(MANY)


def test_the_gripper_slips_by_its_own_amount(key):
    gripper = jnp.tile(jnp.array([0.4, 0.36]), (4000, 1))
    key_slipping, key_exact = jax.random.split(key)
    error = np.asarray(measured(key_slipping, MASK, gripper) - gripper) / 0.002
    assert stats.kstest(error.ravel(), "norm").pvalue > 1e-3
    np.testing.assert_array_equal(measured(key_exact, Detector(), gripper), gripper)


def test_points_with_places_of_their_own_move_and_slide(key):
    """Along a straight DLO seen at a right angle, so that arcs can be read off the picture."""
    places, n = np.array([0.1, 0.45, 0.6, 0.9]), 400
    detector = CLEAN.replace(places=tuple(places), moved=0.02, slide=0.03)
    line = np.linspace([0.40, 0.0, 0.36], [0.40, 0.0, 0.16], 25)
    still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], (20, *leaf.shape[1:])), FRAMES)
    still = still.replace(dlo=jnp.broadcast_to(jnp.asarray(line, jnp.float32), (20, 25, 3)))
    found, _ = many(jax.random.split(key, n), detector, CAMERA, still)
    ends = np.asarray(project(CAMERA, jnp.asarray(line[[0, -1]], jnp.float32)))[:, 1]
    arcs = (np.asarray(found)[:, :, :4, 1] - ends[0]) / (ends[1] - ends[0])
    np.testing.assert_allclose(arcs.mean(axis=(0, 1)), places, atol=5 * 0.02 / n**0.5)
    np.testing.assert_allclose(arcs.std(axis=1, ddof=1).mean(axis=0)[:3], 0.03, rtol=0.03)
    expected = (0.02**2 + 0.03**2 / 20) ** 0.5
    np.testing.assert_allclose(arcs.mean(axis=1).std(axis=0), expected, rtol=5 / (2 * n) ** 0.5)
