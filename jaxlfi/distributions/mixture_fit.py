"""A mixture of Gaussians fitted to weighted samples, by expectation maximisation in a fixed number of iterations."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture


class _Components(struct.PyTreeNode):
    """A mixture of standardised samples, with eigendecomposed covariances; fields [K], [K, D], [K, D, D]."""

    log_weights: Array
    means: Array
    variances: Array
    axes: Array


def fit_mixture(
    key: jax.Array,
    theta: Float[Array, "n dim"],
    weights: Float[Array, " n"],
    components: int,
    iterations: int = 50,
    floor: Float[Array, ""] | float = 1e-4,
    restarts: int = 4,
) -> tuple[GaussianMixture, Float[Array, " iterates"]]:
    """Maximum-likelihood mixture of K Gaussians with full covariances (Dempster et al. 1977; Bishop 2006, 9.2.2).

    It lets code that takes mixtures only, such as the support heuristics, act on draws of a flow's posterior.

    The samples are standardised. Each restart seeds its means by k-means++ (Arthur and Vassilvitskii 2007) and starts
    with one covariance for all; the restart with the largest final likelihood is returned. The floor is part of what is
    maximised (eigenvalues below it are raised to it, which is the most likely covariance under that constraint), so
    that the likelihood never decreases.

    Args:
        key: consumed; seeds are drawn with it.
        theta: samples, shape [N, D]. Those with weight 0 may be anything.
        weights: weights of the samples, not negative, with any sum above 0, shape [N].
        components: number of components K.
        iterations: number of iterations of expectation maximisation.
        floor: least variance of a component in any direction, for standardised samples: 1e-4 is a hundredth of the
            samples' standard deviations. It keeps components from collapsing onto single samples, and must be above 0.
        restarts: number of seedings.

    Returns:
        The mixture, and the mean log-likelihood of the samples before each iteration and after the last, in nats,
        shape [iterations + 1]. A component that ends up with no sample has the logit -inf.

    Raises:
        ValueError: for counts below 1.
    """
    for name, count in {"components": components, "iterations": iterations, "restarts": restarts}.items():
        if count < 1:
            raise ValueError(f"{name}: expected at least 1, got {count}")
    theta = jnp.where((weights > 0)[:, None], theta, 0.0)
    weights = weights / jnp.sum(weights)
    # Twice, as the rounding of a mean far from zero is much larger than that of a mean of residuals.
    shift = weights @ theta
    shift = shift + weights @ (theta - shift)
    deviation = jnp.sqrt(weights @ (theta - shift) ** 2)
    # Equal samples have a deviation of 0 or of rounding errors: the scale is at least the resolution of float32.
    largest = jnp.max(jnp.where((weights > 0)[:, None], jnp.abs(theta), 0.0), axis=0)
    scale = jnp.maximum(deviation, jnp.maximum(1e-6 * largest, 1e-16))  # whose square is still a number
    z = jnp.where((weights > 0)[:, None], (theta - shift) / scale, 0.0)

    def one(key):
        start = _seeded(key, z, weights, components, floor)

        def iterate(current, _):
            joint = _joint_log_prob(current, z)
            return _maximised(current, joint, z, weights, floor), _mean_log_likelihood(joint, weights)

        last, history = jax.lax.scan(iterate, start, length=iterations)
        return last, jnp.append(history, _mean_log_likelihood(_joint_log_prob(last, z), weights))

    fits, histories = jax.vmap(one)(jax.random.split(key, restarts))
    best = jnp.argmax(histories[:, -1])
    fit, history = jax.tree.map(lambda leaf: leaf[best], (fits, histories))
    covariances = jnp.einsum("kij,kj,klj->kil", fit.axes, fit.variances, fit.axes)
    mixture = GaussianMixture(fit.log_weights, fit.means, jnp.linalg.cholesky(covariances))
    return mixture.affine(scale, shift), history - jnp.sum(jnp.log(scale))


def _seeded(key, z, weights, components, floor) -> _Components:
    """K means drawn from the samples, each with probability proportional to its squared distance from those before."""

    def draw(key, odds):
        # If all odds are zero (fewer distinct samples than components), the samples' weights replace them.
        odds = jnp.where(jnp.sum(odds) > 0, odds, weights)
        return z[jax.random.categorical(key, jnp.log(odds))]

    def add(nearest, index):
        mean = draw(jax.random.fold_in(key, index), weights * jnp.where(jnp.isinf(nearest), 1.0, nearest))
        return jnp.minimum(nearest, jnp.sum((z - mean) ** 2, axis=-1)), mean

    _, means = jax.lax.scan(add, jnp.full(z.shape[0], jnp.inf), jnp.arange(components))
    nearest = jnp.argmin(jnp.sum((z[:, None] - means) ** 2, axis=-1), axis=-1)
    offset = z - means[nearest]
    covariance = jnp.einsum("n,ni,nj->ij", weights, offset, offset)
    variances, axes = _floored(jnp.broadcast_to(covariance, (components, *covariance.shape)), floor)
    return _Components(jnp.full(components, -np.log(components), z.dtype), means, variances, axes)


def _joint_log_prob(current, z):
    """Log w_k N(z_n | mu_k, Sigma_k), shape [N, K]."""
    whitening = current.axes / jnp.sqrt(current.variances)[:, None, :]
    offset = z[:, None] - current.means
    whitened = jnp.einsum("nki,kij->nkj", offset, whitening)
    log_norm = -0.5 * jnp.sum(jnp.log(2 * np.pi * current.variances), axis=-1)
    return current.log_weights + log_norm - 0.5 * jnp.sum(whitened**2, axis=-1)


def _maximised(current, joint, z, weights, floor) -> _Components:
    """The maximisation step: the most likely components given their responsibilities for the samples."""
    responsibilities = weights[:, None] * jax.nn.softmax(joint, axis=-1)
    mass = jnp.sum(responsibilities, axis=0)
    alive = mass > 1e-12
    safe = jnp.where(alive, mass, 1.0)
    means = jnp.where(alive[:, None], responsibilities.T @ z / safe[:, None], current.means)
    offset = z[:, None] - means
    # Whole matrix products: [D, N] by [N, D] for each component.
    scatter = jnp.einsum("nki,nkj->kij", responsibilities[..., None] * offset, offset) / safe[:, None, None]
    variances, axes = _floored(jnp.where(alive[:, None, None], scatter, jnp.eye(z.shape[-1])), floor)
    return _Components(jnp.where(alive, jnp.log(safe), -jnp.inf), means, variances, axes)


def _floored(covariance, floor):
    """Eigenvalues, raised to the floor, and eigenvectors (columns)."""
    variances, axes = jnp.linalg.eigh(covariance)
    return jnp.maximum(variances, floor), axes


def _mean_log_likelihood(joint, weights):
    return weights @ jax.nn.logsumexp(joint, axis=-1)
