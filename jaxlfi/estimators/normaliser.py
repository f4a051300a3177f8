"""Normalisers: maps from raw summaries to a network's inputs, fitted to the simulations so far.

A posterior must not depend on the unit of a summary, nor on a constant added to it. So values are taken relative to a
reference among them before anything is summed, and no threshold is absolute.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.tasks.reference import RESOLVED

LINEAR = 4.0
"""Unit of asinh in median absolute deviations: a normal variable hardly changes, and tails become logarithmic."""
ROWS = 255
"""Largest number of simulations from which origin and unit are computed; mean and standard deviation use all.

The number is odd so that the median is one of the values, and only changes sign if the summary does.
"""


class Normaliser(struct.PyTreeNode):
    """A fixed elementwise transform between two changes of origin and unit.

    Attributes:
        mean: mean of the transformed summaries, shape [S].
        scale: their standard deviation, shape [S]; infinite for a summary that does not vary, which becomes 0.
        name: name of the transform (`TRANSFORMS`).
        origin: value subtracted from the summaries, in their own unit, shape [S].
        unit: positive number by which they are then divided, shape [S].
    """

    mean: Float[Array, "*batch obs"]
    scale: Float[Array, "*batch obs"]
    name: str = struct.field(pytree_node=False)
    origin: Float[Array, "*batch obs"]
    unit: Float[Array, "*batch obs"]

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n obs"]:
        """Normalised summaries, from raw ones."""
        return (TRANSFORMS[self.name]((x - self.origin) / self.unit) - self.mean) / self.scale


def untouched(x: Array) -> Array:
    """Summaries as they are."""
    return x


TRANSFORMS: dict[str, Callable[[Array], Array]] = {"none": untouched, "zscore": untouched, "asinh": jnp.arcsinh}
"""Transform of each summary between the two changes of origin and unit, by the normaliser's name.

"asinh" is linear about a summary's median and logarithmic many median absolute deviations away: summaries of
stochastic simulators (a mean population, say) can span many orders of magnitude, and then a plain z-score squeezes
everything like the observation into one point. A smaller unit, such as a logarithm about the median, fits the tails of
such summaries better, but amplifies the noise of ordinary ones. "none" leaves the unit to the simulator.
"""


def fit_normaliser(
    name: str, x: Float[Array, "cap obs"], valid: Bool[Array, " cap"], record_size: int = 0
) -> Normaliser:
    """Origin, unit, mean and standard deviation of each summary over the valid rows; the identity for "none".

    Args:
        name: name of the transform.
        x: raw summaries, shape [C, S].
        valid: true for the rows that are used, shape [C].
        record_size: length of the records of a summary, all of them normalised alike: a series is scaled by channel,
            not by time, and trials stay exchangeable. 0: no records.
    """
    size = x.shape[-1]
    if 0 < record_size < size:
        count = size // record_size
        one = fit_normaliser(name, x.reshape(-1, record_size), jnp.repeat(valid, count))
        return jax.tree.map(lambda leaf: jnp.tile(leaf, count), one)
    if name == "none":
        return identity(size)
    x = jnp.where(valid[:, None], x, x[jnp.argmax(valid)])
    some = some_rows(x, valid)
    origin, unit = middle(some)
    unit = jnp.where(unit > 0, LINEAR * unit, jnp.ptp(x, axis=0))
    unit = jnp.where(varies(x), unit, 1.0)
    mean, deviation = _moments(TRANSFORMS[name]((x - origin) / unit), valid)
    fitted = Normaliser(mean, jnp.where(varies(x), deviation, jnp.inf), name, origin, unit)
    return jax.tree.map(lambda known, nothing: jnp.where(jnp.any(valid), known, nothing), fitted, identity(size, name))


def identity(size: int, name: str = "none") -> Normaliser:
    """The normaliser that neither shifts nor scales its S summaries."""
    zeros, ones = jnp.zeros(size), jnp.ones(size)
    return Normaliser(zeros, ones, name, zeros, ones)


def standardiser(values: Float[Array, "cap dim"], valid: Bool[Array, " cap"]) -> Normaliser:
    """Mean and standard deviation of values of order one, such as parameters in [-1, 1]^D; 1 where they do not vary."""
    mean, deviation = _moments(values, valid)
    return identity(values.shape[-1], "zscore").replace(mean=mean, scale=jnp.where(deviation > 1e-6, deviation, 1.0))


def varies(x: Float[Array, "n obs"]) -> Bool[Array, " obs"]:
    """Which summaries vary by more than the rounding of their values; the others contain no information."""
    last_place = jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x), axis=0)
    return jnp.ptp(x, axis=0) > RESOLVED * last_place


def some_rows(x: Float[Array, "cap obs"], valid: Bool[Array, " cap"]) -> Float[Array, "rows obs"]:
    """At most `ROWS` of the valid rows, an odd number, spread evenly whatever their period is (by the golden ratio)."""
    count = min(ROWS, len(x) - 1 + len(x) % 2)
    places = np.modf(np.arange(count) * (np.sqrt(5) - 1) / 2)[0].astype(np.float32)
    (rows,) = jnp.nonzero(valid, size=len(x), fill_value=0)
    return x[rows[(places * jnp.sum(valid)).astype(jnp.int32)]]


def middle(x: Float[Array, "n obs"]) -> tuple[Float[Array, " obs"], Float[Array, " obs"]]:
    """Median and median absolute deviation of each summary, shape [S] each.

    A deviation of zero is replaced by the mean absolute deviation: most counts of rare events are equal.
    """
    median = _quantile(x, 0.5)
    away = jnp.abs(x - median)
    deviation = _quantile(away, 0.5)
    return median, jnp.where(deviation > 0, deviation, jnp.mean(away, axis=0))


def _quantile(x: Float[Array, "n obs"], place: float) -> Float[Array, " obs"]:
    """A quantile of each column that is one of its values, so that differences from it have no rounding error."""
    return jnp.quantile(x, place, axis=0, method="lower")


def _moments(values: Float[Array, "n obs"], valid: Bool[Array, " n"]) -> tuple[Array, Array]:
    """Mean and standard deviation of each column over the valid rows."""
    count = jnp.maximum(jnp.sum(valid), 1)
    mean = jnp.sum(values, axis=0, where=valid[:, None]) / count
    return mean, jnp.sqrt(jnp.sum((values - mean) ** 2, axis=0, where=valid[:, None]) / count)
