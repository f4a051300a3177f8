"""Normalisers: raw summaries as a network sees them, from the simulations at hand."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

UNITS = np.logspace(-3, 2, 11).astype(np.float32)
"""Units of asinh that are tried, relative to the median of a summary's absolute values."""


@struct.dataclass
class Normaliser:
    """A fixed elementwise transform, then centre and scale of each summary.

    Attributes:
        mean: of the transformed summaries, shape [S].
        scale: shape [S], positive.
        name: of the transform (`TRANSFORMS`).
        unit: what summaries are divided by before they are transformed, shape [S]; None for 1.
    """

    mean: Float[Array, "*batch obs"]
    scale: Float[Array, "*batch obs"]
    name: str = struct.field(pytree_node=False)
    unit: Float[Array, "*batch obs"] | None = None

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n obs"]:
        """Raw summaries as a network sees them."""
        x = x if self.unit is None else x / self.unit
        return (TRANSFORMS[self.name](x) - self.mean) / self.scale


def untouched(x: Array) -> Array:
    """Summaries as they are."""
    return x


TRANSFORMS: dict[str, Callable[[Array], Array]] = {
    "none": untouched,
    "zscore": untouched,
    "asinh": jnp.arcsinh,
    "fitted-asinh": jnp.arcsinh,
}
"""What is done to each summary before it is centred and scaled, by the normaliser's name.

"asinh" is linear near zero and logarithmic in the tails: summaries of stochastic simulators (a mean population, say)
can span many orders of magnitude, and then a plain z-score squeezes everything like the observation into one point.
What is near zero depends on the units that a summary comes in; "fitted-asinh" finds a unit for each (`likeliest_unit`),
and leaves as it is, but for centre and scale, what has no tails.
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
        return jax.tree.map(lambda leaf: jnp.tile(leaf, count), one)
    if name == "none":
        return Normaliser(jnp.zeros(size), jnp.ones(size), name)
    unit = likeliest_unit(x, valid) if name == "fitted-asinh" else None
    values = TRANSFORMS[name](x if unit is None else x / unit)
    mean, variance = _moments(values, valid)
    scale = jnp.sqrt(variance)
    return Normaliser(mean, jnp.where(scale > 1e-6 * (1 + jnp.abs(mean)), scale, 1.0), name, unit)


def likeliest_unit(x: Float[Array, "cap obs"], valid: Bool[Array, " cap"]) -> Float[Array, " obs"]:
    """The unit s for each summary by which asinh(x / s) is most like a normal variable.

    Of `UNITS` the one of maximum likelihood (Burbidge, Magee and Robb 1988): for a summary of many orders of magnitude
    it is small, and asinh nearly a logarithm; for one without tails it is large, and asinh nearly linear.
    """
    x = jnp.where(valid[:, None], x, 0.0)
    middle = jnp.nan_to_num(jnp.nanmedian(jnp.where(valid[:, None], jnp.abs(x), jnp.nan), axis=0))
    units = jnp.where(middle > 0, middle, 1.0) * UNITS[:, None]

    def log_likelihood(unit):
        _, variance = _moments(jnp.arcsinh(x / unit), valid)
        # d asinh(x / s) / dx = 1 / sqrt(s^2 + x^2)
        log_slope, _ = _moments(-jnp.log(jnp.hypot(unit, x)), valid)
        return log_slope - 0.5 * jnp.log(jnp.maximum(variance, 1e-12))

    best = jnp.argmax(jax.vmap(log_likelihood)(units), axis=0)
    return jnp.take_along_axis(units, best[None], axis=0)[0]


def _moments(values: Float[Array, "cap obs"], valid: Bool[Array, " cap"]) -> tuple[Array, Array]:
    """Mean and variance of each column over the valid rows."""
    count = jnp.maximum(jnp.sum(valid), 1)
    mean = jnp.sum(values, axis=0, where=valid[:, None]) / count
    return mean, jnp.sum((values - mean) ** 2, axis=0, where=valid[:, None]) / count
