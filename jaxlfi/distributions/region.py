"""The part of a box where a prior is not zero."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import TRIES, rejection_sample


class Region(struct.PyTreeNode):
    """A box without the places where a prior is zero. It replaces a `Support` as the place in which draws are kept.

    Attributes:
        box: the box, in inference space.
        prior: prior with `sample(seed=key, sample_shape=n)` and `log_prob`, over inference space
            (`Task.inference.prior`).

    Example:
        >>> import distrax
        >>> half = Region(Support([-1.0], [3.0]), distrax.Independent(distrax.Uniform(jnp.zeros(1), jnp.ones(1)), 1))
        >>> half.contains(jnp.array([[-0.5], [0.5], [1.5]])).tolist()
        [False, True, False]
    """

    box: Support
    prior: Any = struct.field(pytree_node=False)

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return self.box.dim

    def contains(self, theta: Float[Array, "*n dim"]) -> Bool[Array, "*n"]:
        """Whether each parameter vector lies in the box, at a place of positive and finite prior density."""
        return self.box.contains(theta) & (self.log_prior(theta) > -jnp.inf)

    def log_prior(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """The prior's log-density, -inf where it is not finite."""
        log_prob = self.prior.log_prob(theta)
        return jnp.where(jnp.isfinite(log_prob), log_prob, -jnp.inf)

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws of the prior inside the box, by rejection in bounded time.

        If nearly all of the prior lies outside the box, a draw is picked by the prior's density from points that are
        uniform over the box. If the prior is zero at all of them, the box has left the prior: the draws are then the
        prior's own, wherever they are.
        """
        return rejection_sample(key, self._anywhere, self, n, self._picked)

    def _anywhere(self, key: jax.Array, n: int) -> Array:
        return self.prior.sample(seed=key, sample_shape=n)

    def _picked(self, key: jax.Array, n: int) -> Array:
        key_box, key_pick, key_prior = jax.random.split(key, 3)
        theta = self.box.sample(key_box, n * TRIES).reshape(n, TRIES, self.dim)
        log_weight = self.log_prior(theta)
        found = jnp.any(log_weight > -jnp.inf, axis=1)
        picked = jax.random.categorical(key_pick, log_weight)
        theta = jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0]
        # A draw without an accepted point takes that of another draw.
        others = jnp.argsort(~found)[jnp.arange(n) % jnp.maximum(jnp.sum(found), 1)]
        theta = jnp.where(found[:, None], theta, theta[others])
        return jnp.where(jnp.any(found), theta, self._anywhere(key_prior, n))


def region(box: Support, prior: Any) -> Support | Region:
    """The part of a box where a prior is not zero: the whole box without a prior."""
    return box if prior is None else Region(box, prior)
