"""Dataset: all simulations of a run, in storage of fixed capacity."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.tasks.simulation import Simulations

FAR = 5.0
"""Distance outside the last round's parameters up to which simulations count as near, in multiples of their span.

A hundred proposals, twice as wide as a posterior, span ten of its standard deviations; five such spans are fifty.
"""
LEAST_NEAR = 0.5
"""Fraction of the simulations, the nearest ones, that always count as near: a round may have gone astray."""


class Dataset(struct.PyTreeNode):
    """The accumulated pairs (theta, x) of Algorithm 1, line 9. The first `size` rows are filled, the rest are zero.

    Attributes:
        theta: parameters in inference space, shape [C, D].
        x: summaries, shape [C, S].
        round: the round each row was simulated in, shape [C].
        weight: weight of each row in the loss: 1 except for simulations given with the density they were drawn from,
            shape [C].
        size: number of filled rows, shape [].
    """

    theta: Float[Array, "*batch cap dim"]
    x: Float[Array, "*batch cap obs"]
    round: Int[Array, "*batch cap"]
    weight: Float[Array, "*batch cap"]
    size: Int[Array, "*batch"]

    @property
    def capacity(self) -> int:
        """Number of rows C, filled or not."""
        return self.theta.shape[-2]

    @property
    def valid(self) -> Bool[Array, " cap"]:
        """Which rows are filled, shape [C]."""
        return jnp.arange(self.capacity) < self.size

    @property
    def last_round(self) -> Int[Array, ""]:
        """Index of the last round with simulations in the dataset; 0 if it is empty."""
        return jnp.max(jnp.where(self.valid, self.round, 0))

    @property
    def late(self) -> Bool[Array, " cap"]:
        """Which rows are from the later half of the rounds, nearer to the observation, shape [C]."""
        return self.valid & (2 * self.round > self.last_round - 1)

    @property
    def near(self) -> Bool[Array, " cap"]:
        """Which rows have parameters not far outside those of the last round, shape [C].

        The posterior learnt from them is the same as from all rows, as their proposals are merely truncated to a box.
        But networks learn it better: a posterior a thousand times narrower than the first proposals is a dot among all
        simulations, and networks trained on all of them are several times too wide there.
        """
        last = self.valid & (self.round == self.last_round)
        low = jnp.min(self.theta, axis=0, where=last[:, None], initial=jnp.inf)
        high = jnp.max(self.theta, axis=0, where=last[:, None], initial=-jnp.inf)
        outside = jnp.maximum(jnp.maximum(low - self.theta, self.theta - high), 0.0)
        spans = jnp.max(outside / jnp.maximum(high - low, 1e-30), axis=-1)
        spans = jnp.where(self.valid, spans, jnp.inf)
        least = jnp.sort(spans)[jnp.astype(LEAST_NEAR * self.size, int)]
        return self.valid & (spans <= jnp.maximum(FAR, least))

    def only(self, rows: Bool[Array, " cap"]) -> tuple["Dataset", Int[Array, " cap"]]:
        """Some of the filled rows, in their order, and their places, which those of the other rows follow."""
        places = jnp.argsort(~rows, stable=True)
        taken = {name: getattr(self, name)[places] for name in ("theta", "x", "round", "weight")}
        return Dataset(**taken, size=jnp.sum(rows, dtype=self.size.dtype)), places


def empty(capacity: int, dim: int, obs: int) -> Dataset:
    """Room for `capacity` simulations of D parameters and S summaries."""
    return Dataset(
        theta=jnp.zeros((capacity, dim)),
        x=jnp.zeros((capacity, obs)),
        round=jnp.zeros(capacity, jnp.int32),
        weight=jnp.ones(capacity),
        size=jnp.zeros((), jnp.int32),
    )


def augment(dataset: Dataset, simulations: Simulations, round: Int[Array, ""] | int) -> Dataset:
    """Append the kept simulations to the filled rows (Algorithm 1, line 9), as far as there is room."""
    row = dataset.size + jnp.cumsum(simulations.kept) - 1
    row = jnp.where(simulations.kept, row, dataset.capacity)  # past the end: dropped
    return Dataset(
        theta=dataset.theta.at[row].set(simulations.theta, mode="drop"),
        x=dataset.x.at[row].set(simulations.x, mode="drop"),
        round=dataset.round.at[row].set(round, mode="drop"),
        weight=dataset.weight.at[row].set(simulations.weight, mode="drop"),
        size=jnp.minimum(dataset.size + jnp.sum(simulations.kept, dtype=jnp.int32), dataset.capacity),
    )
