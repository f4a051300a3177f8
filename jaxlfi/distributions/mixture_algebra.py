"""Products, quotients, unions and reductions of Gaussian mixtures: the algebra of equation (1)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.decomposition import svd
from jaxlfi.distributions.mixture import GaussianMixture

FLOOR = 0.01
"""Minimum precision of a quotient under the "floor" policy, as a fraction of the dividend's."""

RESOLUTION = 1e-5
"""Relative difference of two whitened precisions below which float32 cannot decide its sign."""


class Pairing(struct.PyTreeNode):
    """Diagnostics of the pairs of components of a product or a quotient.

    Pair i * K_b + j is component i of `a` with component j of `b`.

    Attributes:
        indefinite: pairs of present components whose precision difference is not positive definite, shape
            [K_a * K_b].
        fell_back: whether every pair was dropped, so that `a` itself was returned, shape [].
    """

    indefinite: Bool[Array, "*batch pairs"]
    fell_back: Bool[Array, "*batch"]

    @property
    def not_positive_definite(self) -> Int[Array, "*batch"]:
        """Number of indefinite pairs, shape []."""
        return jnp.sum(self.indefinite, axis=-1)


Policy = Callable[[Float[Array, "*pairs dim"]], tuple[Float[Array, "*pairs dim"], bool]]


def drop(ratio: Float[Array, "*pairs dim"]) -> tuple[Float[Array, "*pairs dim"], bool]:
    """Give the pair no weight (logit -inf); its component is a's, which is restored if all pairs are dropped."""
    return jnp.zeros_like(ratio), False


def floor(ratio: Float[Array, "*pairs dim"]) -> tuple[Float[Array, "*pairs dim"], bool]:
    """Widen the divisor where it is too narrow, until the quotient keeps `FLOOR` of the dividend's precision.

    The pair is then the exact quotient by that wider Gaussian. If it is far from the divisor's mean, it may still move
    a long way, by up to 1 / FLOOR times their distance.
    """
    return jnp.minimum(ratio, jnp.sqrt(1.0 - FLOOR)), True


def skip(ratio: Float[Array, "*pairs dim"]) -> tuple[Float[Array, "*pairs dim"], bool]:
    """Keep the dividend's component as it is: the divisor counts as flat, as high as its peak."""
    return jnp.zeros_like(ratio), True


POLICIES: dict[str, Policy] = {"drop": drop, "floor": floor, "skip": skip}
"""What to do with a pair whose precision difference is not positive definite, by name.

A policy takes the divisor's inverse scales in the dividend's whitened principal directions, shape [..., D]
(one or more is not below 1), and returns those to divide by and whether the pair is kept.
"""


def product(a: GaussianMixture, b: GaussianMixture) -> tuple[GaussianMixture, Pairing]:
    """The product a(theta) b(theta), one component for each pair.

    N(m_1, P_1) N(m_2, P_2) = c N(m, P) with P = P_1 + P_2, P m = P_1 m_1 + P_2 m_2 and
    log c = (ld_1 + ld_2 - ld - m_1'P_1 m_1 - m_2'P_2 m_2 + m'P m - D log 2 pi) / 2, where ld = log |P|.

    Args:
        a: mixture of K_a components in D dimensions.
        b: mixture of K_b components in D dimensions.

    Returns:
        The mixture of K_a * K_b components, pair i * K_b + j being that of a_i and b_j; its logits are the
        logs of w_i v_j c_ij, so that their logsumexp is the log of the integral of a * b. And the pairing, in
        which no pair is indefinite.
    """
    pairs = _paired(a, b)
    mixture = _combined(pairs, pairs.ratio, 1.0)
    return mixture, Pairing(jnp.zeros_like(pairs.absent), jnp.asarray(False))


