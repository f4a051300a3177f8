"""Dataset: all simulations of a run, in storage of fixed capacity."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.tasks.simulation import Simulations


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
    def late(self) -> Bool[Array, " cap"]:
        """Rows from the later half of the rounds, which are nearer to the observation, shape [C]."""
        last = jnp.max(jnp.where(self.valid, self.round, 0))
        return self.valid & (2 * self.round > last - 1)


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
