"""Pictures by MuJoCo's renderer against those by ray casting, and its contexts of OpenGL."""

import colorsys
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("mujoco")

from jaxlfi.envs.whip.quaternions import rotation
from jaxlfi.envs.whip.vision import looks
from jaxlfi.envs.whip.vision.camera import Camera, project
from jaxlfi.envs.whip.vision.gl import MuJoCoRenderer
from jaxlfi.envs.whip.vision.looks import PALETTE
from jaxlfi.envs.whip.vision.raster import DLO
from jaxlfi.envs.whip.vision.renderers import RENDERERS, RayCaster
from tests.envs.whip.vision.test_raster import SIDEWAYS, STACK, TILTED, centreline, scene, tumbled

SIDE = 0.03
CASES = pytest.mark.parametrize(("seed", "camera"), [(5, SIDEWAYS), (6, SIDEWAYS), (7, TILTED), (8, TILTED)])


@pytest.fixture(scope="module", autouse=True)
def in_memory():
    """Use OSMesa if it exists: the first backend imported stays for the process, and other tests draw with it."""
    with pytest.MonkeyPatch.context() as patch:
        for kind in ("osmesa", "egl"):
            patch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL") or kind)
            try:
                MuJoCoRenderer(8).close()
            except RuntimeError:
                patch.undo()
            else:
                yield
                return
    pytest.skip("neither EGL nor OSMesa")


@pytest.fixture(scope="module")
def renderer():
    with MuJoCoRenderer(256) as made:
        yield made


@pytest.fixture(scope="module")
def caster():
    return RayCaster(256)


def flat(seed: int):
    """A tumbled scene whose DLO is in the plane of motion, as links that meet in MuJoCo are not mitred."""
    frame = tumbled(seed)
    return frame.replace(dlo=frame.dlo.at[:, 1].set(0.0))


def plain(**changes) -> looks.Look:
    return looks.plain(tumbled(0)).replace(**{name: jnp.asarray(part) for name, part in changes.items()})


def overlap(ours, theirs, label: int) -> float:
    return np.sum((ours == label) & (theirs == label)) / np.sum((ours == label) | (theirs == label))


def random_look(seed: int, frame) -> looks.Look:
    """Other colours, with background objects, and a hand before the scene."""
    rng = np.random.default_rng(seed)
    look = plain(colours=np.clip(PALETTE * rng.uniform(0.8, 1.1, (7, 3)), 0, 1))
    half, centres = rng.uniform(0.01, 0.05, (7, 3)), rng.uniform([0.2, 0.1, 0.0], [0.7, 0.14, 0.4], (7, 3))
    centres[-1] = np.asarray(frame.dlo)[12] - [0.0, 0.03, 0.0]
    half[-1] = [0.03, 0.01, 0.02]
    things = look.clutter.replace(centres=centres, half_sizes=half, colours=rng.uniform(0.1, 0.9, (7, 3)))
    return look.replace(clutter=things.replace(there=np.ones(7, bool)), gripper=rng.uniform(0.1, 0.9, 3))


# ----------------------------------------------------------------------------------------- against ray casting


@pytest.mark.slow
@CASES
def test_labels_are_those_of_the_ray_caster(renderer, caster, seed, camera):
    """With a hand before the DLO, and background objects."""
    frame = flat(seed)
    look = random_look(seed, frame)
    _, ours = caster.render(camera, frame, SIDE, look)
    picture, theirs = renderer.render(camera, frame, SIDE, look)
    assert picture.shape == (256, 256, 3) and theirs.shape == (256, 256) and picture.dtype == theirs.dtype == np.uint8
    for label in range(8):
        assert np.sum(ours == label) > 20
        assert overlap(ours, theirs, label) > 0.97


@CASES
def test_colours_are_those_of_the_ray_caster(renderer, caster, seed, camera):
    """Away from edges; in the light of the camera's direction, so that shadows fall where it does not see them."""
    frame = flat(seed)
    ahead = np.asarray(rotation(camera.orientation))[:, 2]
    look = plain(lights=[ahead, [0.6, -0.5, 0.6245]], brightness=[0.4, 0.25], ambient=0.25)
    ours, labels = caster.render(camera, frame, SIDE, look)
    theirs, again = renderer.render(camera, frame, SIDE, look)
    near = []
    for label in range(1, 8):
        inside = ndimage.binary_erosion((labels == label) & (again == label), iterations=2)
        if inside.sum() < 20:
            continue
        one, other = ours[inside] / 255, theirs[inside] / 255
        near.append(np.median(np.abs(one - other).max(axis=-1)) < 0.05)
        hue, own = (colorsys.rgb_to_hsv(*colour)[0] for colour in (np.median(other, axis=0), PALETTE[label - 1]))
        assert abs((hue - own + 0.5) % 1.0 - 0.5) < 0.01
        order = np.argsort(PALETTE[label - 1], kind="stable")
        assert (np.diff(other[:, order], axis=1) >= -0.01).all()
    assert np.sum(near) >= 5 and np.mean(near) > 0.8  # one cube may be in another's shadow


