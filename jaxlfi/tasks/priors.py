"""Priors: a task's own, drawn within its support, and one with Gaussian tails beyond a box."""

import dataclasses
import functools
from typing import Any

import distrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import MASS_DRAWS, mass_inside, rejection_sample

MIN_INSIDE = 0.01
"""Mass of a prior inside the support below which a run is refused: its draws would be those of a uniform prior."""
FINGERPRINT_POINTS = 8
"""Points at which priors are compared."""
LOW_INSIDE = 0.1
"""Mass below which a run warns: 3 % of the draws, or more, are uniform over the support instead."""


@dataclasses.dataclass(frozen=True)
class InferencePrior:
    """A prior over natural units as a distribution over inference space.

    Attributes:
        natural: a distribution over parameters in natural units.
        space: the map between the two.
    """

    natural: Any
    space: Space

    def sample(self, *, seed: jax.Array, sample_shape: int | tuple[int, ...]) -> Array:
        """Draws in inference space; NaN, and so in no support, where a log parameter was drawn that is not positive."""
        return self.space.to_inference(self.natural.sample(seed=seed, sample_shape=sample_shape))

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density over inference space."""
        return self.natural.log_prob(self.space.to_natural(theta)) + self.space.log_jacobian(theta)


def check_prior(prior: Any, dim: int) -> None:
    """Refuse what is no distribution over D parameters.

    Raises:
        ValueError: naming what came.
    """
    expected = f"prior: expected a distrax distribution over vectors of {dim} parameters"
    if not callable(getattr(prior, "sample", None)) or not callable(getattr(prior, "log_prob", None)):
        raise ValueError(f"{expected}, got {type(prior).__name__}")
    try:  # a distribution is foreign code: what it raises is reported in one line
        draws = jax.eval_shape(lambda key: prior.sample(seed=key, sample_shape=2), jax.random.key(0))
        density = jax.eval_shape(prior.log_prob, jax.ShapeDtypeStruct((2, dim), jnp.float32))
    except Exception as error:
        raise ValueError(f"{expected}, got {type(prior).__name__}: {str(error).splitlines()[0]}") from error
    if draws.shape != (2, dim) or density.shape != (2,):
        raise ValueError(
            f"{expected}, got draws of shape {list(draws.shape[1:])} with log-densities of shape "
            f"{list(density.shape[1:])} (distrax.Independent makes one distribution of several)"
        )


def prior_draws(key: jax.Array, prior: Any, support: Support, n: int) -> Float[Array, "n dim"]:
    """`n` draws of the prior inside the support: uniform for None, else by rejection.

    Args:
        key: consumed.
        prior: `Task.inference.prior`.
        support: in inference space.
        n: number of draws.
    """
    return support.sample(key, n) if prior is None else rejection_sample(key, _sampler(prior), support, n)


def prior_mass(prior: Any, support: Support) -> Float[Array, ""]:
    """The prior's mass in the support; 1 for None."""
    return jnp.ones(()) if prior is None else mass_inside(_sampler(prior), support)


def fingerprint(prior: Any, feasible: Support) -> list[float] | None:
    """The log-density of a prior at fixed points of a box; two priors are taken to be the same where it agrees."""
    if prior is None:
        return None
    unit = np.random.default_rng(0).uniform(size=(FINGERPRINT_POINTS, feasible.dim)).astype(np.float32)
    low, high = np.asarray(feasible.low), np.asarray(feasible.high)
    return np.asarray(prior.log_prob(jnp.asarray(low + unit * (high - low))), float).tolist()


def require_mass(prior: Any, support: Support, label: str) -> float:
    """The prior's mass in a support, which must not be next to nothing.

    Raises:
        ValueError: for a mass below `MIN_INSIDE`.
    """
    mass = float(_prior_mass(prior, support)) if prior is not None else 1.0
    if mass < MIN_INSIDE:
        raise ValueError(
            f"prior: expected some of its mass inside the support {label}, got {mass:.2g} of it ({MASS_DRAWS} draws): "
            "are both in the same units (Task's prior_space)?"
        )
    return mass


def _prior_mass(prior: Any, support: Support) -> Array:
    return jax.jit(single(functools.partial(prior_mass, prior)))(support)


def _sampler(prior: Any):
    return lambda key, n: prior.sample(seed=key, sample_shape=n)


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

    Its only support is called "tailed" and is Phi (or the hull of both, where the box is wider), so that no tail is cut
    at the box it is to reach beyond. With a single round all simulations are drawn from this prior, as its authors do;
    in a sequential run the first round's are. What is inferred is the posterior under this prior. The correction
    "paper", which divides by a Gaussian, refuses it.

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
