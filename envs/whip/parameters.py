"""The parameters of the whipping scene: those that are inferred, and nuisances that are only randomised."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support


class WhipParameters(struct.PyTreeNode):
    """One whipping scene, in SI units; leaves may carry leading axes, one scene per entry (section VI-B).

    Attributes:
        length: length l of the DLO, in m.
        young: its Young's modulus E, in Pa.
        density: its density, in kg/m^3.
        poisson: its Poisson's ratio, which has no effect on a planar inextensible beam.
        cube_side: side of the cubes, in m.
        cube_density: their density, in kg/m^3.
        stack: displacement of the stack of cubes from its nominal position, x and y, in m.
        camera: displacement of the camera from its nominal position, x, y and z, in m.
    """

    length: Float[Array, "*batch"]
    young: Float[Array, "*batch"]
    density: Float[Array, "*batch"]
    poisson: Float[Array, "*batch"]
    cube_side: Float[Array, "*batch"]
    cube_density: Float[Array, "*batch"]
    stack: Float[Array, "*batch 2"]
    camera: Float[Array, "*batch 3"]


INITIAL = Support([0.195, 1e3], [0.305, 5e4])
"""Theta_0 of (length, young)."""

FEASIBLE = Support([0.050, 0.5e3], [0.350, 5e5])
"""Phi of (length, young)."""

MILLIMETRES = np.array([1000.0, 1.0])
"""Factors from (length, young) in m and Pa to the units they are inferred in, mm and Pa."""

MEDIAN = WhipParameters(
    length=0.250,
    young=2.5e4,
    density=75.0,
    poisson=0.35,
    cube_side=0.025,
    cube_density=100.0,
    stack=(0.0, 0.0),
    camera=(0.0, 0.0, 0.0),
)
"""mu, which the paper calls the median of Theta_0, with no displacements."""

LOWEST = WhipParameters(0.050, 0.5e3, 50.0, 0.3, 0.020, 80.0, (-0.02, -0.005), (-0.025, -0.025, -0.025))
"""Lower bounds: of length and young by Phi, of the nuisances by sections VI-B and VI-H."""

HIGHEST = WhipParameters(0.350, 5e5, 100.0, 0.5, 0.030, 120.0, (0.02, 0.005), (0.025, 0.025, 0.025))
"""Upper bounds, likewise."""


def in_task_units(box: Support) -> Support:
    """A box of (length, young) in mm and Pa, the units they are inferred in."""
    return Support(np.asarray(box.low) * MILLIMETRES, np.asarray(box.high) * MILLIMETRES)


def median(length: Float[Array, "*batch"] | float = MEDIAN.length, young=MEDIAN.young) -> WhipParameters:
    """Scenes of the given length (m) and Young's modulus (Pa), all else as in mu."""
    length, young = jnp.broadcast_arrays(jnp.asarray(length, jnp.float32), jnp.asarray(young, jnp.float32))
    broadcast = lambda value: jnp.broadcast_to(jnp.asarray(value, jnp.float32), (*length.shape, *np.shape(value)))
    rest = {name: broadcast(getattr(MEDIAN, name)) for name in NUISANCES}
    return WhipParameters(length=length, young=young, **rest)


def randomised(key: jax.Array, length: Float[Array, ""], young: Float[Array, ""]) -> WhipParameters:
    """One scene with every nuisance drawn uniformly from its range."""
    keys = jax.random.split(key, len(NUISANCES))
    drawn = {
        name: jax.random.uniform(
            keys[i],
            np.shape(getattr(LOWEST, name)),
            minval=jnp.asarray(getattr(LOWEST, name)),
            maxval=jnp.asarray(getattr(HIGHEST, name)),
        )
        for i, name in enumerate(NUISANCES)
    }
    return WhipParameters(length=jnp.asarray(length, jnp.float32), young=jnp.asarray(young, jnp.float32), **drawn)


NUISANCES = ("density", "poisson", "cube_side", "cube_density", "stack", "camera")
"""Names of the parameters that are not inferred."""


def check(parameters: WhipParameters) -> WhipParameters:
    """Refuse parameters outside of their ranges.

    Raises:
        ValueError: which names the parameter, its range and its value.
    """
    for name in ("length", "young", *NUISANCES):
        value = jnp.asarray(getattr(parameters, name))
        low, high = jnp.asarray(getattr(LOWEST, name)), jnp.asarray(getattr(HIGHEST, name))
        slack = 1e-6 * (high - low)
        if value.shape[value.ndim - low.ndim :] != low.shape:
            raise ValueError(f"{name}: expected shape [..., {', '.join(map(str, low.shape))}], got {value.shape}")
        if not bool(jnp.all((value >= low - slack) & (value <= high + slack))):  # also false for NaN
            raise ValueError(f"{name}: expected numbers between {low!s} and {high!s}, got {value!s}")
    return parameters
