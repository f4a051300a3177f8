"""Segmentation images against ray casting in NumPy and MuJoCo's renderer, and the keypoints found in them."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, stats
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import MEDIAN
from jaxlfi.envs.whip.rig import SECTION
from jaxlfi.envs.whip.vision import masks
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.keypoints import CLEAN, along
from jaxlfi.envs.whip.vision.raster import DLO, noisy, segmentation

SIDE = 0.025
STACK = np.array([0.6, 0.0, 0.0125]) + np.arange(6)[:, None] * [0.0, 0.0, SIDE]
UPRIGHT = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (6, 4))
SIDEWAYS = side_camera(MEDIAN)
TILTED = Camera(
    position=jnp.array([0.40, -0.80, 0.45]),
    orientation=jnp.asarray(Rotation.from_euler("xyz", [75.0, 5.0, -4.0], degrees=True).as_quat(scalar_first=True)),
    field_of_view=jnp.asarray(42.0),
)


def centreline(bend, length=0.25, start=(0.40, 0.0, 0.36)) -> np.ndarray:
    """Points of a DLO that hangs from `start`, its angle to the vertical being a function of s in [0, 1]; [25, 3]."""
    angle = bend((np.arange(24) + 0.5) / 24)
    links = length / 24 * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    return np.concatenate([[start], start + np.cumsum(links, axis=0)])


def scene(dlo, cubes=STACK, orientations=UPRIGHT) -> Frames:
    return Frames(*(jnp.asarray(part, jnp.float32) for part in (dlo[0, [0, 2]], dlo, cubes, orientations)))


def tumbled(seed: int) -> Frames:
    """A bent DLO that sways a little in y, and cubes strewn about, some before others."""
    rng = np.random.default_rng(seed)
    tilt, curl, wave = rng.uniform(-0.6, 0.6), rng.uniform(-1.5, 1.5), rng.uniform(-1, 1)
    dlo = centreline(lambda s: tilt + curl * s + wave * np.sin(5 * s), rng.uniform(0.2, 0.35))
    dlo[:, 1] += 0.01 * np.sin(np.linspace(0, 3, 25))
    cubes = rng.uniform([0.35, -0.06, 0.02], [0.65, 0.06, 0.3], (6, 3))
    return scene(dlo, cubes, Rotation.random(6, rng=rng).as_quat(scalar_first=True))


@functools.cache
def rasteriser(size: int):
    return jax.jit(lambda camera, frames, side: segmentation(camera, frames, side, size=size))


def seen(camera: Camera, frames: Frames, side: float = SIDE, size: int = 256) -> np.ndarray:
    return np.asarray(rasteriser(size)(camera, frames, side))


def labels_at(labels: np.ndarray, points) -> np.ndarray:
    """The labels at the places of points of the world."""
    columns, rows = np.floor(256 * np.asarray(project(SIDEWAYS, jnp.asarray(points, jnp.float32)))).astype(int).T
    return labels[rows, columns]


# ---------------------------------------------------------------------------------------- against ray casting


def corners_of_bodies(frames: Frames, side: float):
    """The eight corners of each cube and of each piece of the DLO, with their labels."""
    cube = side / 2 * np.array(list(itertools.product([-1, 1], repeat=3)))
    for i, (centre, turn) in enumerate(zip(np.asarray(frames.cubes), np.asarray(frames.orientations), strict=True)):
        yield i + 1, centre + Rotation.from_quat(turn, scalar_first=True).apply(cube)
    points = np.asarray(frames.dlo, float)
    links = np.diff(points, axis=0)
    ahead = links / np.linalg.norm(links, axis=1, keepdims=True)
    for i, t in enumerate(ahead):
        across = np.cross(t, [0, 1, 0])
        across /= np.linalg.norm(across)
        deep = np.cross(across, t)
        corners = []
        for node, other in ((i, max(i - 1, 0)), (i + 1, min(i + 1, len(ahead) - 1))):
            mitre = t + ahead[other]
            for a, b in itertools.product([-1, 1], repeat=2):
                edge = SECTION / 2 * (a * across + b * deep)  # carried along the piece to the mitre's plane
                corners.append(points[node] + edge - t * (edge @ mitre) / (t @ mitre))
        yield DLO, np.array(corners)


def cast(camera: Camera, frames: Frames, side: float, size: int) -> np.ndarray:
    """Labels in double precision: the nearest entry of each pixel's ray into the hulls of bodies' corners."""
    turn = Rotation.from_quat(np.asarray(camera.orientation), scalar_first=True)
    half = np.tan(np.deg2rad(float(camera.field_of_view)) / 2)
    axis = (2 * np.arange(size) + 1) / size - 1
    x, y = np.meshgrid(half * axis, -half * axis)
    rays = turn.apply(np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3))
    labels, nearest = np.zeros(size * size, int), np.full(size * size, np.inf)
    for label, corners in corners_of_bodies(frames, side):
        faces = ConvexHull(corners).equations  # normal @ x + offset <= 0 inside
        rate, height = rays @ faces[:, :3].T, np.asarray(camera.position) @ faces[:, :3].T + faces[:, 3]
        crossing = -height / rate
        enters = np.where(rate < 0, crossing, -np.inf).max(axis=1)
        leaves = np.where(rate > 0, crossing, np.inf).min(axis=1)
        hit = (enters < leaves) & (enters > 0) & (enters < nearest)
        labels[hit], nearest[hit] = label, enters[hit]
    return labels.reshape(size, size)


@pytest.mark.parametrize("camera", [SIDEWAYS, TILTED], ids=["side", "tilted"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_against_ray_casting(camera, seed):
    """A few of 9,216 rays pass within rounding of an edge."""
    frames = tumbled(seed)
    expected = cast(camera, frames, 0.03, 96)
    assert set(np.unique(expected)) == set(range(8))
    assert np.sum(seen(camera, frames, 0.03, 96) != expected) <= 2


def test_a_cube_in_front_hides_and_one_behind_is_hidden():
    dlo = centreline(lambda s: 0 * s)
    cubes = STACK.copy()
    cubes[2], cubes[4] = [0.40, -0.05, 0.20], [0.40, 0.05, 0.30]
    labels = seen(SIDEWAYS, scene(dlo, cubes))
    assert labels_at(labels, [[0.40, 0.0, 0.20], [0.40, 0.0, 0.30], [0.40, 0.0, 0.12]]).tolist() == [3, DLO, DLO]
    assert np.sum(labels == 5) > 0


def test_what_breaks_draws_nothing():
    """A simulation that failed, a point given twice, and a camera in the plane of a face."""
    frames = tumbled(0)
    broken = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), frames)
    assert not seen(TILTED, broken).any()
    twice = frames.replace(dlo=frames.dlo.at[7].set(frames.dlo[8]))
    assert np.sum((seen(TILTED, twice) == DLO) != (seen(TILTED, frames) == DLO)) < 20
    straight = scene(np.linspace([0.45, 0.0, 0.35], [0.45, 0.0, 0.15], 25))  # a joint is level with the camera
    assert np.sum(seen(SIDEWAYS, straight) == DLO) == 6 * 86  # 15 and 200 mm at the front's 595 mm to 256 pixels


def test_images_of_many_are_those_of_each():
    """Batched as one by one."""
    frames = [tumbled(3), tumbled(4)]
    many = jax.jit(jax.vmap(lambda frames: segmentation(TILTED, frames, SIDE, size=96)))
    both = many(jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames))
    for labels, one in zip(both, frames, strict=True):
        np.testing.assert_array_equal(labels, seen(TILTED, one, size=96))
    assert both.dtype == jnp.int32


# ------------------------------------------------------------------------------------ against MuJoCo's renderer


def mujocos(camera: Camera, frames: Frames, side: float) -> np.ndarray:
    """MuJoCo's segmentation of cubes, and of a DLO made of boxes."""
    mujoco = pytest.importorskip("mujoco")
    text = lambda array: " ".join(f"{number:.9g}" for number in np.ravel(array))
    geoms = [
        f'<geom type="box" size="{text([side / 2] * 3)}" pos="{text(at)}" quat="{text(turn)}"/>'
        for at, turn in zip(np.asarray(frames.cubes), np.asarray(frames.orientations), strict=True)
    ]
    geoms += [
        f'<geom type="box" size="{text([SECTION / 2] * 2)}" fromto="{text(a)} {text(b)}"/>'
        for a, b in itertools.pairwise(np.asarray(frames.dlo))
    ]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><visual><map znear="0.01"/></visual><worldbody><camera pos="{text(camera.position)}" '
        f'quat="{text(camera.orientation)}" fovy="{float(camera.field_of_view)}"/>{"".join(geoms)}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 256, 256) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera=0)
        return np.minimum(renderer.render()[..., 0] + 1, DLO)  # geoms in their order, -1 where there is none


