"""What a camera does to a picture: motion and defocus, exposure and colour, noise, and pixels that are stuck."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

TAPS = 7
"""Pixels along each axis that blur mixes, and that motion spreads over."""


class Shot(struct.PyTreeNode):
    """The camera settings of one picture.

    Attributes:
        defocus: standard deviation of the blur, in pixels.
        motion: of everything while the shutter is open, to the right and down, in pixels, shape [2].
        gain: of the red, green and blue channels, shape [3].
        gamma: exponent of the response.
        offset: added to all channels: light that strays into the lens, or black that is cut.
        noise: standard deviation of each channel of each pixel where it is black, and where it is white, shape [2].
        stuck: fraction of pixels that are black or white in each channel.
    """

    defocus: Float[Array, ""]
    motion: Float[Array, "2"]
    gain: Float[Array, "3"]
    gamma: Float[Array, ""]
    offset: Float[Array, ""]
    noise: Float[Array, "2"]
    stuck: Float[Array, ""]


def draw(key: jax.Array) -> Shot:
    """A shot drawn at random."""
    keys = jax.random.split(key, 10)
    exposure = jnp.exp(jax.random.uniform(keys[2], minval=-0.35, maxval=0.3))
    return Shot(
        defocus=jax.random.uniform(keys[0], maxval=1.0),
        motion=jax.random.uniform(keys[1], (2,), minval=-2.0, maxval=2.0) * jax.random.bernoulli(keys[3], 0.3),
        gain=exposure * jnp.exp(0.06 * jax.random.normal(keys[4], (3,))),
        gamma=jnp.exp(jax.random.uniform(keys[5], minval=-0.25, maxval=0.25)),
        offset=jax.random.uniform(keys[6], minval=-0.05, maxval=0.05),
        noise=jax.random.uniform(keys[7], (2,), maxval=0.04),
        stuck=jax.random.uniform(keys[8], maxval=0.01) * jax.random.bernoulli(keys[9], 0.5),
    )


def taken(key: jax.Array, shot: Shot, picture: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
    """A picture as it was taken; colours from 0 to 1, also afterwards. vmap for many."""
    key_noise, key_stuck, key_value = jax.random.split(key, 3)
    sharp = jnp.maximum(shot.defocus, 1e-3)
    reach = TAPS // 2
    for axis in range(2):
        weights = [jnp.exp(-0.5 * (tap / sharp) ** 2) for tap in range(-reach, reach + 1)]
        picture = _mixed(picture, weights, lambda tap, axis=axis: (tap, 0) if axis == 0 else (0, tap))
    picture = _streaked(picture, shot.motion)
    picture = jnp.clip(picture * shot.gain + shot.offset, 0.0, 1.0) ** shot.gamma
    spread = shot.noise[0] * (1 - picture) + shot.noise[1] * picture
    picture = picture + spread * jax.random.normal(key_noise, picture.shape)
    stuck = jax.random.bernoulli(key_stuck, shot.stuck, picture.shape)
    picture = jnp.where(stuck, jax.random.bernoulli(key_value, 0.5, picture.shape), picture)
    return jnp.clip(picture, 0.0, 1.0)


def _mixed(picture, weights, place):
    """The weighted mean of the picture moved by whole pixels; beyond its edge it goes on as at the edge."""
    reach = TAPS // 2
    height, width = picture.shape[:2]
    padded = jnp.pad(picture, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    total = 0.0
    for tap, weight in zip(range(-reach, reach + 1), weights, strict=True):
        down, right = place(tap)
        total += weight * padded[reach + down : reach + down + height, reach + right : reach + right + width]
    return total / sum(weights)


def _streaked(picture, motion):
    """The mean of the picture at four moments, moved by fractions of pixels along each axis by interpolation."""
    moved = 0.0
    for moment in (-0.375, -0.125, 0.125, 0.375):
        part = picture
        for axis in range(2):
            shift = motion[1 - axis] * moment
            whole = jnp.clip(jnp.abs(shift), 0.0, 1.0)
            forward = jnp.concatenate([jnp.take(part, jnp.arange(1), axis), _without(part, axis, last=True)], axis)
            backward = jnp.concatenate([_without(part, axis, last=False), jnp.take(part, jnp.array([-1]), axis)], axis)
            part = (1 - whole) * part + whole * jnp.where(shift > 0, forward, backward)
        moved = moved + part / 4
    return moved


def _without(picture, axis, last):
    """The picture without its last or first row or column."""
    n = picture.shape[axis]
    return jax.lax.slice_in_dim(picture, 0 if last else 1, n - 1 if last else n, axis=axis)
