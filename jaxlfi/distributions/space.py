"""Conversion between natural units and inference space."""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support

SpaceName = Literal["natural", "inference"]
"""Units of an argument or a result: the parameters' own, or those of inference space."""


@dataclasses.dataclass(frozen=True)
class Space:
    """Names of the parameters, and which of them are inferred as natural logarithms.

    Everything a user passes in or gets back is in natural units unless requested otherwise. Networks, mixtures and
    heuristics work in *inference space*: the logarithm of the parameters in `log`, the parameter itself otherwise.

    Attributes:
        names: names of the D parameters.
        log: for each parameter, whether it is inferred as its logarithm.

    Raises:
        ValueError: for anything else.

    Example:
        >>> space = Space(("length", "young"), (False, True))
        >>> space.labels
        ('length', 'ln young')
        >>> [round(float(value), 3) for value in space.to_natural(jnp.array([2.0, 0.0]))]
        [2.0, 1.0]
    """

    names: tuple[str, ...]
    log: tuple[bool, ...]

    def __post_init__(self):
        if not isinstance(self.names, tuple) or not all(isinstance(name, str) for name in self.names):
            raise ValueError(f"names: expected a tuple of texts, got {self.names!r}")
        if not isinstance(self.log, tuple) or [type(one) for one in self.log] != [bool] * len(self.names):
            raise ValueError(f"log: expected True or False for each of {list(self.names)}, got {self.log!r}")

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return len(self.names)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes of inference space: "ln name" for the parameters inferred as logarithms."""
        return tuple(f"ln {name}" if log else name for name, log in zip(self.names, self.log, strict=True))

    def to_natural(self, theta: Float[Array | np.ndarray, "*n dim"]) -> Float[Array, "*n dim"]:
        """From inference space to natural units, shape [..., D]."""
        if not any(self.log):
            return jnp.asarray(theta)
        log = np.asarray(self.log)
        return jnp.where(log, jnp.exp(jnp.where(log, theta, 0.0)), theta)

    def to_inference(self, theta: Float[Array | np.ndarray, "*n dim"]) -> Float[Array, "*n dim"]:
        """From natural units to inference space, shape [..., D]; not finite where a logarithm is not."""
        if not any(self.log):
            return jnp.asarray(theta)
        log = np.asarray(self.log)
        return jnp.where(log, jnp.log(jnp.where(log, theta, 1.0)), theta)

    def box_to_inference(self, box: Support) -> Support:
        """A box in natural units as the same box in inference space."""
        return Support(self.to_inference(box.low), self.to_inference(box.high))

    def box_to_natural(self, box: Support) -> Support:
        """A box in inference space as the same box in natural units."""
        return Support(self.to_natural(box.low), self.to_natural(box.high))

    def log_jacobian(self, theta: Float[Array | np.ndarray, "*n dim"]) -> Float[Array, "*n"]:
        """Logarithm of the volume that a unit of inference space has in natural units, at a point of inference space.

        A log-density over natural units is that over inference space minus this.
        """
        return jnp.sum(jnp.where(np.asarray(self.log), theta, 0.0), axis=-1)


def is_natural(space: SpaceName) -> bool:
    """Whether natural units were requested.

    Raises:
        ValueError: for another name than "natural" or "inference".
    """
    if not isinstance(space, str) or space not in ("natural", "inference"):
        raise ValueError(f"space: expected 'natural' or 'inference', got {space!r}")
    return space == "natural"