@pytest.fixture
def renders(monkeypatch):
    """MuJoCo draws in memory, whichever way it would otherwise.

    Skipped without a software GL, a library of the system that pip cannot install. The rasteriser is there so that
    nothing else depends on one; against polygons drawn by hand it is tested everywhere.
    """
    pytest.importorskip("mujoco")
    try:
        from mujoco.osmesa import GLContext
        from mujoco.rendering.classic import gl_context

        monkeypatch.setattr(gl_context, "GLContext", GLContext)
        GLContext(8, 8).free()
    except Exception as error:  # of whatever library is missing
        pytest.skip(f"no OSMesa: {error}")


@pytest.mark.parametrize(("seed", "camera"), [(5, SIDEWAYS), (6, SIDEWAYS), (7, TILTED), (8, TILTED)])
def test_against_mujocos_renderer(renders, seed, camera):
    """Intersection over union of every label; links that meet in MuJoCo are not mitred."""
    frames = tumbled(seed)
    frames = frames.replace(dlo=frames.dlo.at[:, 1].set(0.0))
    ours, theirs = seen(camera, frames), mujocos(camera, frames, SIDE)
    for label in range(1, 8):
        assert np.sum(theirs == label) > 20
        assert np.sum((ours == label) & (theirs == label)) / np.sum((ours == label) | (theirs == label)) > 0.98


