"""Convergence: whether a run's posterior still changes from round to round; if not, the run can end."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.mixture import GaussianMixture

LAG = 3
"""Rounds over which a posterior's change is measured."""
STILL = 0.5
"""Shift of the mean below which a posterior has settled, in its standard deviations."""
SAME_WIDTH = 2.0
"""Factor between standard deviations below which a posterior has settled.

Networks that are reinitialised differ by chance: between rounds of a converged linear Gaussian, the parameter that
changes most does so by a factor of 1.3 in the median, and of 1.7 in one round of ten.
"""
SAME_CORRELATION = 0.5
"""Change of a correlation below which a posterior has settled; by chance, 0.2 is reached in one round of ten."""


class Progress(struct.PyTreeNode):
    """The progress of a run: the moments of its posterior, compared with those `LAG` rounds before.

    Attributes:
        rounds: number of rounds made, shape [].
        means: posterior means after the last `LAG` rounds, oldest first, NaN where there was none, shape [LAG, D].
        covariances: covariances of the same posteriors, shape [LAG, D, D].
        moved: largest shift of the posterior's mean in any parameter, in current standard deviations; infinite in the
            first `LAG` rounds, shape [].
        rescaled: largest factor, at least 1, by which any standard deviation has grown or shrunk; likewise infinite,
            shape [].
        turned: largest change of any correlation; likewise infinite, shape [].
        settled: whether the run has ended, shape [].
    """

    rounds: Int[Array, "*batch"]
    means: Float[Array, "*batch lag dim"]
    covariances: Float[Array, "*batch lag dim dim"]
    moved: Float[Array, "*batch"]
    rescaled: Float[Array, "*batch"]
    turned: Float[Array, "*batch"]
    settled: Bool[Array, "*batch"]


def not_begun(dim: int) -> Progress:
    """The progress before the first round."""
    unknown = jnp.asarray(jnp.inf)
    return Progress(
        rounds=jnp.asarray(0),
        means=jnp.full((LAG, dim), jnp.nan),
        covariances=jnp.full((LAG, dim, dim), jnp.nan),
        moved=unknown,
        rescaled=unknown,
        turned=unknown,
        settled=jnp.asarray(False),
    )


def advanced(progress: Progress, posterior: GaussianMixture, min_rounds: int) -> Progress:
    """The progress after one more round.

    Args:
        progress: progress before the round.
        posterior: posterior after the round, not restricted to a support.
        min_rounds: smallest number of rounds before a run may settle; 0: it never does.
    """
    mean, covariance = posterior.mean, posterior.covariance
    (scale, correlation), (former, was) = _split(covariance), _split(progress.covariances[0])
    known = lambda change: jnp.where(jnp.isnan(change), jnp.inf, change)
    moved = known(jnp.max(jnp.abs(mean - progress.means[0]) / scale))
    rescaled = known(jnp.exp(jnp.max(jnp.abs(jnp.log(scale / former)))))
    turned = known(jnp.max(jnp.abs(correlation - was)))
    done = progress.rounds + 1
    still = (moved < STILL) & (rescaled < SAME_WIDTH) & (turned < SAME_CORRELATION)
    return Progress(
        rounds=done,
        means=jnp.concatenate([progress.means[1:], mean[None]]),
        covariances=jnp.concatenate([progress.covariances[1:], covariance[None]]),
        moved=moved,
        rescaled=rescaled,
        turned=turned,
        settled=(0 < min_rounds) & (min_rounds <= done) & still,
    )


def changes(moved: float, rescaled: float, turned: float) -> list[str]:
    """Describe how a posterior still changed over the last rounds; empty if it has settled.

    Example:
        >>> changes(1.26, 1.1, 0.2)
        ['means by up to 1.3 standard deviations']
    """
    found = [f"means by up to {moved:.1f} standard deviations"] * (moved >= STILL)
    found += [f"standard deviations by factors of up to {rescaled:.1f}"] * (rescaled >= SAME_WIDTH)
    return found + [f"correlations by up to {turned:.1f}"] * (turned >= SAME_CORRELATION)


def _split(covariance: Float[Array, "dim dim"]) -> tuple[Float[Array, " dim"], Float[Array, "dim dim"]]:
    """Standard deviations and correlations."""
    scale = jnp.sqrt(jnp.diagonal(covariance))
    return scale, covariance / (scale[:, None] * scale)
