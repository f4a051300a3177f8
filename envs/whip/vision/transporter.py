"""Keypoints learnt without labels: what has to move for one mask of the DLO to become another (section VI-C).

The transporter (Kulkarni et al., 2019) sees two frames of one rollout. From the features of the first, those around the
keypoints of either frame are cut out, and those of the second are put in around its own keypoints. From the result, the
second frame is to be painted: so the keypoints have to be where the frames differ, and at the same parts of the DLO in
both.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.envs.whip.vision.keypoints import ON_DLO
from jaxlfi.envs.whip.vision.segmenter import pixels

SIZE = 64
"""Side of the masks, in pixels."""
GRID = 16
"""Side of the features, of which each is of 4 x 4 pixels."""
SPREAD = 0.08
"""Standard deviation of the Gaussians around keypoints, in widths of the image."""


class Encoder(nn.Module):
    """From masks to features.

    Attributes:
        width: channels of the features.
    """

    width: int

    @nn.compact
    def __call__(self, masks: Float[Array, "batch 64 64 channels"]) -> Float[Array, "batch 16 16 width"]:
        """Features of each mask."""
        x = masks
        for width, stride in ((self.width // 2, 2), (self.width // 2, 1), (self.width, 2), (self.width, 1)):
            x = nn.relu(_normalised(nn.Conv(width, (3, 3), strides=stride)(x)))
        return x


class Decoder(nn.Module):
    """From features to masks.

    Attributes:
        width: channels of the features.
        channels: of the masks.
    """

    width: int
    channels: int

    @nn.compact
    def __call__(self, features: Float[Array, "batch 16 16 width"]) -> Float[Array, "batch 64 64 channels"]:
        """The mask that the features say."""
        x = features
        for _ in range(2):
            x = nn.relu(_normalised(nn.Conv(self.width, (3, 3))(x)))
        side = SIZE // GRID
        return pixels(nn.Conv(self.channels * side**2, (3, 3))(x), side)


class Transporter(nn.Module):
    """Features, keypoints and painting.

    Attributes:
        width: channels of the features.
        channels: of what is seen: 1 for masks, 3 for colours.
        keypoints: their number.
    """

    width: int = 64
    channels: int = 1
    keypoints: int = ON_DLO

    def setup(self):
        """The networks."""
        self.appearance, self.placement = Encoder(self.width), Encoder(self.width)
        self.maps = nn.Conv(self.keypoints, (1, 1))
        self.painter = Decoder(self.width, self.channels)

    def __call__(self, first, second) -> Float[Array, "batch 64 64 channels"]:
        """The second image of each pair, painted from the first one's features."""
        # Only what is seen of the second image is learnt from: else the first would be changed to suit it.
        features, there = jax.lax.stop_gradient((self.appearance(first), around(self.places(first))))
        others, here = self.appearance(second), around(self.places(second))
        for k in range(self.keypoints):
            cut, put = there[..., k : k + 1], here[..., k : k + 1]
            features = (1 - cut) * (1 - put) * features + put * others
        return self.painter(features)

    def places(self, masks: Float[Array, "batch 64 64 channels"]) -> Float[Array, "batch keypoints 2"]:
        """Keypoints, in normalised pixels."""
        return means(self.maps(self.placement(masks)))


def means(heat: Float[Array, "batch 16 16 keypoints"]) -> Float[Array, "batch keypoints 2"]:
    """Means of the distributions whose logits are heat maps, in normalised pixels."""
    weight = jax.nn.softmax(heat.reshape(len(heat), -1, heat.shape[-1]), axis=1)
    return jnp.einsum("bpk,pd->bkd", weight, _grid().reshape(-1, 2), precision="highest")


def around(places: Float[Array, "batch keypoints 2"]) -> Float[Array, "batch 16 16 keypoints"]:
    """Gaussians around keypoints, 1 at their middle."""
    away = jnp.sum((_grid()[None, :, :, None] - places[:, None, None]) ** 2, axis=-1)
    return jnp.exp(-0.5 * away / SPREAD**2)


def _grid() -> Float[Array, "16 16 2"]:
    """Places (u, v) of features, in normalised pixels."""
    axis = (jnp.arange(GRID) + 0.5) / GRID
    return jnp.stack(jnp.meshgrid(axis, axis), axis=-1)


def _normalised(x: Array) -> Array:
    return nn.GroupNorm(num_groups=8)(x)


class Pairs(struct.PyTreeNode):
    """Rollouts to learn from, as bytes.

    Attributes:
        masks: of N rollouts of T frames each, shape [N, T, 64, 64, channels].
    """

    masks: Array


def loss(params, key: jax.Array, data: Pairs, *, module: Transporter, batch: int) -> Float[Array, ""]:
    """Squared error of painted frames, of random pairs of frames of random rollouts."""
    key_rollout, key_frames = jax.random.split(key)
    rollout = jax.random.randint(key_rollout, (batch, 1), 0, data.masks.shape[0])
    frames = jax.random.randint(key_frames, (batch, 2), 0, data.masks.shape[1])
    pairs = data.masks[rollout, frames].astype(jnp.float32) / 255
    painted = module.apply(params, pairs[:, 0], pairs[:, 1])
    return jnp.mean((painted - pairs[:, 1]) ** 2)


@functools.partial(jax.jit, static_argnums=0)
def places(module: Transporter, params, masks) -> Float[Array, "batch keypoints 2"]:
    """Keypoints of masks in bytes, shape [batch, 64, 64, channels], in normalised pixels."""
    return module.apply(params, masks.astype(jnp.float32) / 255, method=Transporter.places)


def ordered(params, order):
    """The same network with its keypoints in another order: the k-th is the one that was `order[k]`."""
    maps = params["params"]["maps"]
    maps = {"kernel": maps["kernel"][..., order], "bias": maps["bias"][order]}
    return {"params": {**params["params"], "maps": maps}}