# -------------------------------------------------------------------------------------------- noise of a camera

_noisy = jax.jit(noisy)


def make_noisy(key, labels, specks=0.002, wobble=0.7):
    return _noisy(key, jnp.asarray(labels, jnp.int32), specks, wobble)


def test_specks_are_as_many_and_as_mixed_as_asked(key):
    noise = np.asarray(make_noisy(key, jnp.full((256, 256), 3), 0.08, 0.7))
    assert stats.binomtest(int(np.sum(noise != 3)), noise.size, 0.08 * 7 / 8).pvalue > 1e-3
    assert stats.chisquare(np.bincount(noise.ravel(), minlength=8)[[0, 1, 2, 4, 5, 6, 7]]).pvalue > 1e-3


def test_wobble_moves_boundaries_and_nothing_else(key):
    clean = seen(SIDEWAYS, tumbled(0))
    noise = np.asarray(make_noisy(key, clean, 0.0, 0.7))
    flat = ndimage.minimum_filter(clean, 9) == ndimage.maximum_filter(clean, 9)
    np.testing.assert_array_equal(noise[flat], clean[flat])
    edge = ndimage.minimum_filter(clean, 3) != ndimage.maximum_filter(clean, 3)
    assert 0.1 < np.mean(noise[edge] != clean[edge]) < 0.5


def test_wobble_is_as_strong_as_asked(key):
    """Columns numbered from left to right show where each pixel was fetched."""
    ramp = jnp.broadcast_to(jnp.arange(256), (256, 256))
    shift = np.asarray(make_noisy(key, ramp, 0.0, 2.0) - ramp)[20:-20, 20:-20]
    assert abs(shift.mean()) < 0.1
    assert 1.2 < shift.std() < 2.1  # less between the nodes of its grid than at them
    assert np.corrcoef(shift[:, 1:].ravel(), shift[:, :-1].ravel())[0, 1] > 0.8
    assert abs(np.corrcoef(shift[:, 8:].ravel(), shift[:, :-8].ravel())[0, 1]) < 0.05


