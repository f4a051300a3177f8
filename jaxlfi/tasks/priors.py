"""A task's own prior, and draws from it within a support."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.precision import single
from jaxlfi.distributions.region import region
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import MASS_DRAWS, mass_inside
from jaxlfi.tasks.equality import same

MIN_INSIDE = 0.01
"""Mass of a prior inside the support below which a run is refused: rejection sampling would reject nearly all draws."""
FINGERPRINT_POINTS = 8
"""Points at which priors are compared."""
ZERO_POINTS = 4096
"""Points that are searched for a place where a prior is zero."""
LOW_INSIDE = 0.1
"""Mass below which a run warns: at least 3 % of the draws are then picked from uniform ones by the prior's density."""


@dataclasses.dataclass(frozen=True, eq=False)
class InferencePrior:
    """A task's own prior as a distribution over inference space, zero wherever its density is not finite.

    Where they have no mass, some distributions return NaN, and others a density: those of TensorFlow Probability give
    the values that they can take by a bijector, which is used as well.

    Attributes:
        distribution: the task's own.
        space: the map from natural units to inference space if the distribution is over the former and the two differ;
            else None.
    """

    distribution: Any
    space: Space | None = None
    _values: Any = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "_values", _values_of(self.distribution))

    def sample(self, *, seed: jax.Array, sample_shape: int | tuple[int, ...]) -> Array:
        """Draws in inference space; NaN, which is in no support, where a log parameter is not positive."""
        draws = self.distribution.sample(seed=seed, sample_shape=sample_shape)
        return draws if self.space is None else self.space.to_inference(draws)

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density over inference space, -inf where there is none."""
        value = theta if self.space is None else self.space.to_natural(theta)
        log_prob = self.distribution.log_prob(value)
        if self.space is not None:
            log_prob = log_prob + self.space.log_jacobian(theta)
        possible = jnp.isfinite(log_prob)
        if self._values is not None:
            possible &= ~jnp.any(jnp.isnan(self._values.inverse(value)), axis=-1)
        return jnp.where(possible, log_prob, -jnp.inf)

    def __eq__(self, other: object) -> bool:
        """Whether both have the same contents."""
        if not isinstance(other, InferencePrior):
            return NotImplemented
        return self.space == other.space and same(self.distribution, other.distribution)

    def __hash__(self) -> int:
        return hash((type(self.distribution), self.space))


def _values_of(distribution: Any) -> Any:
    """TensorFlow Probability's bijector from the reals to the values that a distribution can take; None for others."""
    import distrax  # takes a second, which a task without a prior saves

    own = distribution.distribution if isinstance(distribution, distrax.Independent) else distribution
    make = getattr(own, "experimental_default_event_space_bijector", None)
    if make is None:
        return None
    try:  # foreign code, and not every distribution implements it
        with jax.ensure_compile_time_eval():  # it is cached, so it must not contain tracers
            bijector = make()
        one = jax.ShapeDtypeStruct((1, *distribution.event_shape), jnp.float32)
        return bijector if jax.eval_shape(bijector.inverse, one).shape == one.shape else None
    except Exception:
        return None


def prior_draws(key: jax.Array, prior: Any, support: Support, n: int) -> Float[Array, "n dim"]:
    """Draws of the prior in a support: uniform for None, else by rejection (`jaxlfi.distributions.region`)."""
    return region(support, prior).sample(key, n)


def prior_mass(prior: Any, support: Support) -> Float[Array, ""]:
    """The prior's mass in the support; 1 for None."""
    if prior is None:
        return jnp.ones(())
    return mass_inside(lambda key, n: prior.sample(seed=key, sample_shape=n), region(support, prior))


def fingerprint(prior: Any, feasible: Support) -> list[float] | None:
    """The log-density of a prior at fixed points of a box; two priors count as the same if it agrees."""
    if prior is None:
        return None
    unit = np.random.default_rng(0).uniform(size=(FINGERPRINT_POINTS, feasible.dim)).astype(np.float32)
    low, high = np.asarray(feasible.low), np.asarray(feasible.high)
    log_prob = np.asarray(prior.log_prob(jnp.asarray(low + unit * (high - low))), float)
    return np.where(np.isfinite(log_prob), log_prob, np.nan).tolist()


def is_bounded(prior: Any, feasible: Support) -> bool:
    """Whether a prior is zero at some of `ZERO_POINTS` places of a box."""
    if prior is None:
        return False
    return not bool(jnp.all(region(feasible, prior).contains(feasible.sample(jax.random.key(0), ZERO_POINTS))))


def require_mass(prior: Any, support: Support, label: str) -> float:
    """The prior's mass in a support, which must not be negligible.

    Raises:
        ValueError: for a mass below `MIN_INSIDE`.
    """
    mass = float(jax.jit(single(functools.partial(prior_mass, prior)))(support)) if prior is not None else 1.0
    if mass < MIN_INSIDE:
        raise ValueError(
            f"prior: expected some of its mass inside the support {label}, got {mass:.2g} of it ({MASS_DRAWS} draws): "
            "are both in the same units (Task's prior_space)?"
        )
    return mass
