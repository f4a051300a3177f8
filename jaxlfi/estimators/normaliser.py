"""Normalisers: raw summaries as a network sees them, from the simulations at hand."""

from collections.abc import Callable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float


@struct.dataclass
class Normaliser:
    """A fixed elementwise transform, then centre and scale of each summary.

    Attributes:
        mean: of the transformed summaries, shape [S].
        scale: shape [S], positive.
        name: of the transform (`TRANSFORMS`).
    """

    mean: Float[Array, "*batch obs"]
    scale: Float[Array, "*batch obs"]
    name: str = struct.field(pytree_node=False)

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n obs"]:
        """Raw summaries as a network sees them."""
        return (TRANSFORMS[self.name](x) - self.mean) / self.scale


def untouched(x: Array) -> Array:
    """Summaries as they are."""
    return x


TRANSFORMS: dict[str, Callable[[Array], Array]] = {"none": untouched, "zscore": untouched, "asinh": jnp.arcsinh}
"""What is done to each summary before it is centred and scaled, by the normaliser's name.

"asinh" is linear near zero and logarithmic in the tails: summaries of stochastic simulators (a mean population, say)
can span many orders of magnitude, and then a plain z-score squeezes everything like the observation into one point.
"""


def fit_normaliser(
    name: str, x: Float[Array, "cap obs"], valid: Bool[Array, " cap"], record_size: int = 0
) -> Normaliser:
    """Mean and standard deviation of each transformed summary over the valid rows; (0, 1) for "none".

    A summary that does not vary is centred only.

    Args:
        name: of the transform.
        x: raw summaries, shape [C, S].
        valid: the rows that count, shape [C].
        record_size: where it is not 0, summaries are records of so many numbers, all of them normalised alike: a
            series is scaled by channel, not by time, and trials can be exchanged.
    """
    size = x.shape[-1]
    if 0 < record_size < size:
        count = size // record_size
        one = fit_normaliser(name, x.reshape(-1, record_size), jnp.repeat(valid, count))
        return one.replace(mean=jnp.tile(one.mean, count), scale=jnp.tile(one.scale, count))
    if name == "none":
        return Normaliser(jnp.zeros(size), jnp.ones(size), name)
    values = TRANSFORMS[name](x)
    count = jnp.maximum(jnp.sum(valid), 1)
    mean = jnp.sum(values, axis=0, where=valid[:, None]) / count
    variance = jnp.sum((values - mean) ** 2, axis=0, where=valid[:, None]) / count
    scale = jnp.sqrt(variance)
    return Normaliser(mean, jnp.where(scale > 1e-6 * (1 + jnp.abs(mean)), scale, 1.0), name)
