"""Segmentation images by ray casting, and the noise of a camera's masks."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.quaternions import rotation
from jaxlfi.envs.whip.rig import SECTION
from jaxlfi.envs.whip.vision.camera import Camera

DLO = len(COLOURS) + 1
"""The DLO's label. The cubes are 1 to 6, bottom-up; 0 is the background, including the gripper."""


class Bodies(struct.PyTreeNode):
    """Convex bodies of six faces: all x with normal @ x <= offset for each face.

    Attributes:
        normals: of the faces, outwards, shape [B, 6, 3].
        offsets: of the faces along their normals, in m, shape [B, 6].
    """

    normals: Float[Array, "bodies 6 3"]
    offsets: Float[Array, "bodies 6"]


class Hits(struct.PyTreeNode):
    """What the ray through each pixel hits first.

    Attributes:
        body: number of the body, from 1 on; 0 where there is none. Shape [size, size].
        nearness: one over the distance along the camera's axis, in 1/m; 0 where there is none. Shape [size, size].
    """

    body: Int[Array, "size size"]
    nearness: Float[Array, "size size"]


def segmentation(
    camera: Camera,
    frames: Frames,
    cube_side: Float[Array, ""] | float,
    width: Float[Array, ""] | float = SECTION,
    size: int = 256,
) -> Int[Array, "size size"]:
    """The perfect segmentation of one frame; vmap for many.

    Every pixel takes the label of the first body on the ray through its centre. The DLO is a bar of square section
    swept along its centreline, its sides along and across y. The
    gripper and the table are not drawn.

    Args:
        camera: through which the scene is seen.
        frames: one frame.
        cube_side: side of the cubes, in m.
        width: side of the DLO's section, in m.
        size: of the image, in pixels.

    Returns:
        Labels: 0 background, 1 to 6 the cubes, bottom-up, 7 the DLO; rows downwards, columns to the right.
    """
    return jnp.minimum(first_hits(camera, labelled(frames, cube_side, width), size).body, DLO)


def labelled(frames: Frames, cube_side: Float[Array, ""] | float, width: Float[Array, ""] | float = SECTION) -> Bodies:
    """The bodies that have labels: the cubes, bottom-up, then the pieces of the DLO."""
    cubes = boxes(frames.cubes, frames.orientations, jnp.full((len(COLOURS), 3), 0.5 * cube_side))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), cubes, _bar(frames.dlo, width))


def first_hits(camera: Camera, bodies: Bodies, size: int) -> Hits:
    """The visible parts of some bodies, none of which contains the camera."""
    numbers = jnp.arange(bodies.offsets.shape[0]) + 1
    faces, towards = planes(camera, bodies)
    axis = slopes(camera, size)

    def draw(hits, body):
        number, (x, y, z), towards = body
        enters, leaves = jnp.full((size, size), jnp.inf), jnp.zeros((size, size))
        for face in range(6):  # not an axis, as XLA's reductions over short axes are slow on CPU
            plane = x[face] * axis + (y[face] * axis + z[face])[:, None]
            enters = jnp.where(towards[face], jnp.minimum(enters, plane), enters)
            leaves = jnp.where(towards[face], leaves, jnp.maximum(leaves, plane))
        hit = (enters >= leaves) & (enters > hits.nearness)
        return Hits(jnp.where(hit, number, hits.body), jnp.where(hit, enters, hits.nearness)), None

    nothing = Hits(jnp.zeros((size, size), jnp.int32), jnp.zeros((size, size)))
    return jax.lax.scan(draw, nothing, (numbers, faces, towards))[0]


def slopes(camera: Camera, size: int) -> Float[Array, " size"]:
    """How far the rays of a row's or a column's pixels lead to the right or down, per distance ahead."""
    return ((jnp.arange(size) + 0.5) / size - 0.5) / camera.focal_length


def boxes(centres: Float[Array, "n 3"], orientations: Float[Array, "n 4"], half_sizes: Float[Array, "n 3"]) -> Bodies:
    """Boxes by their centres in m, orientations as unit quaternions, and half their sizes in m."""
    axes = jnp.swapaxes(rotation(orientations), -1, -2)
    normals = jnp.concatenate([axes, -axes], axis=-2)
    return Bodies(normals, jnp.sum(normals * centres[:, None], axis=-1) + jnp.tile(half_sizes, 2))


def _bar(centreline, width) -> Bodies:
    """One prism per segment, mitred where two meet."""
    step = jnp.diff(centreline, axis=0)
    length = jnp.linalg.norm(step, axis=-1, keepdims=True)
    along = step / jnp.maximum(length, 1e-12)  # 0 if points coincide; their prism's sides are then NaN
    across = _unit(jnp.cross(along, jnp.array([0.0, 1.0, 0.0])))
    deep = jnp.cross(across, along)
    before, after = along[:-1], along[1:]
    # The mitre of a fold would be a long spike: beyond 120 degrees both prisms end square.
    fold = jnp.sum(before * after, axis=-1, keepdims=True) < -0.5
    start = jnp.concatenate([along[:1], jnp.where(fold, after, _unit(before + after))])
    end = jnp.concatenate([jnp.where(fold, before, _unit(before + after)), along[-1:]])
    normals = jnp.stack([across, -across, deep, -deep, -start, end], axis=1)
    on = jnp.stack([centreline[:-1]] * 5 + [centreline[1:]], axis=1)
    half = 0.5 * width * jnp.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    return Bodies(normals, jnp.sum(normals * on, axis=-1) + half)


def _unit(vectors):
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def planes(camera: Camera, bodies: Bodies):
    """The faces as the camera sees them, three coefficients [B, 6] each, and which of them face it.

    A face's plane has the nearness x right + y down + z on the ray that leads so far to the right and down.
    """
    ahead = bodies.offsets - jnp.sum(bodies.normals * camera.position, axis=-1)
    towards = ahead < 0
    ahead = jnp.where(jnp.abs(ahead) < 1e-9, 1e-9, ahead)  # a plane through the pinhole
    local = jnp.matmul(bodies.normals, rotation(camera.orientation), precision="highest") / ahead[..., None]
    return (local[..., 0], -local[..., 1], -local[..., 2]), towards


def noisy(
    key: jax.Array,
    labels: Int[Array, "size size"],
    specks: Float[Array, ""] | float = 0.002,
    wobble: Float[Array, ""] | float = 0.7,
) -> Int[Array, "size size"]:
    """A segmentation with the errors of a learnt one: ragged boundaries, and salt-and-pepper noise.

    Args:
        key: of the image.
        labels: of one image, as `segmentation` gives them.
        specks: probability that a pixel gets a random label, 0 to 7.
        wobble: standard deviation of the displacement of boundaries, in pixels; displacements are drawn every four
            pixels and interpolated.
    """
    key_wobble, key_specks, key_salt = jax.random.split(key, 3)
    size = labels.shape[0]
    coarse = wobble * jax.random.normal(key_wobble, (2, -(-size // 4), -(-size // 4)))
    shift = jnp.round(jax.image.resize(coarse, (2, size, size), "linear")).astype(jnp.int32)
    rows, columns = jnp.clip(jnp.indices((size, size)) + shift, 0, size - 1)
    salt = jax.random.randint(key_salt, labels.shape, 0, DLO + 1)
    return jnp.where(jax.random.bernoulli(key_specks, specks, labels.shape), salt, labels[rows, columns])