def test_no_noise(key):
    clean = seen(SIDEWAYS, tumbled(0))
    np.testing.assert_array_equal(make_noisy(key, clean, 0.0, 0.0), clean)


# --------------------------------------------------------------------------------------- keypoints from masks

SHAPES = {
    "straight": lambda s: 0.4 + 0 * s,
    "J": lambda s: 0.2 - 2.2 * s**3,
    "S": lambda s: 0.3 + 1.5 * np.sin(2 * np.pi * s),
    "U": lambda s: -0.3 + np.pi / (1 + np.exp(-16 * (s - 0.55))),
    "C": lambda s: -1.0 + 4.0 * s,
}
"""Angles to the vertical; all are asymmetric, or their halves would hide a reversed DLO."""
find_many = jax.jit(jax.vmap(masks.keypoints))


def find(labels, grip, arcs=masks.EVEN):
    """Keypoints and which are seen, of one image; twice the same costs less than to compile once more."""
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (jnp.asarray(labels), grip, jnp.asarray(arcs)))
    return jax.tree.map(lambda leaf: leaf[1], find_many(*twice))


def shaped(name: str, length: float = 0.28) -> np.ndarray:
    """A DLO of that shape in the middle of the image."""
    line = centreline(SHAPES[name], length)
    return line - 0.5 * (line.min(0) + line.max(0)) + [0.42, 0.0, 0.30]


at = jax.jit(along)


def pixels_off(keypoints, dlo, fractions=masks.EVEN) -> np.ndarray:
    """Distances of the DLO's keypoints from its true points at these fractions, in pixels of 256."""
    truth = project(SIDEWAYS, at(dlo, jnp.asarray(fractions)))
    return 256 * np.linalg.norm(keypoints[:4] - truth, axis=-1)


def grip_of(dlo, *, off=(0.0, 0.0)):
    return project(SIDEWAYS, jnp.asarray(dlo[0], jnp.float32)) + jnp.array(off)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("noise", [0.0, 1.0], ids=["clean", "noisy"])
def test_keypoints_of_the_dlo(name, noise, key):
    """The grip's position is 11 pixels off, as with a displaced camera."""
    for length in (0.22, 0.34):
        dlo = shaped(name, length)
        labels = seen(SIDEWAYS, scene(dlo))
        labels = make_noisy(jax.random.clone(key), labels, 0.002 * noise, 0.7 * noise)
        keypoints, found = find(labels, grip_of(dlo, off=(0.02, -0.04)))
        off = pixels_off(keypoints, dlo)
        assert off[:3].max() < 2.5 and off[3] < 3.5, off
        assert found.all() and keypoints.shape == (10, 2)


def test_fractions_are_of_ones_choice():
    """The default fractions are those of the clean detector."""
    dlo, arcs = shaped("S"), jnp.array([0.1, 0.4, 0.6, 0.95])
    keypoints, _ = find(seen(SIDEWAYS, scene(dlo)), grip_of(dlo), arcs)
    assert pixels_off(keypoints, dlo, arcs).max() < 2.5
    np.testing.assert_allclose(CLEAN.nearest + CLEAN.spacing * np.arange(4), masks.EVEN)


def test_a_short_dlo():
    dlo = shaped("J", 0.06)
    keypoints, _ = find(seen(SIDEWAYS, scene(dlo)), grip_of(dlo))
    assert pixels_off(keypoints, dlo).max() < 3.5


