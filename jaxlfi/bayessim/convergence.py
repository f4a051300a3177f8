"""Convergence: whether a run's posterior still moves from round to round, and the end of runs whose does not."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.mixture import GaussianMixture

LAG = 3
"""Rounds over which a posterior's movement is measured."""
STILL = 0.5
"""Movement below which a posterior has settled, in its standard deviations."""


@struct.dataclass
class Progress:
    """How far a run has come.

    Attributes:
        rounds: it has made, shape [].
        means: of the posteriors after the last `LAG` rounds, oldest first, NaN where there was none, shape [LAG, D].
        moved: how far the posterior's mean has moved over the last `LAG` rounds, in its standard deviations now, in the
            parameter where that is most; infinite before so many rounds, shape [].
        settled: whether the run is at its end, shape [].
    """

    rounds: Int[Array, "*batch"]
    means: Float[Array, "*batch lag dim"]
    moved: Float[Array, "*batch"]
    settled: Bool[Array, "*batch"]


def not_begun(dim: int) -> Progress:
    """Before the first round."""
    return Progress(
        rounds=jnp.asarray(0),
        means=jnp.full((LAG, dim), jnp.nan),
        moved=jnp.asarray(jnp.inf),
        settled=jnp.asarray(False),
    )


def advanced(progress: Progress, posterior: GaussianMixture, min_rounds: int) -> Progress:
    """After one more round.

    Args:
        progress: before it.
        posterior: after it, before it was restricted to a support.
        min_rounds: that a run makes before it may settle; 0: it never does.
    """
    mean, variance = posterior.mean, jnp.diagonal(posterior.covariance)
    distance = jnp.max(jnp.abs(mean - progress.means[0]) / jnp.sqrt(variance))
    moved = jnp.where(jnp.isnan(distance), jnp.inf, distance)
    done = progress.rounds + 1
    means = jnp.concatenate([progress.means[1:], mean[None]])
    return Progress(done, means, moved, settled=(0 < min_rounds) & (min_rounds <= done) & (moved < STILL))
