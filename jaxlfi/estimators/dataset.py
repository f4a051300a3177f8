"""Dataset: all simulations of a run, in storage of fixed capacity."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.tasks.simulation import Simulations


@struct.dataclass
class Dataset:
    """The accumulated pairs (theta, x) of Algorithm 1, line 12. The first `size` rows are filled, the rest are zero.

    Attributes:
        theta: parameters in coordinates, shape [C, D].
        x: summaries, shape [C, S].
        round: the round each row was simulated in, shape [C].
        size: number of filled rows, shape [].
    """

    theta: Float[Array, "*batch cap dim"]
    x: Float[Array, "*batch cap obs"]
    round: Int[Array, "*batch cap"]
    size: Int[Array, "*batch"]

    @property
    def valid(self) -> Bool[Array, " cap"]:
        """Which rows are filled, shape [C]."""
        return jnp.arange(self.theta.shape[-2]) < self.size


def empty(capacity: int, dim: int, obs: int) -> Dataset:
    """Room for `capacity` simulations of D parameters and S summaries."""
    return Dataset(
        theta=jnp.zeros((capacity, dim)),
        x=jnp.zeros((capacity, obs)),
        round=jnp.zeros(capacity, jnp.int32),
        size=jnp.zeros((), jnp.int32),
    )


def augment(dataset: Dataset, attempts: Simulations, round: Int[Array, ""] | int) -> Dataset:
    """Add the kept attempts behind the rows already filled (Algorithm 1, line 12), as far as there is room."""
    capacity = dataset.theta.shape[0]
    row = dataset.size + jnp.cumsum(attempts.kept) - 1
    row = jnp.where(attempts.kept, row, capacity)  # past the end: dropped
    return Dataset(
        theta=dataset.theta.at[row].set(attempts.theta, mode="drop"),
        x=dataset.x.at[row].set(attempts.x, mode="drop"),
        round=dataset.round.at[row].set(round, mode="drop"),
        size=jnp.minimum(dataset.size + jnp.sum(attempts.kept, dtype=jnp.int32), capacity),
    )
