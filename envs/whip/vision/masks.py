"""Keypoints from segmentation images: the cubes' centroids, and points along the DLO's mask."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.envs.whip.vision.raster import DLO

EVEN = (0.25, 0.5, 0.75, 1.0)
"""Fractions of the visible DLO's length, from the grip, at which it gets its keypoints; as for `keypoints.CLEAN`."""
MIN_COUNT = 5
"""Minimum number of pixels of an object that counts as seen."""
SAMPLES, KNOTS = 256, 32
"""Number of the DLO's pixels that its centreline is fitted to, and number of points of that line."""
BANDWIDTH = 3 / 256
"""Bandwidth of the smoothing along the line, in widths of the image: about half of the DLO's width."""
REACH = 4 / 256
"""Distance up to which pixels are neighbours, in widths of the image; gaps in the mask are bridged all the same."""


def keypoints(
    labels: Int[Array, "size size"],
    grip: Float[Array, "2"],
    arcs: Float[Array, "4"] | tuple[float, ...] = EVEN,
) -> tuple[Float[Array, "10 2"], Bool[Array, "10"]]:
    """Keypoints of one segmentation image (section VI-C); vmap for many.

    Args:
        labels: as `raster.segmentation` has them, possibly noisy.
        grip: approximate position of the gripper, in normalised pixels: it distinguishes the DLO's ends.
        arcs: fractions of the DLO's visible length.

    Returns:
        Keypoints in normalised pixels, those of the DLO and then the cubes bottom-up, shape [10, 2], NaN where not
        seen; which were seen, shape [10].
    """
    labels = despeckled(labels)
    line, dlo_seen = centreline(labels, grip)
    cubes, cubes_seen = centroids(labels)
    # The line along a handful of pixels may lead far away.
    points = jnp.clip(jnp.concatenate([along(line, jnp.asarray(arcs)), cubes]), 0.0, 1.0)
    seen = jnp.concatenate([jnp.broadcast_to(dlo_seen, len(arcs)), cubes_seen])
    return jnp.where(seen[:, None], points, jnp.nan), seen


def despeckled(labels: Int[Array, "size size"]) -> Int[Array, "size size"]:
    """The image without lone pixels: background where fewer than three of eight neighbours have a pixel's label.

    A corner of a square has three.
    """
    height, width = labels.shape
    padded = jnp.pad(labels, 1, constant_values=-1)
    around = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    alike = sum((padded[i : i + height, j : j + width] == labels).astype(jnp.int32) for i, j in around)
    return jnp.where(alike >= 3, labels, 0)


def centroids(labels: Int[Array, "size size"]) -> tuple[Float[Array, "6 2"], Bool[Array, "6"]]:
    """Centroids of the cubes' masks in normalised pixels, and which have enough pixels to count as seen."""
    of_cube = (labels == jnp.arange(1, DLO)[:, None, None]).astype(jnp.float32)
    in_columns, in_rows = of_cube.sum(1), of_cube.sum(2)
    count = in_rows.sum(-1)
    places = (jnp.arange(labels.shape[0]) + 0.5) / labels.shape[0]
    sums = jnp.stack([jnp.sum(in_columns * places, -1), jnp.sum(in_rows * places, -1)], axis=-1)
    return sums / jnp.maximum(count, 1.0)[:, None], count >= MIN_COUNT


