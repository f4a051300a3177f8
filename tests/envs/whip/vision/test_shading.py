"""Pictures by ray casting against rays into hulls and Phong's formula in NumPy, and the looks that are drawn."""

import colorsys
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from jaxlfi.envs.whip.rig import HAND
from jaxlfi.envs.whip.vision import looks
from jaxlfi.envs.whip.vision.camera import project
from jaxlfi.envs.whip.vision.looks import CLUTTER, PALETTE, WAVES
from jaxlfi.envs.whip.vision.raster import DLO, segmentation
from jaxlfi.envs.whip.vision.renderers import RENDERERS, RayCaster
from jaxlfi.envs.whip.vision.shading import SHINE, shaded
from tests.envs.whip.vision.test_raster import SIDEWAYS, STACK, TILTED, centreline, corners_of_bodies, scene, tumbled

SIZE, SIDE = 64, 0.03
CAMERAS = pytest.mark.parametrize("camera", [SIDEWAYS, TILTED], ids=["side", "tilted"])
NOTHING, TABLE, WALL, GRIPPER, CLUTTERED = 0, 8, 9, 10, 11
"""Numbers of what a ray hits, beyond the labels; background objects are 11 and more."""


@functools.cache
def caster():
    return jax.jit(lambda camera, frame, look: shaded(camera, frame, SIDE, look, SIZE))


@functools.cache
def rasteriser():
    return jax.jit(lambda camera, frame: segmentation(camera, frame, SIDE, size=SIZE))


@functools.cache
def plain() -> looks.Look:
    """The plain look, which is the same for all frames."""
    return looks.plain(tumbled(0))


@functools.cache
def many_looks():
    """Looks of 200 keys for one frame each."""
    return jax.jit(jax.vmap(looks.draw, in_axes=(0, None)))


def drawn(camera, frame, look) -> tuple[np.ndarray, np.ndarray]:
    """The picture, shape [size, size, 3], and the labels."""
    rgb, labels = caster()(camera, frame, look)
    return np.stack(rgb, axis=-1), np.asarray(labels)


def a_look(**changes):
    """The plain look with some of it replaced."""
    return plain().replace(**{name: jax.tree.map(jnp.asarray, part) for name, part in changes.items()})


def unit(vector) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


LIT = {
    "lights": np.stack([unit([0.6, -0.5, 0.3]), unit([-0.8, -0.3, 0.7])]),
    "brightness": np.array([0.3, 0.15]),
    "ambient": 0.25,
    "tint": np.array([1.0, 0.9, 0.8]),
}
"""Two lights from either side: of a cube's faces no two are equally bright, and none is brighter than white."""


def box(centre, quaternion, half) -> np.ndarray:
    """The eight corners of a box."""
    corners = np.array(list(itertools.product([-1, 1], repeat=3))) * np.asarray(half)
    return np.asarray(centre) + Rotation.from_quat(np.asarray(quaternion), scalar_first=True).apply(corners)


def bodies(frame, look):
    """Numbers and corners of all that is in the scene."""
    yield from corners_of_bodies(frame, SIDE)
    upright, (x, z) = [1, 0, 0, 0], np.asarray(frame.gripper)
    yield GRIPPER, box([x, 0, z + HAND[2]], upright, HAND)
    yield TABLE, box([0, 0, -1], upright, [9, 9, 1])
    yield WALL, box([0, float(look.wall_distance) + 1, 0], upright, [9, 1, 9])
    things = look.clutter
    for i in np.flatnonzero(things.there):
        yield CLUTTERED + i, box(things.centres[i], things.orientations[i], things.half_sizes[i])


