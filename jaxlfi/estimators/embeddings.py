"""Embeddings: a few features of a long summary, learnt together with the density that is conditioned on them.

An embedding sees a summary as records: the rows [T, C] of a series, or n trials of S numbers each. Windows and records
are rows of matrix products. Flax's `nn.Conv` under the `vmap` over an ensemble is a grouped convolution, whose gradient
is slow on CPU.
"""

import dataclasses
import math
from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.estimators.mdn import Dense

UNITS = 64
"""Units of the hidden layers of a multilayer perceptron."""
CHANNELS = 32
"""Channels between the convolutions of a series."""
STRIDE = 3
"""Stride of each convolution, in records; its windows are twice as long."""
PLACES = 8
"""Largest number of records after the convolutions of a series."""


class Perceptron(nn.Module):
    """Features of all records together, by a multilayer perceptron of two layers.

    Attributes:
        features: F.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch records size"]) -> Float[Array, "*batch features"]:
        """Features within [-1, 1]."""
        x = x.reshape(*x.shape[:-2], -1)
        return nn.tanh(Dense(self.features)(nn.relu(Dense(UNITS)(x))))


class Series(nn.Module):
    """Features of a series, by strided convolutions over time until no more than `PLACES` records are left.

    A pattern is recognised wherever it lies, as the same kernels see every part of the series; the last layer knows
    roughly where. (The mean and the maximum over time alone do not show how fast a vibration decays.)

    Attributes:
        features: F.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch records size"]) -> Float[Array, "*batch features"]:
        """Features within [-1, 1]."""
        x = nn.relu(Dense(CHANNELS)(windows(x, STRIDE)))
        while x.shape[-2] > PLACES:
            x = nn.relu(Dense(CHANNELS)(windows(x, STRIDE)))
        return nn.tanh(Dense(self.features)(x.reshape(*x.shape[:-2], -1)))


class Trials(nn.Module):
    """Features of unordered records: a shared perceptron, the mean of its outputs, a last layer (Zaheer et al. 2017).

    Attributes:
        features: F.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch records size"]) -> Float[Array, "*batch features"]:
        """Features within [-1, 1], the same for any order of the records."""
        each = nn.relu(Dense(UNITS)(nn.relu(Dense(UNITS)(x))))
        return nn.tanh(Dense(self.features)(jnp.mean(each, axis=-2)))


@dataclasses.dataclass(frozen=True)
class Embedding:
    """A kind of embedding.

    Attributes:
        module: function from the number of features to the Flax network.
        record_size: function from a summary's layout (`jaxlfi.tasks.summaries.layout`) to the length of a record.
    """

    module: Callable[[int], nn.Module]
    record_size: Callable[[tuple[int, ...]], int]


EMBEDDINGS: dict[str, Embedding] = {
    "mlp": Embedding(Perceptron, math.prod),
    "series": Embedding(Series, lambda layout: layout[-1]),
    "trials": Embedding(Trials, lambda layout: math.prod(layout[1:])),
}
"""Embeddings by name."""


class Embedded(nn.Module):
    """An embedding and a conditional density of its features, as one network.

    Attributes:
        embedding: network from records to features.
        head: network from features to a density.
        record_size: length of a record.
    """

    embedding: nn.Module
    head: nn.Module
    record_size: int

    def __call__(self, x: Float[Array, "*batch obs"]):
        """The density for each normalised summary."""
        return self.head(self.embedding(x.reshape(*x.shape[:-1], -1, self.record_size)))


def windows(x: Float[Array, "*batch time size"], stride: int) -> Float[Array, "*batch windows both"]:
    """The windows of a strided convolution, one per row: 2 `stride` records each, starting every `stride` records.

    The series is padded with `stride` zeros in front, and with enough at the end to fill the last window.

    Example:
        >>> windows(jnp.arange(1.0, 6.0)[:, None], 2).tolist()
        [[0.0, 0.0, 1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [3.0, 4.0, 5.0, 0.0]]
    """
    *batch, time, size = x.shape
    x = jnp.pad(x, [*[(0, 0)] * len(batch), (stride, -time % stride), (0, 0)])
    blocks = x.reshape(*batch, -1, stride * size)
    return jnp.concatenate([blocks[..., :-1, :], blocks[..., 1:, :]], axis=-1)