@pytest.mark.parametrize("name", ["straight", "J", "C"])
@pytest.mark.parametrize("where", [0.3, 0.55])
def test_a_cube_before_the_dlo(name, where, key):
    """The mask is in two parts; the keypoints go on from one to the other."""
    dlo, cubes = shaped(name), STACK.copy()
    cubes[3] = np.asarray(at(dlo, jnp.full(4, where)))[0] + [0.0, -0.04, 0.0]
    labels = seen(SIDEWAYS, scene(dlo, cubes))
    assert ndimage.label(labels == DLO, np.ones((3, 3)))[1] == 2
    keypoints, found = find(make_noisy(key, labels), grip_of(dlo))
    assert pixels_off(keypoints, dlo).max() < 3.5
    assert 256 * np.linalg.norm(keypoints[4 + 3] - project(SIDEWAYS, jnp.asarray(cubes[3]))) < 1.5
    assert found.all()


def test_a_hidden_tip():
    """The fractions are those of what can be seen."""
    dlo, cubes = shaped("C"), STACK.copy()
    cubes[0] = dlo[-1] + [0.0, -0.03, 0.0]
    labels = seen(SIDEWAYS, scene(dlo, cubes))
    visible = np.mean(labels_at(labels, at(dlo, jnp.linspace(0.0, 1.0, 500))) == DLO)
    assert 0.85 < visible < 0.97
    keypoints, _ = find(labels, grip_of(dlo))
    assert pixels_off(keypoints, dlo, visible * np.array(masks.EVEN)).max() < 3


def test_keypoints_of_the_cubes(key):
    """The centroid of a mask, which is within a pixel of where the centre is seen."""
    frames = tumbled(2).replace(dlo=jnp.asarray(shaped("straight"), jnp.float32) - jnp.array([0.2, 0.0, 0.0]))
    cubes = np.array([0.32, 0.0, 0.05]) + np.arange(6)[:, None] * [0.05, 0.002, 0.01]
    frames = frames.replace(cubes=jnp.asarray(cubes, jnp.float32))
    labels = seen(SIDEWAYS, frames)
    centroids, found = masks.centroids(jnp.asarray(labels))
    expected = np.array(ndimage.center_of_mass(np.ones_like(labels), labels, range(1, 7)))[:, ::-1] + 0.5
    np.testing.assert_allclose(256 * np.asarray(centroids), expected, atol=1e-3)
    keypoints, _ = find(labels, jnp.zeros(2))
    truth = project(SIDEWAYS, frames.cubes)
    assert 256 * np.linalg.norm(keypoints[4:] - truth, axis=-1).max() < 1.0
    rough, _ = find(make_noisy(key, labels, 0.01, 0.7), jnp.zeros(2))
    assert 256 * np.linalg.norm(rough[4:] - truth, axis=-1).max() < 1.5
    assert found.all()


def test_what_is_not_in_the_image_is_not_seen():
    dlo, cubes = shaped("J"), STACK.copy()
    cubes[1] = [0.9, 0.0, 0.1]
    keypoints, found = find(seen(SIDEWAYS, scene(dlo, cubes)), grip_of(dlo))
    assert found.tolist() == [i != 4 + 1 for i in range(10)]
    np.testing.assert_array_equal(np.isnan(keypoints).any(axis=-1), ~found)
    nothing, found = find(jnp.zeros((256, 256), jnp.int32), jnp.zeros(2))
    assert np.isnan(nothing).all() and not found.any()


def test_lone_pixels_go_and_corners_stay():
    labels = np.zeros((12, 12), int)
    labels[2:5, 3:6] = 2
    expected = labels.copy()
    labels[9, 9] = labels[9, 10] = 7
    labels[4, 8] = labels[0, 0] = 5
    np.testing.assert_array_equal(masks.despeckled(jnp.asarray(labels)), expected)


@pytest.mark.slow
def test_keypoints_of_many_are_those_of_each():
    dlos = [shaped("S"), shaped("straight", 0.1)]
    labels, grips = [seen(SIDEWAYS, scene(dlo)) for dlo in dlos], [grip_of(dlo) for dlo in dlos]
    many, _ = find_many(jnp.asarray(labels), jnp.asarray(grips), jnp.tile(jnp.asarray(masks.EVEN), (2, 1)))
    for i in range(2):
        np.testing.assert_allclose(many[i], find(labels[i], grips[i])[0], atol=1e-6)