def struck(camera, frame, look):
    """What each pixel's ray meets first, in double precision: number, point, outward normal, and the ray."""
    turn = Rotation.from_quat(np.asarray(camera.orientation), scalar_first=True)
    half = np.tan(np.deg2rad(float(camera.field_of_view)) / 2)
    axis = (2 * np.arange(SIZE) + 1) / SIZE - 1
    x, y = np.meshgrid(half * axis, -half * axis)
    rays = turn.apply(np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = np.asarray(camera.position, float)
    numbers, nearest, normals = np.zeros(len(rays), int), np.full(len(rays), np.inf), np.zeros_like(rays)
    for number, corners in bodies(frame, look):
        faces = np.unique(ConvexHull(corners).equations.round(9), axis=0)  # normal @ x + offset <= 0 inside
        rate, height = rays @ faces[:, :3].T, faces[:, :3] @ start + faces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -height / rate
        inwards = np.where(rate < 0, crossing, -np.inf)
        enters, leaves = inwards.max(axis=1), np.where(rate > 0, crossing, np.inf).min(axis=1)
        hit = (enters < leaves) & (enters > 0) & (enters < nearest)
        numbers[hit], nearest[hit] = number, enters[hit]
        normals[hit] = faces[inwards.argmax(axis=1)[hit], :3]
    points = start + np.where(np.isfinite(nearest), nearest, 0)[:, None] * rays
    shape = (SIZE, SIZE, 3)
    return numbers.reshape(SIZE, SIZE), points.reshape(shape), normals.reshape(shape), rays.reshape(shape)


def lit(look, normals) -> np.ndarray:
    """Light on faces of these normals."""
    facing = np.maximum(normals @ np.asarray(look.lights).T, 0)
    return float(look.ambient) + facing @ np.asarray(look.brightness)


def few(wrong, share=0.002) -> bool:
    """Whether no more pixels are wrong than have an edge within rounding of their centres."""
    return np.sum(wrong) <= share * np.size(wrong)


def strewn(frame, *, hand: bool):
    """The plain look with a hand before the DLO's middle and background objects beside it, or with these only."""
    n = CLUTTER + 1
    centres = np.array([0.2, 0.1, 0.05]) + np.arange(n)[:, None] * [0.09, 0.004, 0.04]
    centres[3] = [0.50, -0.10, 0.22]  # nearer than cubes
    centres[-1] = np.asarray(frame.dlo)[11] - [0, 0.03, 0]
    things = plain().clutter.replace(
        centres=jnp.asarray(centres, jnp.float32),
        half_sizes=jnp.asarray(np.tile([0.03, 0.01, 0.02], (n, 1)), jnp.float32),
        colours=jnp.asarray(np.linspace(0.1, 0.9, 3 * n).reshape(n, 3), jnp.float32),
        orientations=jnp.asarray(Rotation.random(n, rng=np.random.default_rng(2)).as_quat(scalar_first=True)),
        there=jnp.array([True, True, False, True, False, True, hand]),
    )
    return plain().replace(clutter=things, wall_distance=jnp.asarray(0.4))


# ----------------------------------------------------------------------------------------------------- labels


@pytest.mark.slow
@CAMERAS
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_labels_are_those_of_the_raster_but_for_what_is_nearer(camera, seed):
    """The table, the gripper and a hand hide things, and are background; what is behind hides nothing."""
    frame = tumbled(seed)
    perfect = np.asarray(rasteriser()(camera, frame))
    for look in (plain(), strewn(frame, hand=False), strewn(frame, hand=True)):
        _, labels = drawn(camera, frame, look)
        first, *_ = struck(camera, frame, look)
        assert np.sum(labels != np.where(first > DLO, 0, perfect)) <= 2
    assert np.sum((first > DLO) & (perfect == DLO)) >= 5  # the hand hides some of it


@CAMERAS
def test_labels_of_a_scene_that_nothing_hides(camera):
    """Above the table, beside the gripper: to the last pixel."""
    frame = scene(centreline(lambda s: 0.3 + 0.9 * s, start=(0.40, 0.0, 0.36)), STACK + np.array([0, 0, 0.01]))
    _, labels = drawn(camera, frame, plain())
    hidden = struck(camera, frame, plain())[0] == GRIPPER
    np.testing.assert_array_equal(labels[~hidden], np.asarray(rasteriser()(camera, frame))[~hidden])
    assert set(np.unique(labels)) == set(range(8))


# ------------------------------------------------------------------------------------------------------ light


@CAMERAS
def test_faces_are_lit_by_both_lights(camera):
    """Colour (ambient + sum of brightness max(0, n.l)) tint, with the normals of the bodies' hulls."""
    frame = tumbled(1)
    look = a_look(**LIT)
    rgb, labels = drawn(camera, frame, look)
    first, _, normals, _ = struck(camera, frame, look)
    colours = np.concatenate([np.ones((1, 3)), PALETTE, np.ones((2, 3)), np.asarray(look.gripper)[None]])[first]
    expected = LIT["tint"] * colours * lit(look, normals)[..., None]
    assert 0.02 < expected.min() < expected.max() < 0.98
    assert few(np.abs(rgb - expected).max(axis=-1) > 1e-4)
    for cube in range(1, DLO):
        seen = (labels == cube) & (first == cube)
        assert np.sum(np.abs(rgb - expected)[seen].max(axis=-1) < 1e-4) >= 8
    assert len(np.unique(np.round(lit(look, normals)[(first >= 1) & (first < DLO)], 6))) >= 12


def test_a_highlight_is_where_a_mirror_shows_the_light():
    """On the table: where the line of sight, mirrored, leads towards the light."""
    frame = tumbled(1).replace(gripper=jnp.array([-2.0, 0.36]))
    light = unit([-0.14, 0.93, 0.42])  # low behind the scene, a little to the left
    changes = {**LIT, "lights": np.stack([light, unit([0, 0, 1])]), "brightness": np.array([0.3, 0.0])}
    camera = TILTED.replace(position=jnp.array([0.40, -0.80, 0.45]))
    dull, shiny = (drawn(camera, frame, a_look(**changes, gloss=gloss))[0] for gloss in (0.0, 0.4))
    more = (shiny - dull).sum(axis=-1)
    first, *_ = struck(camera, frame, a_look(**changes))
    more[first != TABLE] = 0.0
    position = np.asarray(camera.position, float)
    sight = light * [1, 1, -1]
    place = position + position[2] / light[2] * sight
    column, row = SIZE * np.asarray(project(camera, jnp.asarray(place, jnp.float32)))
    found = np.array(np.unravel_index(more.argmax(), more.shape)) + 0.5
    assert first[int(row), int(column)] == TABLE and abs(place[0] - position[0]) > 0.05
    np.testing.assert_allclose(found, [row, column], atol=1.5)
    np.testing.assert_allclose(more.max(), 0.4 * 0.3 * LIT["tint"].sum(), rtol=0.01)


@CAMERAS
def test_highlights_are_only_where_light_falls(camera):
    """The line of sight mirrored at the face, times the direction of the light, to the power of 20.

    One light is a little below the table, which would mirror it.
    """
    frame, changes = tumbled(2), {**LIT, "lights": np.stack([unit([0.1, 0.95, -0.02]), unit([-0.6, -0.5, 0.4])])}
    look = a_look(**changes, gloss=0.4)
    rgb, _ = drawn(camera, frame, look)
    dull, _ = drawn(camera, frame, look.replace(gloss=jnp.asarray(0.0)))
    first, _, normals, rays = struck(camera, frame, look)
    mirrored = rays - 2 * np.sum(rays * normals, axis=-1, keepdims=True) * normals
    towards, facing = mirrored @ changes["lights"].T, normals @ changes["lights"].T
    shine = np.where(facing > 0, np.maximum(towards, 0) ** SHINE, 0) @ changes["brightness"]
    expected = 0.4 * shine[..., None] * changes["tint"]
    unclipped = rgb.max(axis=-1) < 1
    assert few((np.abs(rgb - dull - expected).max(axis=-1) > 2e-4) & unclipped)
    assert expected[unclipped].max() > 0.05
    dark = (first == TABLE) & (towards[..., 0] > 0.85) & (shine < 1e-6)
    assert dark.sum() > 50 and (rgb - dull)[dark].max() < 1e-5


@pytest.mark.slow
def test_colours_are_shares(key):
    """Checked for random looks, and for extreme lights and grain."""
    frame = tumbled(0)
    many = jax.device_get(many_looks()(jax.random.split(key, 200), frame))
    one = lambda i: jax.tree.map(lambda leaf: jnp.asarray(leaf[i]), many)
    pictures = np.stack([drawn(SIDEWAYS, frame, one(i))[0] for i in range(25)])
    wild = one(0).replace(brightness=jnp.array([3.0, 2.0]), grain=jnp.array([2.0, 2.0]), gloss=jnp.asarray(3.0))
    for rgb in (*pictures, drawn(TILTED, frame, wild)[0]):
        assert np.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1
    assert (drawn(TILTED, frame, wild)[0] == 1).any() and (drawn(TILTED, frame, wild)[0] == 0).any()
    assert len({picture.tobytes() for picture in pictures}) == 25 and pictures.std() > 0.1


# ------------------------------------------------------------------------------------------- patterns and grain

CLOTH = looks.Surface(
    colours=np.array([[0.1, 0.2, 0.3], [0.8, 0.6, 0.5]], np.float32),
    pattern=np.int32(1),
    period=np.float32(0.07),
    angle=np.float32(0.4),
    phase=np.array([0.3, 0.7, 0.2], np.float32),
)


@pytest.mark.parametrize("pattern", looks.PATTERNS)
def test_patterns_of_a_table_and_a_wall(pattern):
    """The pattern at points of the world is the sign of sines of half the period, turned about the vertical."""
    frame = tumbled(0)
    cloth = CLOTH.replace(pattern=np.int32(looks.PATTERNS.index(pattern)))
    look = a_look(table=cloth, wall=cloth, wall_distance=0.2, ambient=0.5, brightness=np.zeros(2))
    rgb, _ = drawn(TILTED, frame, look)
    first, points, _, _ = struck(TILTED, frame, look)
    turned = Rotation.from_euler("z", -0.4).apply(points.reshape(-1, 3)).reshape(points.shape)
    cells = turned / 0.07 + CLOTH.phase
    across = {"plain": [], "chequered": [0, 1, 2], "striped": [0, 2]}[pattern]
    second = np.prod(np.sin(np.pi * cells[..., across]), axis=-1) < 0 if across else np.zeros((SIZE, SIZE), bool)
    clear = (np.abs(cells - np.round(cells))[..., across] > 1e-3).all(axis=-1)
    for surface in (TABLE, WALL):
        where = clear & (first == surface)
        assert where.sum() > 200
        np.testing.assert_allclose(rgb[where], 0.5 * CLOTH.colours[second[where].astype(int)], atol=1e-5)
        if across:
            assert 0.3 < second[where].mean() < 0.7


def test_grain_is_a_sum_of_waves(key):
    """One strength for bodies, another for table and wall; its standard deviation is that strength."""
    frame = tumbled(0)
    heading = np.array(jax.random.normal(key, (WAVES, 3)))
    waves, phases = 150.0 * heading, np.linspace(0.1, 5.0, WAVES)
    changes = {"waves": waves, "phases": phases, "ambient": 0.5, "brightness": np.zeros(2), "wall_distance": 0.3}
    look = a_look(**changes, grain=np.array([0.05, 0.11]))
    even, _ = drawn(TILTED, frame, look.replace(grain=jnp.zeros(2)))
    rgb, labels = drawn(TILTED, frame, look)
    first, points, _, _ = struck(TILTED, frame, look)
    wave = np.sin(points @ waves.T + phases).sum(axis=-1) * np.sqrt(2 / WAVES)
    strength = np.where((first == TABLE) | (first == WALL), 0.11, 0.05)
    assert few(np.abs(rgb - even * (1 + strength * wave)[..., None]).max(axis=-1) > 1e-3)
    assert np.abs(rgb - even)[labels > 0].max() > 0.02
    np.testing.assert_allclose((rgb / even - 1)[first == WALL].std(), 0.11, rtol=0.1)


def test_what_is_not_there_changes_nothing():
    frame = tumbled(0)
    look = strewn(frame, hand=True)
    there = look.clutter.there
    gone = look.replace(clutter=look.clutter.replace(there=jnp.zeros_like(there)))
    bare = plain().replace(wall_distance=look.wall_distance)
    for camera in (SIDEWAYS, TILTED):
        for one, other in zip(drawn(camera, frame, gone), drawn(camera, frame, bare), strict=True):
            np.testing.assert_array_equal(one, other)
        assert np.mean(drawn(camera, frame, look)[0] != drawn(camera, frame, bare)[0]) > 0.01


def test_the_renderer_gives_bytes_of_the_same():
    """Checked for simulators' frames, in double precision."""
    frame = tumbled(2)
    look = strewn(frame, hand=True).replace(**{name: jnp.asarray(part) for name, part in LIT.items()})
    rgb, labels = drawn(TILTED, frame, look)
    with RENDERERS["raycast"](SIZE) as renderer:
        assert isinstance(renderer, RayCaster)
        double = jax.tree.map(lambda leaf: np.asarray(leaf, float), frame)
        picture, numbers = renderer.render(TILTED, double, SIDE, look)
    assert picture.dtype == numbers.dtype == np.uint8 and picture.shape == (SIZE, SIZE, 3)
    assert few(np.abs(picture - 255 * rgb).max(axis=-1) > 0.501)
    assert np.sum(numbers != labels) <= 2


# ------------------------------------------------------------------------------------------------------- looks


def test_colours_by_hue_saturation_and_value():
    """There and back, against Python's own."""
    rng = np.random.default_rng(0)
    colours = np.concatenate([rng.uniform(size=(200, 3)), PALETTE, [[1, 1, 1], [0.5, 0.5, 0.5]]])
    expected = np.array([colorsys.rgb_to_hsv(*colour) for colour in colours])
    found = np.asarray(looks._hsv(jnp.asarray(colours, jnp.float32)))
    np.testing.assert_allclose(found, expected, atol=5e-5)
    back = np.asarray(looks._rgb(*expected.T.astype(np.float32)))
    np.testing.assert_allclose(back, [colorsys.hsv_to_rgb(*each) for each in expected], atol=1e-5)
    np.testing.assert_allclose(back, colours, atol=1e-5)


@pytest.mark.slow
def test_colours_stay_told_apart(key):
    """Hues tell them apart; the blue cube and the DLO, whose hues are adjacent, differ in brightness."""
    frame = tumbled(0)
    colours = np.asarray(many_looks()(jax.random.split(key, 200), frame).colours, float)
    hues = np.array([[colorsys.rgb_to_hsv(*colour)[0] for colour in each] for each in colours])
    own = np.array([colorsys.rgb_to_hsv(*colour)[0] for colour in PALETTE])
    away = np.abs((hues[..., None] - own + 0.5) % 1.0 - 0.5)
    kinds = np.array([0, 1, 2, 3, 4, 5, 2])
    np.testing.assert_array_equal(kinds[away.argmin(axis=-1)], np.broadcast_to(kinds, (200, 7)))
    assert colours[:, 2].max() < colours[:, 6].max(axis=-1).min()
    assert hues.std(axis=0).min() > 0.005 and colours.max(axis=-1).std(axis=0).min() > 0.03
    assert colours.min() >= 0 and colours.max() <= 1


def test_a_hand_is_between_the_camera_and_a_point_of_the_dlo(key):
    """Before it and not in it, at any point but the grip and the last quarter."""
    frame = tumbled(1)
    things = jax.device_get(many_looks()(jax.random.split(key, 200), frame).clutter)
    hand, dlo = jax.tree.map(lambda leaf: leaf[:, -1], things), np.asarray(frame.dlo)
    away = np.linalg.norm((hand.centres[:, None] - dlo)[..., [0, 2]], axis=-1)
    assert away.min(axis=1).max() < 1e-6
    at = away.argmin(axis=1)
    assert at.min() == 1 and at.max() == 17 and len(np.unique(at)) == 17
    turn = Rotation.from_quat(hand.orientations, scalar_first=True)
    deep = np.abs(turn.as_matrix()[:, 1] * hand.half_sizes).sum(axis=-1)
    front = hand.centres[:, 1] + deep - dlo[at, 1]
    assert front.max() < -0.0075 and front.min() > -0.05  # the DLO is 15 mm deep
    assert 5 < hand.there.sum() < 50
    assert (things.centres[:, :-1, 1] > 0.05).all()


def test_all_of_a_look_is_drawn_by_itself(key):
    """No two numbers of 200 looks go together, and none is the same in all."""
    many = many_looks()(jax.random.split(key, 200), tumbled(0))
    things, skin = many.clutter, np.asarray(many.clutter.colours[:, -1], float)
    covers = [(np.log(one.period), one.angle, *one.phase.T, one.pattern) for one in (many.table, many.wall)]
    hand = [2 * np.arctan2(*things.orientations[:, -1, [2, 0]].T), *things.half_sizes[:, -1].T]
    columns = [
        *(number for cover in covers for number in cover),
        *many.lights[..., :2].reshape(200, -1).T,
        *(many.brightness.T, many.ambient, many.gloss, many.wall_distance, many.gripper[:, :1].T),
        *(many.tint.T, many.grain.T, many.phases.T, things.there.T, things.centres[:, 0].T),
        *np.transpose([colorsys.rgb_to_hsv(*colour) for colour in skin]),
        *hand,
    ]
    columns = np.concatenate([np.atleast_2d(column) for column in columns])
    together = np.abs(np.corrcoef(columns.astype(float)) - np.eye(len(columns)))
    assert np.isfinite(together).all()
    assert together.max() < 0.35


def test_a_look_is_that_of_its_key(key):
    """Eagerly, compiled, and of many at a time."""
    frame = tumbled(0)
    keys = jax.random.split(key, 200)
    many = many_looks()(jax.random.clone(keys), frame)
    eager = looks.draw(jax.random.clone(keys)[7], frame)
    again = many_looks()(jax.random.clone(keys), frame)
    for one, other, alone in zip(*(jax.tree.leaves(look) for look in (many, again, eager)), strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_allclose(one[7], alone, rtol=1e-4, atol=1e-5)
        assert one.dtype == alone.dtype
    assert not np.allclose(many.colours[0], many.colours[1], atol=1e-3)
