"""Pictures by ray casting: a scene in the light, with all that else may be in it. No graphics driver is needed."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.quaternions import rotation
from jaxlfi.envs.whip.rig import HAND
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.envs.whip.vision.looks import Look, Surface
from jaxlfi.envs.whip.vision.raster import DLO, Bodies, boxes, first_hits, labelled, planes, slopes

CUBES = DLO - 1
FAR = 20.0
"""Half the size of table and wall, in m."""
SHINE = 20
"""Exponent of highlights."""


def shaded(
    camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float, look: Look, size: int = 256
) -> tuple[tuple[Float[Array, "size size"], ...], Int[Array, "size size"]]:
    """The picture of one frame, and its labels.

    Faces are lit by two lights and from everywhere (Phong, 1975); they cast no shadows.

    Args:
        camera: through which the scene is seen.
        frame: what is seen.
        cube_side: side of the cubes, in m.
        look: colours, light, and what else is there.
        size: of the picture, in pixels.

    Returns:
        Three images: red, green and blue, from 0 to 1, which XLA for CPU would compute several times over if they were
        stacked here; and labels as in `raster.segmentation`: the gripper, and a hand before the DLO, are background.
    """
    objects, others = labelled(frame, cube_side), _others(frame, look)
    bodies = _joined(objects, others)
    hits = first_hits(camera, bodies, size)
    n = objects.offsets.shape[0]
    labels = jnp.where(hits.body > n, 0, jnp.minimum(hits.body, DLO))

    axis = slopes(camera, size)
    right, down = jnp.broadcast_to(axis, (size, size)), jnp.broadcast_to(axis[:, None], (size, size))
    rays = _times(rotation(camera.orientation), (right, -down, -jnp.ones_like(right)))
    depth = 1 / jnp.maximum(hits.nearness, 1e-3)
    points = tuple(camera.position[i] + depth * rays[i] for i in range(3))
    normals = _normals(camera, bodies, hits.body, right, down)

    table, wall = n + 2, n + 3  # after the gripper: numbers begin at 1
    pieces = objects.offsets.shape[0] - CUBES
    dlo = jnp.broadcast_to(look.colours[CUBES], (pieces, 3))
    plain = jnp.concatenate([look.colours[:CUBES], dlo, look.gripper[None], jnp.zeros((2, 3)), look.clutter.colours])
    plain = jnp.concatenate([jnp.zeros((1, 3)), plain])
    on_table, on_wall = _pattern(look.table, points), _pattern(look.wall, points)
    grain = 1 + jnp.where(hits.body >= table, look.grain[1], look.grain[0]) * _grain(look, points)
    light, highlight = _light(look, normals, rays)
    channels = []
    for c in range(3):
        colour = plain[hits.body, c]
        for body, surface, fraction in ((table, look.table, on_table), (wall, look.wall, on_wall)):
            colour = jnp.where(
                hits.body == body, surface.colours[0, c] * (1 - fraction) + surface.colours[1, c] * fraction, colour
            )
        channels.append(jnp.clip(look.tint[c] * (colour * grain * light + highlight), 0.0, 1.0))
    return tuple(channels), labels


def _others(frame: Frames, look: Look) -> Bodies:
    """What has no label: gripper, table, wall, and clutter, which is far behind the camera where it is not there."""
    x, z = frame.gripper[0], frame.gripper[1]
    upright = jnp.broadcast_to(jnp.eye(1, 4), (3, 4))
    centres = jnp.stack(
        [
            jnp.stack([x, jnp.zeros_like(x), z + HAND[2]]),
            jnp.array([0.0, 0.0, -FAR]),
            jnp.stack([jnp.zeros(()), look.wall_distance + FAR, jnp.zeros(())]),
        ]
    )
    half = jnp.concatenate([jnp.array([HAND]), jnp.full((2, 3), FAR)])
    clutter = look.clutter
    away = jnp.where(clutter.there[:, None], clutter.centres, jnp.array([0.0, -4 * FAR, 0.0]))
    return _joined(boxes(centres, upright, half), boxes(away, clutter.orientations, clutter.half_sizes))


def _joined(first: Bodies, second: Bodies) -> Bodies:
    return Bodies(jnp.concatenate([first.normals, second.normals]), jnp.concatenate([first.offsets, second.offsets]))


def _times(matrix: Float[Array, "3 3"], vectors):
    """A matrix times vectors that are three images."""
    return tuple(sum(matrix[i, j] * vectors[j] for j in range(3)) for i in range(3))


def _normals(camera: Camera, bodies: Bodies, body: Int[Array, "size size"], right, down):
    """Normals of the faces that are seen, three images; of bodies that are hit, that is the face which is entered."""
    (x, y, z), towards = planes(camera, bodies)
    at = jnp.maximum(body - 1, 0)
    nearest = jnp.full(body.shape, jnp.inf)
    normals: tuple[Array, ...] = (jnp.zeros(body.shape),) * 3
    for face in range(6):
        plane = x[at, face] * right + y[at, face] * down + z[at, face]
        first = towards[at, face] & (plane < nearest)
        nearest = jnp.where(first, plane, nearest)
        normals = tuple(jnp.where(first, bodies.normals[at, face, i], normals[i]) for i in range(3))
    return normals


def _pattern(surface: Surface, points):
    """Share of the second colour, 0 or 1."""
    x, y, z = points
    cos, sin = jnp.cos(surface.angle), jnp.sin(surface.angle)
    turned = (cos * x + sin * y, cos * y - sin * x, z)
    cells = [jnp.floor(turned[i] / surface.period + surface.phase[i]) for i in range(3)]
    chequered, striped = sum(cells) % 2, (cells[0] + cells[2]) % 2
    return jnp.where(surface.pattern == 1, chequered, jnp.where(surface.pattern == 2, striped, 0.0))


def _grain(look: Look, points):
    """Grain and stains: a sum of plane waves of about 1."""
    waves = [
        jnp.sin(sum(look.waves[k, i] * points[i] for i in range(3)) + look.phases[k])
        for k in range(look.phases.shape[0])
    ]
    return sum(waves) * (2 / len(waves)) ** 0.5


def _light(look: Look, normals, rays):
    """Light on the surfaces, and highlights."""
    light, highlight = look.ambient, 0.0
    length = jnp.sqrt(sum(ray**2 for ray in rays))
    for direction, brightness in zip(look.lights, look.brightness, strict=True):
        facing = sum(direction[i] * normals[i] for i in range(3))
        mirrored = sum((2 * facing * normals[i] - direction[i]) * -rays[i] for i in range(3)) / length
        light = light + brightness * jnp.maximum(facing, 0.0)
        shine = jnp.where(facing > 0, jnp.maximum(mirrored, 0.0), 0.0) ** SHINE
        highlight = highlight + look.gloss * brightness * shine
    return light, highlight