def quotient(a: GaussianMixture, b: GaussianMixture, policy: str = "floor") -> tuple[GaussianMixture, Pairing]:
    """The quotient a(theta) / b(theta), one component for each pair.

    N(m_1, P_1) / N(m_2, P_2) = c N(m, P) with P = P_1 - P_2, P m = P_1 m_1 - P_2 m_2 and
    log c = (ld_1 - ld_2 - ld - m_1'P_1 m_1 + m_2'P_2 m_2 + m'P m + D log 2 pi) / 2, where ld = log |P|. Exact
    where b has one component and no pair is indefinite.

    The quotient by a mixture is not a mixture. For several components this returns sum_ij w_i v_j a_i / b_j, each pair
    divided by itself: the mean over b's components of a / b_j in place of a / (the mean of b_j). It is never below the
    true quotient (Jensen), equals it where b's components coincide, and does not change when one of them is split in
    two. It is poor where they lie apart: far from b_j, a_i / b_j is large although another component covers the place.

    Args:
        a: the dividend, K_a components in D dimensions.
        b: the divisor, K_b components in D dimensions.
        policy: what to do with pairs whose precision difference is not positive definite: a name in
            `POLICIES`, static.

    Returns:
        The mixture of K_a * K_b components, ordered and weighted as in `product`, and which pairs were indefinite. If
        the policy leaves no pair at all, the mixture has a's components, uncorrected.

    Raises:
        ValueError: for an unknown policy.
    """
    if policy not in POLICIES:
        raise ValueError(f"policy: expected one of {sorted(POLICIES)}, got {policy!r}")
    pairs = _paired(a, b)
    largest = jnp.max(pairs.ratio, axis=-1)
    # 1 - t^2 factorised; its rounding grows with the largest t^2.
    definite = (1.0 - largest) * (1.0 + largest) > RESOLUTION * jnp.maximum(1.0, largest**2)
    ratio, keep = POLICIES[policy](pairs.ratio)
    dropped = pairs.absent | ~(definite | keep)
    fell_back = jnp.all(dropped)
    mixture = _combined(pairs, jnp.where(definite[:, None], pairs.ratio, ratio), -1.0)
    logits = jnp.where(dropped & ~fell_back, -jnp.inf, mixture.logits)
    return (
        GaussianMixture(logits, mixture.means, mixture.scale_tril),
        Pairing(~definite & ~pairs.absent, fell_back),
    )


def pool(mixtures: GaussianMixture) -> GaussianMixture:
    """The equal-weight union of a stacked batch of mixtures, as of an ensemble of networks.

    Args:
        mixtures: E mixtures of K components in D dimensions, stacked on a leading axis: logits [E, K].

    Returns:
        One mixture of E * K components.
    """
    flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])
    return GaussianMixture(
        logits=flat(jax.nn.log_softmax(mixtures.logits, axis=-1)),
        means=flat(mixtures.means),
        scale_tril=flat(mixtures.scale_tril),
    )


def reduce(mixture: GaussianMixture, components: int) -> GaussianMixture:
    """Merge components two by two until `components` are left; the mixture keeps its mean and covariance.

    Each merge replaces the pair of least cost B_ij = ((w_i + w_j) ld_ij - w_i ld_i - w_j ld_j) / 2, ld the
    log-determinants of the covariances, by the Gaussian of the pair's own mean and covariance. B bounds the
    Kullback-Leibler divergence from the mixture before to that after the merge (Runnalls, 2007,
    "Kullback-Leibler approach to Gaussian mixture reduction"). Absent components go first and change nothing.

    Args:
        mixture: K components in D dimensions.
        components: number of components to keep, at most K; static.

    Returns:
        The mixture of `components` components, in the order of the first of each merged group; some are absent if the
        mixture had fewer than that.

    Raises:
        ValueError: if `components` is not between 1 and K.
    """
    present = mixture.means.shape[-2]
    if not 1 <= components <= present:
        raise ValueError(f"components: expected between 1 and the mixture's {present}, got {components}")
    weights, alive = mixture.weights, jnp.ones(present, bool)
    start = _Components(weights, mixture.means, mixture.scale_tril)
    indices = jnp.arange(present)
    costs_with = jax.vmap(_merge_cost, in_axes=(None, None, 0))
    cost = jax.vmap(costs_with, in_axes=(None, 0, None))(start, indices, indices)
    cost = jnp.where(indices[:, None] < indices[None, :], cost, jnp.inf)

    def merge_cheapest(_, state):
        parts, alive, cost = state
        i, j = jnp.divmod(jnp.argmin(cost), present)
        merged = _merged(parts, i, j)
        parts = jax.tree.map(lambda all_, one: all_.at[i].set(one), parts, merged)
        alive = alive.at[j].set(False)
        to_i = jnp.where(alive & (indices != i), costs_with(parts, i, indices), jnp.inf)
        cost = cost.at[j, :].set(jnp.inf).at[:, j].set(jnp.inf)
        cost = cost.at[i, :].set(jnp.where(indices > i, to_i, jnp.inf))
        cost = cost.at[:, i].set(jnp.where(indices < i, to_i, jnp.inf))
        return parts, alive, cost

    parts, alive, _ = lax.fori_loop(0, present - components, merge_cheapest, (start, alive, cost))
    kept = jnp.argsort(~alive, stable=True)[:components]
    return GaussianMixture(jnp.log(parts.weights[kept]), parts.means[kept], parts.scale_tril[kept])


class _Pairs(struct.PyTreeNode):
    """All pairs in the whitened variables y = L_1^-1 (theta - m_1), turned to b's principal axes."""

    log_weight: Float[Array, " pairs"]  # log w_i v_j
    absent: Bool[Array, " pairs"]
    origin: Float[Array, "pairs dim"]  # m_1
    frame: Float[Array, "pairs dim dim"]  # L_1 V: from the principal axes back to theta
    ratio: Float[Array, "pairs dim"]  # t, singular values of B = L_2^-1 L_1 = U diag(t) V'
    offset: Float[Array, "pairs dim"]  # U' L_2^-1 (m_2 - m_1)
    log_peak: Float[Array, " pairs"]  # log-density of b's component at its mean


