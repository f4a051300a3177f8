"""A prior that is uniform on a box and has Gaussian tails beyond it."""

import dataclasses
from typing import Any

import distrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support


class TailedUniform(distrax.Distribution):
    """Uniform between `low` and `high` with a Gaussian tail beyond either bound (Tirapongprasert and Ho 2026).

    Dimensions are independent. The density is continuous: h = 1 / (width + sigma sqrt(2 pi)) on the box and
    h exp(-(distance / sigma)^2 / 2) at a distance beyond it.

    Example:
        >>> prior = TailedUniform(jnp.array([0.0]), jnp.array([2.0]), jnp.array([0.4]))
        >>> bool(prior.prob(jnp.array([1.0])) == prior.prob(jnp.array([2.0])))
        True
    """

    def __init__(self, low: Float[Array, " dim"], high: Float[Array, " dim"], sigma: Float[Array, " dim"]):
        """A prior over D parameters.

        Args:
            low: lower bounds of the box, shape [D].
            high: upper bounds, shape [D].
            sigma: scale of the tails, positive, in the units of theta, shape [D].
        """
        self._low, self._high, self._sigma = low, high, sigma

    @property
    def event_shape(self) -> tuple[int, ...]:
        """(D,)."""
        return self._low.shape

    def log_prob(self, value: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at `value`."""
        beyond = jnp.maximum(jnp.maximum(self._low - value, value - self._high), 0.0)
        length = self._high - self._low + jnp.sqrt(2 * jnp.pi) * self._sigma
        return jnp.sum(-0.5 * (beyond / self._sigma) ** 2 - jnp.log(length), axis=-1)

    def _sample_n(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        # A tail has the mass of a strip of height h and this width: what is drawn in the strip goes to the tail.
        strip = jnp.sqrt(jnp.pi / 2) * self._sigma
        key_place, key_tail = jax.random.split(key)
        shape = (n, *self.event_shape)
        place = jax.random.uniform(key_place, shape, minval=self._low - strip, maxval=self._high + strip)
        tail = self._sigma * jnp.abs(jax.random.normal(key_tail, shape))
        inside = jnp.where(place > self._high, self._high + tail, place)
        return jnp.where(place < self._low, self._low - tail, inside)


def with_tails(task: Any, support: str | Support | None = None, tail: float = 0.2) -> Any:
    """The task with a tailed-uniform prior around one of its supports, to draw the first round from.

    Its only support is called "tailed" and is Phi (or the hull of both, if the box is wider), so that no tail is cut
    off at the box that it should reach beyond. With a single round all simulations are drawn from this prior, as its
    authors do; in a sequential run the first round's are. What is inferred is the posterior under this prior. The
    correction "paper", which divides by a Gaussian, refuses it.

    Args:
        task: what to infer (`jaxlfi.Task`).
        support: the box that gets tails: a name, a box in natural units, or None for the task's first.
        tail: scale of the tails as a fraction of the box's width, in inference space; 0.1 to 0.3 is advised.

    Raises:
        ValueError: for an unknown support, or a tail that is not positive.
    """
    if not tail > 0:
        raise ValueError(f"tail: expected a positive fraction of the width, got {tail}")
    box = task.support(support)
    return dataclasses.replace(
        task,
        supports={"tailed": task.space.box_to_natural(task.inference.feasible.hull(box))},
        prior=TailedUniform(box.low, box.high, tail * box.width),
        prior_space="inference",
    )
