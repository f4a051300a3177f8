"""Domains: the parameters of the environments that a policy is trained on (section VI-H)."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.region import region
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support, check_within
from jaxlfi.distributions.truncation import rejection_sample
from jaxlfi.rl.environment import Environment
from jaxlfi.runs.run import Run

POOL = 4096
"""Number of points of a domain from which theta is redrawn for every episode."""
ROUNDING = 1e-5
"""Relative difference up to which bounds count as equal: exp(ln x) in single precision errs by some 1e-7 ln x."""


class Domain(struct.PyTreeNode):
    """Points theta in natural units, one for each environment of a training or evaluation.

    Attributes:
        theta: the points, shape [N, D].
    """

    theta: Float[Array, "*batch n dim"]


Draw = Callable[[jax.Array, int], Domain]
"""Function that draws a domain with a given number of points from a key."""


def of_belief(key: jax.Array, belief: Belief, space: Space, limits: Support, n: int, prior: Any = None) -> Domain:
    """Low-variance draws from a posterior's mixture, clipped to a box (section VI-H).

    With a prior, draws that are clipped to where it is zero are drawn again, and from the prior if that fails.

    Args:
        key: consumed.
        belief: posterior in inference space.
        space: parameter space, which converts draws to natural units.
        limits: box in natural units: Phi, or Theta_0 for a posterior on a fixed support.
        n: number of points.
        prior: prior of the task over inference space (`Task.inference.prior`), or None.
    """
    draws = belief.mixture.low_variance_sample(key, n)
    if prior is not None:
        box = space.box_to_inference(limits)
        sample = lambda key, n: box.clip(belief.mixture.sample(key, n))
        again = rejection_sample(jax.random.fold_in(jax.random.clone(key), 1), sample, region(box, prior), n)
        draws = jnp.where(region(box, prior).contains(box.clip(draws))[:, None], box.clip(draws), again)
    return Domain(limits.clip(space.to_natural(draws)))


def of_run(run: Run) -> Draw:
    """The function that draws a domain from the posterior of a run."""
    prior = None if run.task is None else run.task.inference.prior
    return lambda key, n: of_belief(key, run.belief, run.space, limits_of(run), n, prior)


def limits_of(run: Run) -> Support:
    """The box that draws from a run's posterior are clipped to, in natural units: Phi, or the fixed support."""
    return run.space.box_to_natural(run.feasible if run.heuristic.grows else run.support)


def uniform(key: jax.Array, support: Support, n: int) -> Domain:
    """Uniform draws over a box in natural units: PPO-U."""
    return Domain(support.sample(key, n))


def point(theta: Float[Array | np.ndarray, " dim"], n: int) -> Domain:
    """The same point for all environments, in natural units: PPO-mu."""
    return Domain(jnp.broadcast_to(jnp.asarray(theta, jnp.float32), (n, len(theta))))


def standardised(environment: Environment, theta: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Theta as a network sees it: in inference space, -1 to 1 from one end of Phi to the other."""
    box = environment.space.box_to_inference(environment.feasible)
    half = (box.high - box.low) / 2
    return (environment.space.to_inference(theta) - box.centre) / jnp.where(half > 0, half, 1.0)


def check_belief(environment: Environment, space: Space, feasible: Support, units: Sequence[str] | None = None) -> None:
    """Refuse a posterior over other parameters than the environment's.

    Args:
        environment: environment to train in.
        space: parameter space of the posterior.
        feasible: its Phi, in natural units.
        units: units of its parameters; "" for a parameter without one, or without a declared one; None if they are not
            known.

    Raises:
        ValueError: for other names or units, or a Phi that exceeds the environment's.
    """
    if space.names != environment.space.names:
        raise ValueError(
            f"domain: expected a posterior of {', '.join(environment.space.names)}, the parameters of "
            f"{environment.name}, got one of {', '.join(space.names)}"
        )
    pairs = zip(units or environment.units, environment.units, strict=True)
    if any(own and other and own != other for own, other in pairs):
        raise ValueError(
            f"domain: expected a posterior in units {list(environment.units)}, those of {environment.name}, "
            f"got one in {list(units or ())}"
        )
    # A bound inferred as a logarithm comes back rounded.
    own, known = (np.asarray([box.low, box.high], float) for box in (feasible, environment.feasible))
    same = np.isclose(own, known, rtol=ROUNDING, atol=0)
    check_within(Support(*np.where(same, known, own)), environment.feasible, "domain")


def check_point(environment: Environment, theta: Float[np.ndarray, " dim"]) -> np.ndarray:
    """Refuse a point that is not in Phi.

    Raises:
        ValueError: naming the parameter and its range.
    """
    theta = np.asarray(theta, np.float32)
    if theta.shape != (environment.space.dim,):
        raise ValueError(
            f"domain: expected {environment.space.dim} numbers ({', '.join(environment.space.names)}), "
            f"got {theta.tolist()}"
        )
    for name, value, low, high in zip(
        environment.space.names, theta, environment.feasible.low, environment.feasible.high, strict=True
    ):
        if not low <= value <= high:
            raise ValueError(f"domain: expected {name} between {float(low):g} and {float(high):g} (Phi), got {value:g}")
    return theta
