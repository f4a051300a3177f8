"""A network that segments pictures: which pixel is which cube, the DLO, or neither."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.envs.whip.vision import photograph
from jaxlfi.envs.whip.vision.pictures import LABELS

BLOCK = 4
"""Side of the blocks of pixels that are one place to the network."""


class Segmenter(nn.Module):
    """An encoder-decoder with skip connections (Ronneberger et al., 2015) on blocks of 4 x 4 pixels.

    Attributes:
        widths: channels at blocks of 4, 8 and 16 pixels.
    """

    widths: tuple[int, ...] = (32, 48, 96)

    @nn.compact
    def __call__(self, rgb: Float[Array, "batch height width 3"]) -> Float[Array, "batch height width 8"]:
        """Logits of the labels of each pixel, of colours from 0 to 1; height and width are multiples of 16."""
        x = blocks(2 * rgb - 1, BLOCK)
        skipped = []
        for depth, width in enumerate(self.widths):
            if depth:
                skipped.append(x)
            x = nn.relu(_conv(width, 2 if depth else 1)(x))
            x = nn.relu(_conv(width)(x)) if depth < 2 else _residual(width, x)
        for width, skip in zip(self.widths[-2::-1], reversed(skipped), strict=True):
            x = nn.relu(_conv(width)(jnp.concatenate([_enlarged(x), skip], axis=-1)))
        return pixels(nn.Conv(len(LABELS) * BLOCK**2, (1, 1))(x), BLOCK)


def _conv(width: int, stride: int = 1) -> nn.Conv:
    return nn.Conv(width, (3, 3), strides=stride, kernel_init=nn.initializers.he_normal())


def _residual(width: int, x: Array) -> Array:
    inner = nn.relu(_conv(width)(x))
    return x + nn.relu(_conv(width)(inner))


def blocks(x: Array, side: int) -> Array:
    """Blocks of pixels as channels."""
    n, height, width, channels = x.shape
    x = x.reshape(n, height // side, side, width // side, side, channels)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(n, height // side, width // side, side * side * channels)


def pixels(x: Array, side: int) -> Array:
    """The inverse of `blocks`."""
    n, height, width, channels = x.shape
    x = x.reshape(n, height, width, side, side, channels // side**2)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(n, height * side, width * side, channels // side**2)


def _enlarged(x: Array) -> Array:
    """Twice as high and wide."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)


class Batches(struct.PyTreeNode):
    """Pictures to learn from, as bytes.

    Attributes:
        rgb: colours, shape [N, size, size, 3].
        labels: of the pixels, shape [N, size, size].
    """

    rgb: Array
    labels: Array


def loss(params, key: jax.Array, data: Batches, *, module: Segmenter, batch: int, crop: int) -> Float[Array, ""]:
    """Cross-entropy of the labels of random parts of random pictures, taken with a random camera's faults."""
    key_which, key_where, key_flip, key_taken = jax.random.split(key, 4)
    n, size = data.labels.shape[:2]
    which = jax.random.randint(key_which, (batch,), 0, n)
    corners = jax.random.randint(key_where, (batch, 2), 0, size - crop + 1)
    flipped = jax.random.bernoulli(key_flip, shape=(batch,))

    def one(picture, corner, flipped, key):
        (row, column), (key_shot, key_taken) = corner, jax.random.split(key)
        rgb = jax.lax.dynamic_slice(data.rgb, (picture, row, column, 0), (1, crop, crop, 3))[0]
        labels = jax.lax.dynamic_slice(data.labels, (picture, row, column), (1, crop, crop))[0]
        rgb, labels = (jnp.where(flipped, part[:, ::-1], part) for part in (rgb, labels))
        return photograph.taken(key_taken, photograph.draw(key_shot), rgb.astype(jnp.float32) / 255), labels

    rgb, labels = jax.vmap(one)(which, corners, flipped, jax.random.split(key_taken, batch))
    log_likelihood = jax.nn.log_softmax(module.apply(params, rgb))
    # By comparison: XLA takes seconds to fold the scatter of integer labels into constants.
    chosen = labels[..., None] == jnp.arange(len(LABELS), dtype=labels.dtype)
    return -jnp.mean(jnp.sum(jnp.where(chosen, log_likelihood, 0.0), axis=-1))


@functools.partial(jax.jit, static_argnums=0)
def segment(module: Segmenter, params, rgb) -> Int[Array, "height width"]:
    """Labels of one picture in bytes, shape [height, width, 3]."""
    logits = module.apply(params, rgb[None].astype(jnp.float32) / 255)[0]
    return jnp.argmax(logits, axis=-1).astype(jnp.int32)