def centreline(
    labels: Int[Array, "size size"], grip: Float[Array, "2"]
) -> tuple[Float[Array, "knots 2"], Bool[Array, ""]]:
    """The middle of the DLO's mask, from the end near the grip to the tip, for any shape and across gaps.

    Pixels are put in order by the length of their shortest path to the tip through the mask, and averaged in groups;
    the order is then refined by projection onto the line so found, as in principal curves (Hastie and Stuetzle, 1989).
    Paths leave the mask only where it is broken. Parts of the DLO that touch in the image are not distinguished.

    Returns:
        Points in normalised pixels, shape [K, 2], and whether there are enough pixels.
    """
    pixels, count = _some_pixels(labels == DLO)
    distance = jnp.linalg.norm(pixels[:, None] - pixels, axis=-1)
    # Beyond the reach a step costs so much that no path takes it if there is another way.
    cost = distance * (1 + (distance / jnp.maximum(REACH, 2 / labels.shape[0])) ** 8)
    tip = jnp.argmax(_path_lengths(cost, jnp.argmin(jnp.sum((pixels - grip) ** 2, axis=-1))))
    pixels = pixels[jnp.argsort(-_path_lengths(cost, tip))]
    line = pixels.reshape(KNOTS, -1, 2).mean(axis=1)
    place = jnp.repeat(_arc(line), SAMPLES // KNOTS)

    def refine(_, state):
        line, place = state
        place = _projected(pixels, place, line)
        return _smoothed(pixels, place, REACH), place  # at its ends, the line would bend towards corners of the mask

    line, place = jax.lax.fori_loop(0, 3, refine, (line, place))
    return _smoothed(pixels, _projected(pixels, place, line), -0.5 / labels.shape[0]), count >= MIN_COUNT


def _some_pixels(mask: Bool[Array, "size size"]) -> tuple[Float[Array, "samples 2"], Int[Array, ""]]:
    """`SAMPLES` pixels of a mask at equal intervals, in normalised pixels, and the number of its pixels."""
    size = mask.shape[0]
    rank = jnp.cumsum(mask.ravel())
    wanted = 1 + jnp.arange(SAMPLES) * rank[-1] // SAMPLES
    at = jnp.searchsorted(rank, wanted)
    return (jnp.stack([at % size, at // size], axis=-1) + 0.5) / size, rank[-1]


def _path_lengths(cost: Float[Array, "n n"], source: Int[Array, ""]) -> Float[Array, " n"]:
    """Costs of the cheapest paths from one node of a graph to all (Bellman and Ford)."""

    def relax(state):
        now = state[1]
        return now, jnp.min(now[:, None] + cost, axis=0)

    state = (jnp.full(cost.shape[0], jnp.inf), cost[source])
    return jax.lax.while_loop(lambda state: jnp.any(state[1] < state[0]), relax, state)[1]


def _arc(line: Float[Array, "knots 2"]) -> Float[Array, " knots"]:
    """Arc lengths of a line's points."""
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.linalg.norm(jnp.diff(line, axis=0), axis=-1))])


def _projected(
    pixels: Float[Array, "samples 2"], place: Float[Array, " samples"], line: Float[Array, "knots 2"]
) -> Float[Array, " samples"]:
    """Arc lengths of the pixels' projections onto a line or its straight continuation.

    A pixel stays near its former projection, even if another part of the line is nearer.
    """
    step, arc, ends = jnp.diff(line, axis=0), _arc(line), jnp.arange(KNOTS - 1)
    length = jnp.maximum(jnp.diff(arc), 1e-6)
    part = jnp.sum((pixels[:, None] - line[:-1]) * step, axis=-1) / length**2
    part = jnp.clip(part, jnp.where(ends == 0, -jnp.inf, 0.0), jnp.where(ends == KNOTS - 2, jnp.inf, 1.0))
    away = jnp.sum((pixels[:, None] - line[:-1] - part[..., None] * step) ** 2, axis=-1)
    candidate = arc[:-1] + part * length
    far = jnp.abs(candidate - place[:, None]) > 4 * REACH
    nearest = jnp.argmin(away + far, axis=-1)
    return jnp.take_along_axis(candidate, nearest[:, None], axis=-1)[:, 0]


def _smoothed(pixels: Float[Array, "samples 2"], place: Float[Array, " samples"], inset: float):
    """Pixels smoothed by local linear regression on their arc lengths, at equal intervals from first to last."""
    knots = jnp.linspace(place.min() + inset, place.max() - inset, KNOTS)
    away = place - knots[:, None]
    # Across gaps, and at the ends, the kernel widens until there is something to average.
    width = jnp.maximum(BANDWIDTH, 0.6 * jnp.sort(jnp.abs(away), axis=-1)[:, SAMPLES // 12, None])
    weight = jnp.exp(-0.5 * (away / width) ** 2)
    weight /= weight.sum(axis=-1, keepdims=True)
    mean = jnp.sum(weight * away, axis=-1, keepdims=True)
    variance = jnp.sum(weight * (away - mean) ** 2, axis=-1, keepdims=True)
    weight *= 1 - mean * (away - mean) / jnp.maximum(variance, 1e-12)
    return jnp.matmul(weight, pixels, precision="highest")
