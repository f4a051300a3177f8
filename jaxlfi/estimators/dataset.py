"""Dataset: all simulations of a run, in storage of fixed capacity."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.tasks.simulation import Simulations

FAR = 5.0
"""How far outside the last round's parameters simulations count as near, in multiples of what these span.

A hundred proposals, twice as wide as a posterior, span ten of its standard deviations, so that these are fifty.
"""
LEAST_NEAR = 0.5
"""Fraction of the simulations that count as near in any case, the nearest ones: a round may have gone astray."""


class Dataset(struct.PyTreeNode):
    """The accumulated pairs (theta, x) of Algorithm 1, line 9. The first `size` rows are filled, the rest are zero.

    Attributes:
        theta: parameters in inference space, shape [C, D].
        x: summaries, shape [C, S].
        round: the round each row was simulated in, shape [C].
        weight: of each row in the loss: 1 but for simulations that were given with the density they were drawn from,
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
        """Rows that are filled, shape [C]."""
        return jnp.arange(self.capacity) < self.size

    @property
    def last_round(self) -> Int[Array, ""]:
        """The last round that rows are of; 0 without any."""
        return jnp.max(jnp.where(self.valid, self.round, 0))

    @property
    def late(self) -> Bool[Array, " cap"]:
        """Rows from the later half of the rounds, which are nearer to the observation, shape [C]."""
        return self.valid & (2 * self.round > self.last_round - 1)

    @property
    def near(self) -> Bool[Array, " cap"]:
        """Rows whose parameters are not far outside those of the last round, shape [C].

        A network learns the same posterior from them as from all: they are simulations of proposals that are cut off
        at a box. But it learns it better. Next to everything that was simulated, a posterior a thousand times narrower
        than the first proposals is a dot, and networks that answer for all of it are several times too wide there.
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
        """Some of the filled rows, in the order that they have, and their places; those of the others follow."""
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
    """Add the kept simulations behind the rows already filled (Algorithm 1, line 9), as far as there is room."""
    row = dataset.size + jnp.cumsum(simulations.kept) - 1
    row = jnp.where(simulations.kept, row, dataset.capacity)  # past the end: dropped
    return Dataset(
        theta=dataset.theta.at[row].set(simulations.theta, mode="drop"),
        x=dataset.x.at[row].set(simulations.x, mode="drop"),
        round=dataset.round.at[row].set(round, mode="drop"),
        weight=dataset.weight.at[row].set(simulations.weight, mode="drop"),
        size=jnp.minimum(dataset.size + jnp.sum(simulations.kept, dtype=jnp.int32), dataset.capacity),
    )
