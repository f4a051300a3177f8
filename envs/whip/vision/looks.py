"""How scenes look: colours, patterns, lights, and what else is in the picture, all of it drawn at random.

A look is the same for every renderer: the ray caster (`shading`) and MuJoCo's (`gl`) draw it each in its own way.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.rig import RGBA

CLUTTER = 6
"""Maximum number of background objects."""
PATTERNS = ("plain", "chequered", "striped")
"""What tables and walls are covered with."""
WAVES = 6
"""Plane waves that grain and stains are made of."""
PALETTE = np.array([RGBA[name][:3] for name in (*COLOURS, "dlo")])
"""Colours of the labels 1 to 7, shape [7, 3]."""


class Surface(struct.PyTreeNode):
    """The pattern of a table or a wall.

    Attributes:
        colours: two, shape [2, 3].
        pattern: number in `PATTERNS`.
        period: of the pattern, in m.
        angle: of the pattern about the vertical, in rad.
        phase: of the pattern, in periods, shape [3].
    """

    colours: Float[Array, "2 3"]
    pattern: Int[Array, ""]
    period: Float[Array, ""]
    angle: Float[Array, ""]
    phase: Float[Array, "3"]


class Boxes(struct.PyTreeNode):
    """Boxes in a scene that have no label: background objects, and a hand.

    Attributes:
        centres: in m, shape [n, 3].
        orientations: unit quaternions, shape [n, 4].
        half_sizes: in m, shape [n, 3].
        colours: shape [n, 3].
        there: which of them are in the scene, shape [n].
    """

    centres: Float[Array, "n 3"]
    orientations: Float[Array, "n 4"]
    half_sizes: Float[Array, "n 3"]
    colours: Float[Array, "n 3"]
    there: Bool[Array, " n"]


class Look(struct.PyTreeNode):
    """How one scene looks; all colours are linear, from 0 to 1.

    Attributes:
        colours: of the cubes, bottom-up, and of the DLO, shape [7, 3].
        gripper: its colour, shape [3].
        table, wall: what they are covered with.
        wall_distance: from the plane of motion to the wall behind it, in m.
        clutter: background objects, and last a hand that hides a part of the DLO.
        lights: directions towards two lights, shape [2, 3].
        brightness: of the lights, shape [2].
        ambient: light from everywhere.
        tint: colour of the light, shape [3].
        waves: wave vectors of grain and stains, in rad/m, shape [`WAVES`, 3].
        phases: of these waves, shape [`WAVES`].
        grain: their strength on bodies, and on table and wall, shape [2].
        gloss: strength of highlights.
    """

    colours: Float[Array, "7 3"]
    gripper: Float[Array, "3"]
    table: Surface
    wall: Surface
    wall_distance: Float[Array, ""]
    clutter: Boxes
    lights: Float[Array, "2 3"]
    brightness: Float[Array, "2"]
    ambient: Float[Array, ""]
    tint: Float[Array, "3"]
    waves: Float[Array, "waves 3"]
    phases: Float[Array, " waves"]
    grain: Float[Array, "2"]
    gloss: Float[Array, ""]


def draw(key: jax.Array, frame: Frames) -> Look:
    """A look for a scene, whose frame says where a hand may hide a part of the DLO."""
    keys = iter(jax.random.split(key, 32))

    def uniform(low, high, shape=()):
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    directions = jnp.stack([uniform(-1.0, 1.0, (2,)), uniform(-1.2, -0.1, (2,)), uniform(0.2, 1.2, (2,))], axis=-1)
    frequency = 2 * jnp.pi * jnp.exp(uniform(np.log(3.0), np.log(200.0), (WAVES, 1)))
    heading = jax.random.normal(next(keys), (WAVES, 3))
    return Look(
        colours=_jittered(next(keys), jnp.asarray(PALETTE)),
        gripper=uniform(0.05, 0.9) * jnp.ones(3) + uniform(-0.05, 0.05, (3,)),
        table=_surface(next(keys)),
        wall=_surface(next(keys)),
        wall_distance=uniform(0.15, 1.5),
        clutter=_clutter(next(keys), frame),
        lights=directions / jnp.linalg.norm(directions, axis=-1, keepdims=True),
        brightness=uniform(0.1, 0.7, (2,)),
        ambient=uniform(0.25, 0.7),
        tint=uniform(0.88, 1.0, (3,)),
        waves=frequency * heading / jnp.linalg.norm(heading, axis=-1, keepdims=True),
        phases=uniform(0.0, 2 * jnp.pi, (WAVES,)),
        grain=uniform(0.0, 0.12, (2,)) * jnp.array([1.0, 2.0]),
        gloss=uniform(0.0, 0.5),
    )


def plain(frame: Frames) -> Look:
    """The colours as they are named, on a white table before a white wall, evenly lit."""
    white = Surface(jnp.ones((2, 3)), jnp.asarray(0), jnp.asarray(1.0), jnp.asarray(0.0), jnp.zeros(3))
    nothing = jax.tree.map(jnp.zeros_like, _clutter(jax.random.key(0), frame))
    upright = jnp.broadcast_to(jnp.eye(1, 4), (CLUTTER + 1, 4))
    return Look(
        colours=jnp.asarray(PALETTE, jnp.float32),
        gripper=jnp.asarray(RGBA["gripper"][:3]),
        table=white,
        wall=white,
        wall_distance=jnp.asarray(1.0),
        clutter=nothing.replace(orientations=upright, half_sizes=jnp.ones((CLUTTER + 1, 3))),
        lights=jnp.array([[0.0, -0.6, 0.8], [0.0, 0.0, 1.0]]),
        brightness=jnp.array([0.4, 0.0]),
        ambient=jnp.asarray(0.7),
        tint=jnp.ones(3),
        waves=jnp.zeros((WAVES, 3)),
        phases=jnp.zeros(WAVES),
        grain=jnp.zeros(2),
        gloss=jnp.asarray(0.0),
    )


def _jittered(key: jax.Array, colours: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The colours with small random changes of hue, saturation and value; they stay distinguishable."""
    key_hue, key_saturation, key_value = jax.random.split(key, 3)
    hue, saturation, value = jnp.moveaxis(_hsv(colours), -1, 0)
    n = hue.shape
    hue += jax.random.uniform(key_hue, n, minval=-0.02, maxval=0.02)
    saturation *= jax.random.uniform(key_saturation, n, minval=0.7, maxval=1.1)
    value *= jax.random.uniform(key_value, n, minval=0.75, maxval=1.1)
    return _rgb(hue % 1.0, jnp.clip(saturation, 0, 1), jnp.clip(value, 0, 1))


