"""Support: the box Theta = [theta_min, theta_max] from which the parameters are drawn."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

if TYPE_CHECKING:
    AnyArray = Array
else:
    AnyArray = Array | np.ndarray
"""An array of JAX or NumPy. Type checkers take it for one of JAX: only what both offer is used."""


class Support(struct.PyTreeNode):
    """An axis-aligned box of parameters, Theta in the paper.

    Bounds given as Python sequences are checked at once (equal lengths, finite, low < high). Arrays, JAX's or NumPy's,
    may be traced, batched or anything else a pytree's leaves become, so they are taken as they are and checked when a
    run starts (`check_within`).

    Attributes:
        low: lower bounds theta_min, shape [D]. In natural units when a user writes them, in inference space inside the
            library.
        high: upper bounds theta_max, shape [D].

    Raises:
        ValueError: for bounds of unequal lengths, not finite, or reversed.

    Example:
        >>> box = Support([1.0, 0.1], [10.0, 1.0])
        >>> box.width.tolist()
        [9.0, 0.8999999761581421]
    """

    low: Float[AnyArray, "*batch dim"]
    high: Float[AnyArray, "*batch dim"]

    if TYPE_CHECKING:  # its constructor accepts more types than its fields have

        def __init__(self, low: ArrayLike | Sequence[float], high: ArrayLike | Sequence[float]) -> None: ...

    def __post_init__(self):
        if isinstance(self.low, list | tuple) or isinstance(self.high, list | tuple):
            low, high = _checked_bounds(self.low, self.high)
            object.__setattr__(self, "low", jnp.asarray(low))
            object.__setattr__(self, "high", jnp.asarray(high))
        for name in ("low", "high"):
            if isinstance(bound := getattr(self, name), np.ndarray):  # the caller may change it later
                object.__setattr__(self, name, bound.copy())

    @property
    def width(self) -> Float[AnyArray, "*batch dim"]:
        """theta_max - theta_min, the range size r of Algorithms 2-4."""
        return self.high - self.low

    @property
    def centre(self) -> Float[AnyArray, "*batch dim"]:
        """The middle of the box."""
        return 0.5 * (self.low + self.high)

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return self.low.shape[-1]

    def contains(self, theta: Float[Array | np.ndarray, "*n dim"]) -> Bool[Array, "*n"]:
        """Whether each parameter vector lies in the box, bounds included."""
        return jnp.all((theta >= self.low) & (theta <= self.high), axis=-1)

    def clip(self, theta: Float[Array | np.ndarray, "*n dim"]) -> Float[Array, "*n dim"]:
        """The nearest point of the box, dimension by dimension."""
        return jnp.clip(theta, self.low, self.high)

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws of the uniform distribution over the box."""
        unit = jax.random.uniform(key, (n, self.dim))
        return self.low + unit * self.width

    def hull(self, other: "Support") -> "Support":
        """The smallest box around both."""
        return Support(jnp.minimum(self.low, other.low), jnp.maximum(self.high, other.high))

    def to_unit(self, theta: Float[AnyArray, "*n dim"]) -> Float[Array, "*n dim"]:
        """Scale the box to [-1, 1]^D."""
        return (theta - self.centre) / (0.5 * self.width)


def _checked_bounds(low, high) -> tuple[np.ndarray, np.ndarray]:
    """Plain bounds as float32 vectors, or a ValueError that says what is wrong with them."""
    try:
        low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"support: expected bounds that are numbers, got low={low!r}, high={high!r}") from error
    if low.ndim != 1 or low.shape != high.shape or low.size == 0:
        raise ValueError(
            f"support: expected two vectors of the same length, got low of shape {low.shape} "
            f"and high of shape {high.shape}"
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"support: expected finite bounds, got low={low.tolist()}, high={high.tolist()}")
    if not (low < high).all():
        where = np.flatnonzero(~(low < high)).tolist()
        raise ValueError(
            f"support: expected low < high in every dimension, got low={low.tolist()}, "
            f"high={high.tolist()} (reversed or empty in dimension {where})"
        )
    return low, high


def check_within(support: Support, feasible: Support, name: str = "support") -> Support:
    """Check concrete bounds against the feasible domain Phi.

    Args:
        support: the box to check, bounds [D].
        feasible: Phi.
        name: name of the box in an error.

    Returns:
        `support`, unchanged.

    Raises:
        ValueError: if the box is reversed, not finite, of another dimension than Phi or not inside it.
    """
    low, high = _checked_bounds(np.asarray(support.low), np.asarray(support.high))
    if low.shape != feasible.low.shape:
        raise ValueError(f"{name}: expected bounds for {feasible.dim} parameters, got {low.size}")
    # Compared in one precision, or a rounded bound could lie outside itself.
    limits = np.asarray(feasible.low, low.dtype), np.asarray(feasible.high, high.dtype)
    outside = np.flatnonzero((low < limits[0]) | (high > limits[1]))
    if outside.size:
        d = int(outside[0])
        raise ValueError(
            f"{name}: expected a box inside the feasible domain Phi; in dimension {d} it is "
            f"[{low[d]:g}, {high[d]:g}] but Phi allows [{float(feasible.low[d]):g}, {float(feasible.high[d]):g}]"
        )
    return support
