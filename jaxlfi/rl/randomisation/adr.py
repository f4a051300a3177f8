"""Automatic domain randomisation: ranges widen where the policy succeeds at their bounds, and narrow where it fails.

OpenAI et al., "Solving Rubik's Cube with a Robot Hand" (2019), section 5 and Algorithm 1. Training starts at one point.
Some episodes are probes: one parameter is at a bound of its range, and the others are drawn from theirs. After
`buffer` probes of a bound, their mean performance decides whether the bound moves out, moves in, or stays.

    ranges = adr.init(start, feasible)
    domain = adr.domain(key, ranges, space, n)              # the policy's training domain
    probes = adr.probes(key, ranges, n)                     # episodes to evaluate it in
    ranges = adr.recorded(settings, ranges, probes, performances)

Bounds stay inside the box Phi and never cross the point at which training started. Both restrictions are ours; the
paper's ranges have physical limits only.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.fields import Checked, hyperparameter
from jaxlfi.rl.domains import Domain

Number = Float[Array, "*batch"] | float


class Adr(Checked):
    """Hyperparameters of automatic domain randomisation; thresholds are in units of the performance."""

    low_threshold: Number = hyperparameter(
        default=0.0, help="mean performance at a bound at or below which it moves in", symbol="t_L"
    )
    high_threshold: Number = hyperparameter(
        default=1.0, help="mean performance at a bound at or above which it moves out", symbol="t_H"
    )
    step: Number = hyperparameter(
        default=0.05, help="how far a bound moves, as a fraction of the width of Phi", symbol="Delta", above=0, high=1
    )
    buffer: Number = hyperparameter(default=16, help="number of probes by which a bound is judged", symbol="m", low=1)


class Ranges(struct.PyTreeNode):
    """The ranges of the parameters, and the statistics of the policy's performance at their bounds.

    Attributes:
        support: the ranges phi_L and phi_H, in inference space, bounds [D].
        start: the point at which training started, shape [D].
        feasible: Phi, in inference space, bounds [D].
        sums: sums of performances at the lower and the upper bounds since each was last judged, shape [2, D].
        counts: numbers of these performances, shape [2, D].
    """

    support: Support
    start: Float[Array, " dim"]
    feasible: Support
    sums: Float[Array, "2 dim"]
    counts: Int[Array, "2 dim"]


class Probe(struct.PyTreeNode):
    """An episode at a bound.

    Attributes:
        theta: the episode's parameters lambda, in inference space, shape [D].
        parameter: index i of the parameter at a bound.
        upper: 1 for its upper bound, 0 for its lower bound.
    """

    theta: Float[Array, "*n dim"]
    parameter: Int[Array, "*n"]
    upper: Int[Array, "*n"]


def init(start: Float[Array, " dim"], feasible: Support) -> Ranges:
    """Ranges of zero width around a point.

    Args:
        start: a calibrated point, in inference space, shape [D].
        feasible: Phi, in inference space.
    """
    start = jnp.asarray(start, jnp.float32)
    none = jnp.zeros((2, len(start)))
    return Ranges(Support(start, start), start, feasible, none, none.astype(int))


def domain(key: jax.Array, ranges: Ranges, space: Space, n: int) -> Domain:
    """`n` points to train on: uniform over the ranges, in natural units."""
    return Domain(space.to_natural(ranges.support.sample(key, n)))


def probes(key: jax.Array, ranges: Ranges, n: int) -> Probe:
    """`n` probes, each of a parameter and a bound drawn uniformly; the other parameters are drawn from their ranges."""
    key_theta, key_parameter, key_upper = jax.random.split(key, 3)
    dim = ranges.support.dim
    parameter = jax.random.randint(key_parameter, (n,), 0, dim)
    upper = jax.random.bernoulli(key_upper, shape=(n,)).astype(int)
    bound = jnp.where(upper == 1, ranges.support.high[parameter], ranges.support.low[parameter])
    at = jnp.arange(dim) == parameter[:, None]
    return Probe(jnp.where(at, bound[:, None], ranges.support.sample(key_theta, n)), parameter, upper)


def recorded(settings: Adr, ranges: Ranges, probes: Probe, performances: Float[Array, " n"]) -> Ranges:
    """The ranges after probes, which are processed one after another.

    Args:
        settings: hyperparameters.
        ranges: the ranges before the probes.
        probes: N probes, drawn from these ranges.
        performances: the policy's performance in each, such as its return, shape [N].
    """
    far, start, width = ranges.feasible, ranges.start, ranges.feasible.width

    def one(ranges: Ranges, given: tuple[Probe, Array]) -> tuple[Ranges, None]:
        probe, performance = given
        place = (probe.upper, probe.parameter)
        sums, counts = ranges.sums.at[place].add(performance), ranges.counts.at[place].add(1)
        full, mean = counts >= settings.buffer, sums / jnp.maximum(counts, 1)
        outwards = jnp.where(mean >= settings.high_threshold, 1.0, jnp.where(mean <= settings.low_threshold, -1.0, 0.0))
        lower, upper = jnp.where(full, outwards, 0.0) * settings.step * width
        support = Support(
            jnp.clip(ranges.support.low - lower, far.low, start), jnp.clip(ranges.support.high + upper, start, far.high)
        )
        return ranges.replace(support=support, sums=jnp.where(full, 0.0, sums), counts=jnp.where(full, 0, counts)), None

    return jax.lax.scan(one, ranges, (probes, performances))[0]


def entropy(ranges: Ranges) -> Float[Array, ""]:
    """The entropy of the ranges in nats per parameter, (1/D) sum log(phi_H - phi_L): -inf at the start."""
    return jnp.mean(jnp.log(ranges.support.width))