def _surface(key: jax.Array) -> Surface:
    keys = jax.random.split(key, 8)
    hue = jax.random.uniform(keys[0], (2,))
    saturation = jax.random.uniform(keys[1], (2,), maxval=0.6) * jax.random.bernoulli(keys[2], 0.6)
    value = jax.random.uniform(keys[3], (2,), minval=0.1)
    return Surface(
        colours=_rgb(hue, saturation, value),
        pattern=jax.random.randint(keys[4], (), 0, len(PATTERNS)),
        period=jnp.exp(jax.random.uniform(keys[5], minval=np.log(0.02), maxval=np.log(0.3))),
        angle=jax.random.uniform(keys[7], maxval=np.pi),
        phase=jax.random.uniform(keys[6], (3,), minval=0.1, maxval=0.9),
    )


def _clutter(key: jax.Array, frame: Frames) -> Boxes:
    """Background objects of low saturation, and last a hand between the camera and the DLO."""
    keys = jax.random.split(key, 15)
    n = CLUTTER
    half = jnp.exp(jax.random.uniform(keys[0], (n, 3), minval=np.log(0.008), maxval=np.log(0.07)))
    low, high = jnp.array([0.05, 0.09, 0.0]), jnp.array([0.95, 0.14, 0.45])
    centres = jax.random.uniform(keys[1], (n, 3), minval=low, maxval=high)
    on_table = jax.random.bernoulli(keys[2], 0.6, (n,))
    centres = centres.at[:, 2].set(jnp.where(on_table, half[:, 2], centres[:, 2]))
    turn = jax.random.uniform(keys[3], (n,), maxval=np.pi)
    colours = _rgb(
        jax.random.uniform(keys[4], (n,)),
        jax.random.uniform(keys[5], (n,), maxval=0.6),
        jax.random.uniform(keys[6], (n,), minval=0.05),
    )
    # A hand: long, skin or glove, across the DLO at any of its points but the last quarter, on the camera's side.
    at = jnp.asarray(frame.dlo, jnp.float32)[jax.random.randint(keys[7], (), 1, 3 * frame.dlo.shape[0] // 4)]
    tilt = jax.random.uniform(keys[8], maxval=np.pi)
    hand = jnp.array([0.012, 0.01, 0.06]) * jax.random.uniform(keys[9], (3,), minval=0.6, maxval=1.4)
    axis = jnp.array([jnp.cos(tilt / 2), 0.0, jnp.sin(tilt / 2), 0.0])
    skin = _rgb(
        jax.random.uniform(keys[10], minval=0.02, maxval=0.1),
        jax.random.uniform(keys[12], minval=0.1, maxval=0.6),
        jax.random.uniform(keys[11], minval=0.2, maxval=0.95),
    )
    there = jax.random.bernoulli(keys[13], 0.5, (n,))
    held = jax.random.bernoulli(keys[14], 0.12, (1,))
    upright = jnp.stack([jnp.cos(turn / 2), 0 * turn, 0 * turn, jnp.sin(turn / 2)], axis=-1)
    return Boxes(
        centres=jnp.concatenate([centres, (at + jnp.array([0.0, -0.03, 0.0]))[None]]),
        orientations=jnp.concatenate([upright, axis[None]]),
        half_sizes=jnp.concatenate([half, hand[None]]),
        colours=jnp.concatenate([colours, skin[None]]),
        there=jnp.concatenate([there, held]),
    )


def _rgb(hue: Float[Array, "*n"], saturation: Float[Array, "*n"], value: Float[Array, "*n"]) -> Float[Array, "*n 3"]:
    """Colours by hue, saturation and value, each from 0 to 1."""
    turned = (jnp.asarray(hue)[..., None] * 6 + jnp.array([5.0, 3.0, 1.0])) % 6
    less = jnp.clip(jnp.minimum(turned, 4 - turned), 0, 1)
    return jnp.asarray(value)[..., None] * (1 - jnp.asarray(saturation)[..., None] * less)


def _hsv(colours: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Hue, saturation and value of colours."""
    red, green, blue = jnp.moveaxis(colours, -1, 0)
    value, spread = colours.max(-1), jnp.maximum(colours.max(-1) - colours.min(-1), 1e-6)
    of_red, of_green, of_blue = (green - blue) / spread, 2 + (blue - red) / spread, 4 + (red - green) / spread
    hue = jnp.where(red >= value, of_red, jnp.where(green >= value, of_green, of_blue)) / 6
    return jnp.stack([hue % 1.0, spread / jnp.maximum(value, 1e-6), value], axis=-1)