def _paired(a: GaussianMixture, b: GaussianMixture) -> _Pairs:
    """Whiten every component of b by every component of a.

    In y, a's component is standard normal and b's has precision B'B, so that sums and differences of
    precisions are 1 +- t^2: no large matrices are subtracted and every decision is free of theta's units.
    """

    def one_pair(mean_1, factor_1, mean_2, factor_2):
        unwhitened = jnp.concatenate([factor_1, (mean_2 - mean_1)[:, None]], axis=1)
        whitened = solve_triangular(factor_2, unwhitened, lower=True)
        left, ratio, right = svd(whitened[:, :-1])
        log_peak = -jnp.sum(jnp.log(jnp.diagonal(factor_2))) - 0.5 * mean_1.shape[0] * jnp.log(2 * jnp.pi)
        return mean_1, factor_1 @ right.T, ratio, left.T @ whitened[:, -1], log_peak

    over_b = jax.vmap(one_pair, in_axes=(None, None, 0, 0))
    over_both = jax.vmap(over_b, in_axes=(0, 0, None, None))
    geometry = over_both(a.means, a.scale_tril, b.means, b.scale_tril)
    log_weight = jax.nn.log_softmax(a.logits)[:, None] + jax.nn.log_softmax(b.logits)[None, :]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (log_weight, *geometry))
    return _Pairs(flat[0], jnp.isneginf(flat[0]), *flat[1:])


def _combined(pairs: _Pairs, ratio: Float[Array, "pairs dim"], sign: float) -> GaussianMixture:
    """Multiply (sign 1) or divide (sign -1) each pair, with b's inverse scales replaced by `ratio`."""
    # Narrower or wider about the same mean: offsets, in units of b's scales, change in proportion.
    offset = pairs.offset * jnp.where(pairs.ratio > 0, ratio / jnp.where(pairs.ratio > 0, pairs.ratio, 1.0), 1.0)
    precision = 1.0 + ratio**2 if sign > 0 else (1.0 - ratio) * (1.0 + ratio)
    mean = pairs.origin + jnp.einsum("pij,pj->pi", pairs.frame, sign * ratio / precision * offset)
    scale_tril = _triangular(pairs.frame / jnp.sqrt(precision)[:, None, :])
    exponent = sign * pairs.log_peak - 0.5 * jnp.sum(jnp.log(precision) + sign * offset**2 / precision, axis=-1)
    return GaussianMixture(jnp.where(pairs.absent, -jnp.inf, pairs.log_weight + exponent), mean, scale_tril)


def _triangular(factor: Float[Array, "*batch dim n"]) -> Float[Array, "*batch dim dim"]:
    """The lower Cholesky factor of factor @ factor^T, without forming that product."""
    upper = jnp.linalg.qr(jnp.swapaxes(factor, -1, -2), mode="r")
    signs = jnp.where(jnp.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return jnp.tril(jnp.swapaxes(upper, -1, -2) * signs[..., None, :])


class _Components(struct.PyTreeNode):
    """Components with plain weights, [K, ...], or one of them."""

    weights: Float[Array, "*comp"]
    means: Float[Array, "*comp dim"]
    scale_tril: Float[Array, "*comp dim dim"]


def _merged(parts: _Components, i: Int[Array, ""], j: Int[Array, ""]) -> _Components:
    """The Gaussian with the weight, mean and covariance of components i and j together."""
    total = parts.weights[i] + parts.weights[j]
    # Of two absent components the first stays as it is.
    share_j = jnp.where(total > 0, parts.weights[j] / jnp.where(total > 0, total, 1.0), 0.0)
    share_i = 1.0 - share_j
    between = parts.means[j] - parts.means[i]
    factor = jnp.concatenate(
        [
            jnp.sqrt(share_i) * parts.scale_tril[i],
            jnp.sqrt(share_j) * parts.scale_tril[j],
            (jnp.sqrt(share_i * share_j) * between)[:, None],
        ],
        axis=1,
    )
    return _Components(total, parts.means[i] + share_j * between, _triangular(factor))


def _merge_cost(parts: _Components, i: Int[Array, ""], j: Int[Array, ""]) -> Float[Array, ""]:
    """Runnalls's bound B_ij; -inf if one of the two is absent, which costs nothing to remove."""
    log_det = lambda factor: 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor)))
    weight_i, weight_j = parts.weights[i], parts.weights[j]
    merged = _merged(parts, i, j)
    # Differences of log-determinants keep the precision that small components need.
    cost = 0.5 * (
        weight_i * (log_det(merged.scale_tril) - log_det(parts.scale_tril[i]))
        + weight_j * (log_det(merged.scale_tril) - log_det(parts.scale_tril[j]))
    )
    return jnp.where((weight_i == 0) | (weight_j == 0), -jnp.inf, cost)
