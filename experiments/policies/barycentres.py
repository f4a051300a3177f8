"""Barycentres of trajectories under soft dynamic time warping (Cuturi and Blondel, 2017).

ott-jax has the distance of two trajectories, but neither padding for different lengths nor barycentres. The twenty
lines here save the study a library, and are tested against the sum over all alignments that they compute.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

GAMMA = 0.1
"""Smoothing, in units of the mean squared step of the trajectories."""


def soft_dtw(
    one: Float[Array, "n dim"], other: Float[Array, "m dim"], gamma: Float[Array, ""] | float, length: Array | int = -1
) -> Float[Array, ""]:
    """-gamma log of the sum over alignments of exp(-cost / gamma); costs are squared distances.

    Args:
        one: a trajectory.
        other: another one.
        gamma: smoothing, positive.
        length: length of the other one, whose later rows are padding; by default it has none.
    """
    cost = jnp.sum((one[:, None] - other[None]) ** 2, axis=-1)

    def row(above, costs):  # above: [m + 1], the row before, with the column before the first
        def cell(left, given):
            cost, up, corner = given
            here = cost - gamma * jax.nn.logsumexp(-jnp.stack([left, up, corner]) / gamma)
            return here, here

        _, inside = jax.lax.scan(cell, BEYOND, (costs, above[1:], above[:-1]))
        whole = jnp.concatenate([jnp.full(1, BEYOND), inside])
        return whole, whole

    first = jnp.full(other.shape[0] + 1, BEYOND).at[0].set(0.0)
    last, _ = jax.lax.scan(row, first, cost)
    return last[length]


BEYOND = 1e10
"""Cost of cells that no alignment passes; it is finite because the gradient at infinity would be NaN."""


def barycentre(trajectories: Sequence[Float[np.ndarray, "_ dim"]], gamma: float = GAMMA) -> Float[np.ndarray, "n dim"]:
    """The trajectory with the smallest sum of soft-DTW distances to others, each divided by the other's length.

    It has their mean length. L-BFGS starts from the mean of the trajectories stretched to that length.

    Args:
        trajectories: trajectories of any lengths.
        gamma: smoothing, in mean squared steps.

    Raises:
        ValueError: for no trajectories.
    """
    if not trajectories:
        raise ValueError("trajectories: expected at least one, got none")
    lengths = np.array([len(one) for one in trajectories])
    n, longest = round(lengths.mean()), max(LONGEST, lengths.max())
    steps = np.concatenate([np.diff(one, axis=0) for one in trajectories if len(one) > 1] or [np.ones((1, 1))])
    unit = float(np.sqrt((steps**2).sum(axis=-1).mean())) or 1.0
    padded = np.stack([np.pad(one, ((0, longest - len(one)), (0, 0)), mode="edge") for one in trajectories]) / unit
    first = np.mean([_stretched(np.asarray(one) / unit, n) for one in trajectories], axis=0)

    def objective(flat):
        value, slope = _value_and_slope(flat.reshape(first.shape).astype(np.float32), padded, lengths, gamma)
        return float(value), np.asarray(slope, float).ravel()

    found = scipy.optimize.minimize(objective, first.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 100})
    return unit * found.x.reshape(first.shape)


LONGEST = 17
"""Number of rows that trajectories are padded to, so that one compiled program serves most of them."""


@jax.jit
@jax.value_and_grad
def _value_and_slope(centre, padded, lengths, gamma):
    far = jax.vmap(lambda one, length: soft_dtw(centre, one, gamma, length) / length)
    return jnp.sum(far(jnp.asarray(padded, jnp.float32), lengths))


def _stretched(one: np.ndarray, n: int) -> np.ndarray:
    at, old = np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, len(one))
    return np.stack([np.interp(at, old, column) for column in one.T], axis=-1)
