"""A mixture of Gaussians with full covariances: the form of a posterior in this library."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.linalg import solve_triangular
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int

if TYPE_CHECKING:
    import distrax

FARTHEST = 2.0
"""Largest shift of a component when a mixture is made wider about its mean, in its standard deviations."""
HALVINGS = 40
"""Number of bisections for a quantile: 2^-40 of the interval it is known to lie in is below the spacing of float32."""


class GaussianMixture(struct.PyTreeNode):
    """K Gaussians in D dimensions, sum_k w_k N(mu_k, L_k L_k^T).

    Attributes:
        logits: unnormalised log-weights, shape [K]; a component of logit -inf is absent.
        means: mu_k, shape [K, D].
        scale_tril: lower Cholesky factors L_k with positive diagonals, shape [K, D, D].
    """

    logits: Float[Array, "*batch comp"]
    means: Float[Array, "*batch comp dim"]
    scale_tril: Float[Array, "*batch comp dim dim"]

    @property
    def weights(self) -> Float[Array, "*batch comp"]:
        """w_k, summing to one, shape [K]."""
        return jax.nn.softmax(self.logits, axis=-1)

    @property
    def covariances(self) -> Float[Array, "*batch comp dim dim"]:
        """Sigma_k, shape [K, D, D]."""
        return self.scale_tril @ jnp.swapaxes(self.scale_tril, -1, -2)

    @property
    def marginal_scales(self) -> Float[Array, "*batch comp dim"]:
        """Standard deviation of each component in each dimension, shape [K, D]."""
        return jnp.sqrt(jnp.sum(self.scale_tril**2, axis=-1))

    @property
    def mean(self) -> Float[Array, "*batch dim"]:
        """The weighted mean of the components, shape [D]: the mu of CENTRE (Algorithm 4, line 4)."""
        return jnp.sum(self.weights[..., None] * self.means, axis=-2)

    @property
    def covariance(self) -> Float[Array, "*batch dim dim"]:
        """Covariance of the whole mixture, within components plus between them, shape [D, D]."""
        offset = self.means - self.mean[..., None, :]
        second = self.covariances + offset[..., :, None] * offset[..., None, :]
        return jnp.sum(self.weights[..., None, None] * second, axis=-3)

    def distribution(self) -> "distrax.MixtureSameFamily":
        """The mixture as a distrax distribution (one mixture, not a batch)."""
        import distrax  # the import takes a second; no run needs it

        return distrax.MixtureSameFamily(
            distrax.Categorical(logits=self.logits), distrax.MultivariateNormalTri(self.means, self.scale_tril)
        )

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta."""
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + component_log_prob(self, theta), axis=-1)

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` independent draws, in random order."""
        key_component, key_normal = jax.random.split(key)
        component = picked(self.weights, jax.random.uniform(key_component, (n,)))
        noise = jax.random.normal(key_normal, (n, self.means.shape[-1]))
        return self.means[component] + jnp.einsum("nij,nj->ni", self.scale_tril[component], noise)

    def low_variance_sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws whose component counts are within one of n * w_k (systematic resampling), shuffled.

        One uniform offset picks the components at stride 1/n along the cumulative weights, so few draws cover all
        hypotheses of the posterior in proportion (the low-variance sampling used for domain randomisation).
        """
        key_offset, key_order, key_normal = jax.random.split(key, 3)
        component = systematic(key_offset, self.weights, n)
        component = jax.random.permutation(key_order, component)
        noise = jax.random.normal(key_normal, (n, self.means.shape[-1]))
        return self.means[component] + jnp.einsum("nij,nj->ni", self.scale_tril[component], noise)

    def marginal_cdf(self, theta: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """P(theta_d' <= theta_d) for each dimension by itself, in closed form, shape [D]."""
        z = (theta - self.means) / self.marginal_scales
        return jnp.sum(self.weights[:, None] * norm.cdf(z), axis=0)

    def interval_mass(self, low: Float[Array, " dim"], high: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Marginal mass in [low_d, high_d] for each dimension, in closed form, shape [D].

        Bounds may be infinite. Each component's interval is reflected to the side where the normal distribution
        function is small, so that masses far out in either tail keep their relative precision.
        """
        below = (low - self.means) / self.marginal_scales
        above = (high - self.means) / self.marginal_scales
        flip = below > 0
        lower, upper = jnp.where(flip, -above, below), jnp.where(flip, -below, above)
        return jnp.sum(self.weights[:, None] * (norm.cdf(upper) - norm.cdf(lower)), axis=0)

    def marginal_quantile(self, level: Float[Array, ""] | Float[Array, " dim"] | float) -> Float[Array, " dim"]:
        """The quantile of `level` in each dimension by itself, by bisection of the CDF, shape [D].

        Small levels keep their relative precision; `-mixture.mirror().marginal_quantile(level)` has as little mass
        above it. Derivatives are those of the implicit function, and zero in a gap between components, where the CDF is
        flat.

        Args:
            level: mass in [0, 1]; 0 and 1 give -inf and inf.
        """
        # The mixture's quantile lies between the least and the greatest of the components' own.
        own = self.means + self.marginal_scales * norm.ppf(level)
        absent = (self.weights == 0)[:, None]
        least = jnp.min(jnp.where(absent, jnp.inf, own), axis=0)
        greatest = jnp.max(jnp.where(absent, -jnp.inf, own), axis=0)

        def bisect(excess, start):
            def halve(_, ends):
                low, high = ends
                middle = 0.5 * (low + high)
                below = excess(middle) < 0
                return jnp.where(below, middle, low), jnp.where(below, high, middle)

            low, high = jax.lax.fori_loop(0, HALVINGS, halve, (start, greatest))
            return 0.5 * (low + high)

        def divide(linear, value):
            density = linear(jnp.ones_like(value))
            return jnp.where(density > 0, value / jnp.where(density > 0, density, 1.0), 0.0)

        return jax.lax.custom_root(lambda theta: self.marginal_cdf(theta) - level, least, bisect, divide)

    def marginal(self, kept: Sequence[int]) -> "GaussianMixture":
        """The marginal mixture of some dimensions, in the order given, in closed form.

        Example:
            >>> both = GaussianMixture(jnp.zeros(1), jnp.array([[3.0, 4.0]]), jnp.array([[[1.0, 0.0], [3.0, 4.0]]]))
            >>> float(both.marginal((1,)).scale_tril[0, 0, 0])
            5.0
        """
        rows = np.asarray(kept)
        return GaussianMixture(self.logits, self.means[:, rows], lower_factor(self.scale_tril[:, rows]))

    def conditional(self, given: Sequence[int], values: Float[Array, " given"]) -> "GaussianMixture":
        """The mixture of the other dimensions given the values of some, in closed form.

        Its logits are the logarithms of w_k N(values; ...) and are not normalised: their logsumexp is the log-density
        of the values.

        Args:
            given: dimensions with given values, not all.
            values: values of these.

        Example:
            >>> both = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.array([[[1.0, 0.0], [0.8, 0.6]]]))
            >>> other = both.conditional((0,), jnp.array([2.0]))
            >>> [round(float(value[0].squeeze()), 3) for value in (other.means, other.scale_tril)]
            [1.6, 0.6]
        """
        order = np.concatenate([given, np.setdiff1d(np.arange(self.means.shape[-1]), given)]).astype(int)
        first, means = len(given), self.means[:, order]
        factor = lower_factor(self.scale_tril[:, order])
        known = GaussianMixture(self.logits, means[:, :first], factor[:, :first, :first])
        z = jax.vmap(functools.partial(solve_triangular, lower=True))(known.scale_tril, values - known.means)
        return GaussianMixture(
            logits=jax.nn.log_softmax(self.logits) + component_log_prob(known, values),
            means=means[:, first:] + jnp.einsum("kij,kj->ki", factor[:, first:, :first], z),
            scale_tril=factor[:, first:, first:],
        )

    def mirror(self) -> "GaussianMixture":
        """The mixture of -theta."""
        return GaussianMixture(self.logits, -self.means, self.scale_tril)

    def affine(self, scale: Float[Array, " dim"], shift: Float[Array, " dim"]) -> "GaussianMixture":
        """The mixture of scale * theta + shift, dimension by dimension; scale must be positive."""
        return GaussianMixture(
            logits=self.logits, means=scale * self.means + shift, scale_tril=scale[:, None] * self.scale_tril
        )

    def inflated(self, factor: Float[Array, ""] | float) -> "GaussianMixture":
        """The mixture of mean + factor * (theta - mean): `factor` times as wide about the same mean.

        But a component moves by at most `FARTHEST` of its standard deviations: components of one peak are spread with
        it, and peaks far from each other stay where they are.

        Example:
            >>> one = GaussianMixture(jnp.zeros(1), jnp.array([[3.0]]), jnp.array([[[0.5]]]))
            >>> float(one.inflated(2.0).scale_tril[0, 0, 0])
            1.0
        """
        moved = (factor - 1) * (self.means - self.mean[..., None, :])
        distance = jnp.linalg.norm(solve_triangular(self.scale_tril, moved[..., None], lower=True), axis=(-2, -1))
        moved = moved * (FARTHEST / jnp.maximum(distance, FARTHEST))[..., None]
        return self.replace(means=self.means + moved, scale_tril=factor * self.scale_tril)

    def prune(self, least: Float[Array, ""] | float) -> "GaussianMixture":
        """The mixture without components of weight below `least` (logit -inf); the heaviest always stays."""
        kept = (self.weights >= least) | (self.weights == jnp.max(self.weights))
        return GaussianMixture(jnp.where(kept, self.logits, -jnp.inf), self.means, self.scale_tril)

    def permute(self, order: Int[Array, " comp"]) -> "GaussianMixture":
        """The same mixture with its components in another order."""
        return GaussianMixture(self.logits[order], self.means[order], self.scale_tril[order])


def lower_factor(rows: Float[Array, "*batch rows columns"]) -> Float[Array, "*batch rows rows"]:
    """The lower Cholesky factor of rows @ rows^T, without forming that product."""
    upper = jnp.linalg.qr(jnp.swapaxes(rows, -1, -2), mode="r")
    signs = jnp.where(jnp.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return jnp.swapaxes(signs[..., None] * upper, -1, -2)


def systematic(key: jax.Array, weights: Float[Array, " comp"], n: int) -> Int[Array, " n"]:
    """Low-variance (systematic) draw of `n` component indices: each count is within one of n * weight."""
    return picked(weights, (jnp.arange(n) + jax.random.uniform(key)) / n)


def picked(weights: Float[Array, " comp"], uniform: Float[Array, " n"]) -> Int[Array, " n"]:
    """The component of each number in [0, 1], which components divide in proportion to their weights."""
    cumulated = jnp.cumsum(weights)
    # A number can round up to the whole sum, which would pick the last component even if it is absent.
    points = jnp.minimum(uniform * cumulated[-1], jnp.nextafter(cumulated[-1], 0.0))
    return jnp.searchsorted(cumulated, points, side="right")


def component_log_prob(mixture: GaussianMixture, theta: Float[Array, "*n dim"]) -> Float[Array, "*n comp"]:
    """Log-density of theta under each component."""
    components, dim = mixture.means.shape
    offset = (theta[..., None, :] - mixture.means).reshape(-1, components, dim)
    whitened = jax.vmap(functools.partial(solve_triangular, lower=True))(mixture.scale_tril, offset.transpose(1, 2, 0))
    log_det = jnp.sum(jnp.log(jnp.diagonal(mixture.scale_tril, axis1=-2, axis2=-1)), axis=-1)
    log_prob = -0.5 * jnp.sum(whitened**2, axis=1).T - log_det - 0.5 * dim * jnp.log(2 * jnp.pi)
    return log_prob.reshape(*theta.shape[:-1], components)