def test_light_falls_from_where_it_comes(renderer, caster):
    """A cube that stands by itself, turned by an eighth: of its two sides the one towards the light is brighter."""
    frame = scene(centreline(lambda s: 0 * s), np.array([[0.45, 0.0, 0.25 + 0.3 * i] for i in range(6)]), eighth())
    for sign in (1, -1):
        look = plain(lights=[[0.8 * sign, -0.6, 0.0], [0, 0, 1]], brightness=[0.6, 0.0], ambient=0.2)
        for one in (renderer, caster):
            picture, labels = one.render(SIDEWAYS, frame, SIDE, look)
            columns = np.flatnonzero((labels == 1).any(axis=0))
            left, right = (picture[126:130, columns[len(columns) * part // 8]].mean() for part in (2, 6))
            assert (right - left) * sign > 30


def eighth() -> np.ndarray:
    turn = np.pi / 8
    return np.tile([np.cos(turn), 0.0, 0.0, np.sin(turn)], (6, 1))


# ---------------------------------------------------------------------------------------------- from look to look


def test_a_second_picture_is_that_of_the_first(renderer):
    """This also holds after a picture with another look, scene and camera."""
    frame, other = flat(5), flat(8)
    look = random_look(1, frame)
    first = renderer.render(SIDEWAYS, frame, SIDE, look)
    second = renderer.render(SIDEWAYS, frame, SIDE, look)
    changed = random_look(2, other).replace(table=chequered(0.1), wall=chequered(0.2), grain=jnp.array([0.1, 0.2]))
    between = renderer.render(TILTED, other, 0.02, changed)
    third = renderer.render(SIDEWAYS, frame, SIDE, look)
    for again in (second, third):
        np.testing.assert_array_equal(first[0], again[0])
        np.testing.assert_array_equal(first[1], again[1])
    assert np.mean(first[0] != between[0]) > 0.3


def chequered(period: float, colours=((0.9, 0.1, 0.1), (0.1, 0.1, 0.9)), pattern: int = 1) -> looks.Surface:
    parts = (colours, pattern, period, 0.0, (0.5, 0.5, 0.5))
    return looks.Surface(*(jnp.asarray(part) for part in parts))


ABOVE = Camera(jnp.array([0.45, 0.0, 0.8]), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.asarray(53.13))
"""It looks down at 0.8 m of the table."""


def away():
    """A scene with everything behind the wall."""
    frame = scene(centreline(lambda s: 0 * s, start=(9.0, 9.0, 0.36)), STACK + np.array([0.0, 9.0, 0.0]))
    return frame.replace(gripper=jnp.array([9.0, 0.36]))


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_a_table_has_the_chequers_of_the_look(renderer, axis):
    """Their colours and their size change with it."""
    pictures = []
    for period in (0.08, 0.05):
        for colours in (((0.9, 0.1, 0.1), (0.1, 0.1, 0.9)), ((0.9, 0.8, 0.1), (0.1, 0.5, 0.1))):
            look = plain(brightness=[0.0, 0.0], ambient=1.0).replace(table=chequered(period, colours))
            picture, labels = renderer.render(ABOVE, away(), SIDE, look)
            along = np.moveaxis(picture[20:236, 20:236], axis, 0)[:, 7] / 255
            second = np.argmin(np.abs(along[:, None] - np.array(colours)).max(axis=-1), axis=-1)
            sides = np.diff(np.flatnonzero(np.diff(second))) * 0.8 / 256
            np.testing.assert_allclose(sides, period, atol=0.008)
            pictures.append(picture.tobytes())
    assert len(set(pictures)) == 4 and not labels.any()


def test_a_wall_and_a_table_have_covers_of_their_own(renderer):
    look = plain(brightness=[0.0, 0.0], ambient=1.0, wall_distance=0.3)
    pictures = {}
    for table, wall in ((0.08, 0.08), (0.05, 0.08), (0.08, 0.05)):
        covered = look.replace(table=chequered(table), wall=chequered(wall))
        picture, _ = renderer.render(SIDEWAYS, away(), SIDE, covered)
        pictures[table, wall] = picture
    horizon = round(256 * float(project(SIDEWAYS, jnp.array([0.45, 0.3, 0.0]))[1]))
    on_wall, on_table = np.s_[: horizon - 3], np.s_[horizon + 3 :]
    first = pictures[0.08, 0.08]
    np.testing.assert_array_equal(first[on_wall], pictures[0.05, 0.08][on_wall])
    np.testing.assert_array_equal(first[on_table], pictures[0.08, 0.05][on_table])
    assert np.mean(first[on_table] != pictures[0.05, 0.08][on_table]) > 0.2
    assert np.mean(first[on_wall] != pictures[0.08, 0.05][on_wall]) > 0.2


def test_without_gloss_nothing_shines(renderer):
    """A grey table in even light is equally bright everywhere, wherever lights of zero brightness are."""
    grey = chequered(0.1, ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
    look = plain(brightness=[0.0, 0.0], ambient=1.0, gloss=0.0).replace(table=grey)
    picture, _ = renderer.render(ABOVE, away(), SIDE, look)
    np.testing.assert_allclose(picture / 255, 0.5, atol=0.01)


def test_a_pictures_tint_gripper_and_grain(renderer):
    frame = flat(5)
    white, _ = renderer.render(SIDEWAYS, frame, SIDE, plain())
    warm, _ = renderer.render(SIDEWAYS, frame, SIDE, plain(tint=[1.0, 0.9, 0.8]))
    ratio = warm.mean(axis=(0, 1)) / white.mean(axis=(0, 1))
    np.testing.assert_allclose(ratio, [1.0, 0.9, 0.8], atol=0.03)
    gripper, _ = renderer.render(SIDEWAYS, frame, SIDE, plain(gripper=[0.9, 0.1, 0.1]))
    column, row = np.floor(256 * np.asarray(project(SIDEWAYS, jnp.array([0.40, 0.0, 0.39])))).astype(int)
    assert gripper[row, column, 0] > 2 * gripper[row, column, 2]
    assert np.ptp(white[row, column].astype(int)) < 5


# ------------------------------------------------------------------------------------------------------- contexts


def test_two_threads_can_render(renderer):
    frames = [flat(5), flat(6), flat(7), flat(8)]
    wanted = [renderer.render(TILTED, frame, SIDE, random_look(i, frame)) for i, frame in enumerate(frames)]
    threads = set()

    def render(i):
        threads.add(threading.get_ident())
        return renderer.render(TILTED, frames[i], SIDE, random_look(i, frames[i]))

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(render, range(4)))
    for (picture, labels), (expected, numbers) in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(picture, expected)
        np.testing.assert_array_equal(labels, numbers)
    assert threads and threading.get_ident() not in threads


@pytest.mark.slow
def test_contexts_come_and_go(renderer):
    """Several at a time, of several sizes, one after another; what was there before goes on."""
    frame = flat(5)
    first, _ = renderer.render(SIDEWAYS, frame, SIDE, plain())
    with RENDERERS["mujoco"](64) as small, MuJoCoRenderer(48) as smaller:
        assert small.render(SIDEWAYS, frame, SIDE, plain())[0].shape == (64, 64, 3)
        assert smaller.render(SIDEWAYS, frame, SIDE, plain())[1].shape == (48, 48)
    for _ in range(2):
        with MuJoCoRenderer(64) as again:
            picture, labels = again.render(SIDEWAYS, frame, SIDE, plain())
        assert len(np.unique(labels)) == DLO + 1
        coarse = first.reshape(64, 4, 64, 4, 3).mean(axis=(1, 3))
        assert np.abs(picture - coarse).mean() < 8
    np.testing.assert_array_equal(renderer.render(SIDEWAYS, frame, SIDE, plain())[0], first)
    with pytest.raises(RuntimeError, match="shutdown"):
        again.render(SIDEWAYS, frame, SIDE, plain())


def test_where_there_is_no_opengl(monkeypatch):
    """It says what is missing, and leaves the process's settings as they were."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")
    with pytest.raises(RuntimeError, match=r"needs EGL or OSMesa .*apt install libosmesa6.*egl: .*; osmesa: "):
        MuJoCoRenderer(8)
    assert os.environ["PYOPENGL_PLATFORM"] == "glx"
    monkeypatch.delenv("PYOPENGL_PLATFORM")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(RuntimeError, match="got osmesa: ") as refusal:
        RENDERERS["mujoco"](8)
    assert "egl:" not in str(refusal.value) and "PYOPENGL_PLATFORM" not in os.environ


def test_frames_of_simulators_are_in_double_precision(renderer):
    frame = flat(6)
    double = jax.tree.map(lambda leaf: np.asarray(leaf, float), frame)
    one, other = (renderer.render(SIDEWAYS, each, jnp.float32(SIDE), plain()) for each in (frame, double))
    assert np.mean(one[1] != other[1]) < 1e-3 and np.abs(one[0].astype(int) - other[0]).mean() < 0.1
