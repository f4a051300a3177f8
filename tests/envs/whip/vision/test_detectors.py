"""Detectors: from pictures to keypoints, with the weights that the package comes with, and what is no picture."""

import functools

import jax
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.observer import Observer
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.trajectory import seen as frames_of
from jaxlfi.envs.whip.vision import detectors, looks, weights
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.detectors import Centreline
from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.envs.whip.vision.masks import EVEN
from jaxlfi.envs.whip.vision.photographer import Photographer
from jaxlfi.envs.whip.vision.renderers import RayCaster

SCENE = median(length=0.28, young=4e3)
CAMERA = side_camera(SCENE)
GRIP = np.array([0.42, 0.32])


@functools.cache
def rollout():
    return jax.device_get(jax.jit(lambda: frames_of(NativeEngine(), SCENE, exploratory_actions()))()[0])


def frame(step: int):
    return jax.tree.map(lambda leaf: leaf[step], rollout())


def truth(step: int) -> np.ndarray:
    """Where the keypoints are, in normalised pixels: the quarters of the DLO, and the middles of cubes."""
    one = frame(step)
    points = np.concatenate([np.asarray(along(jax.numpy.asarray(one.dlo), jax.numpy.asarray(EVEN))), one.cubes])
    return np.asarray(project(CAMERA, jax.numpy.asarray(points)))


def grip(step: int) -> np.ndarray:
    x, z = frame(step).gripper
    return np.asarray(project(CAMERA, jax.numpy.array([x, 0.0, z])))


@functools.cache
def picture(step: int) -> np.ndarray:
    rgb, _ = RayCaster().render(CAMERA, frame(step), 0.025, looks.plain(frame(step)))
    return rgb


learnt = functools.cache(lambda: detectors.pick("learnt"))


@pytest.mark.slow
@pytest.mark.parametrize("step", [0, 7, 12])
def test_what_is_learnt_finds_the_keypoints(step):
    keypoints, seen = learnt()(picture(step), grip(step))
    off = 256 * np.linalg.norm(np.asarray(keypoints) - truth(step), axis=1)
    assert np.all(seen)
    assert np.median(off[:4]) < 2.5 and off.max() < 6  # pixels; the middle of a cube is not that of its face


@pytest.mark.slow
def test_the_transporter_finds_points_of_the_dlo_in_their_order():
    arcs = []
    for step in (0, 5, 9, 13):
        keypoints, seen = detectors.pick("learnt-transporter")(picture(step), grip(step))
        line = np.asarray(project(CAMERA, jax.numpy.asarray(frame(step).dlo)))
        away = np.linalg.norm(np.asarray(keypoints)[:4, None] - line, axis=-1)
        assert np.all(seen) and 256 * away.min(axis=1).max() < 20
        arcs.append(away.argmin(axis=1))
    assert (np.diff(np.mean(arcs, axis=0)) > 0).all()


@pytest.mark.slow
def test_pictures_of_other_sizes_are_resized():
    small, _ = learnt()(picture(7), grip(7))
    large, seen = learnt()(np.repeat(np.repeat(picture(7), 2, axis=0), 2, axis=1), grip(7))
    assert np.all(seen)
    np.testing.assert_allclose(large, small, atol=2 / 256)


@pytest.mark.parametrize("shade", [0, 255])
@pytest.mark.parametrize("name", ["learnt", "learnt-transporter"])
def test_in_a_picture_of_nothing_nothing_is_seen(name, shade):
    keypoints, seen = detectors.pick(name)(np.full((256, 256, 3), shade, np.uint8), GRIP)
    assert not np.any(seen) and np.isnan(keypoints).all()
    observation = Observer().observe([0.4, 0.36], np.asarray(keypoints), np.asarray(seen))
    assert np.isfinite(observation).all()


def test_a_scene_without_a_dlo_still_has_its_cubes():
    one = frame(0)
    away = one.replace(dlo=one.dlo + np.array([0.0, -50.0, 0.0], np.float32))
    rgb, _ = RayCaster().render(CAMERA, away, 0.025, looks.plain(away))
    keypoints, seen = learnt()(rgb, grip(0))
    assert not np.any(seen[:4]) and np.all(seen[4:])
    assert np.isnan(keypoints[:4]).all() and np.isfinite(keypoints[4:]).all()


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((256, 256), np.uint8),
        np.zeros((256, 200, 3), np.uint8),
        np.zeros((32, 32, 3), np.uint8),
        np.zeros((256, 256, 4), np.uint8),
        np.zeros((256, 256, 3), np.float32),
        np.zeros((256, 256, 3), np.int32),
        "picture",
    ],
    ids=lambda wrong: "text" if isinstance(wrong, str) else f"{wrong.shape}-{wrong.dtype}",
)
def test_what_is_no_picture_is_refused(wrong):
    with pytest.raises(ValueError, match=r"^picture: expected a square picture") as error:
        learnt()(wrong, GRIP)
    assert "\n" not in str(error.value)


def test_labels_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"^picture: expected labels of 256 x 256"):
        Centreline()(np.zeros((128, 128), int), GRIP)


def test_unknown_detectors_and_weights_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^detector: expected one of centreline, learnt, learnt-transporter"):
        detectors.pick("yolo")
    with pytest.raises(weights.WeightsError, match=r"segmenter\.npz: expected the weights of a segmenter"):
        detectors.pick("learnt", tmp_path)


def test_weights_that_come_with_the_package_are_small_and_say_how_they_were_made():
    for kind, path in weights.SHIPPED.items():
        about = weights.load(path, kind).about
        assert path.stat().st_size < 5e6
        assert {"figures", "preset", "seed", "versions", "command_line"} <= set(about)


def test_a_mask_is_made_smaller_by_shares():
    mask = np.zeros((256, 256), bool)
    mask[8:12, 20:22] = True  # half of a block
    small = np.asarray(detectors.downsized(mask))
    assert small.shape == (64, 64, 1) and small[2, 5, 0] == 128 and small.sum() == 128


# ------------------------------------------------------------------------------------------------- a camera


@pytest.mark.slow
def test_a_photographer_sees_one_scene_with_one_look(key):
    rgb = []
    photographer = Photographer(jax.random.clone(key), RayCaster(), learnt())
    for _ in range(2):
        rgb.append(photographer.picture(jax.random.key(1), CAMERA, frame(0), 0.025))
    np.testing.assert_array_equal(rgb[0], rgb[1])
    other = photographer.picture(jax.random.key(2), CAMERA, frame(0), 0.025)
    assert np.any(other != rgb[0])  # its noise
    difference = np.abs(other.astype(float) - rgb[0])
    assert np.mean(difference) < 20  # and not its look
    again = Photographer(key, RayCaster(), learnt()).picture(jax.random.key(1), CAMERA, frame(0), 0.025)
    np.testing.assert_array_equal(again, rgb[0])


@pytest.mark.slow
def test_a_detector_of_labels_is_given_noisy_labels(key):
    photographer = Photographer(key, RayCaster(), Centreline())
    labels = photographer.picture(jax.random.key(1), CAMERA, frame(3), 0.025)
    assert labels.shape == (256, 256) and set(np.unique(labels)) == set(range(8))
    keypoints, seen = photographer(jax.random.key(1), CAMERA, frame(3), 0.025)
    assert seen.all() and 256 * np.linalg.norm(keypoints - truth(3), axis=1)[:4].max() < 4
