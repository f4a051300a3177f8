"""PPO under automatic domain randomisation: updates on the ranges alternate with probes of their bounds."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.rl import ppo
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.randomisation import adr
from jaxlfi.rl.randomisation.adr import Adr, Ranges
from jaxlfi.rl.settings import PPO

POOL = 512
"""Number of points drawn from the ranges for the episodes of a round."""


class Round(struct.PyTreeNode):
    """Results of a round.

    Attributes:
        support: the ranges after the round, in inference space, bounds [D].
        value: mean return of its last update's episodes.
    """

    support: Support
    value: Float[Array, "*rounds"]


def train(
    key: jax.Array,
    environment: Environment,
    settings: PPO,
    randomising: Adr,
    start: Float[Array, " dim"],
    rounds: int,
    updates: int,
    probes: int,
) -> tuple[ppo.Training, Ranges, Round]:
    """Train new networks, with ranges that begin as a point.

    A policy's performance is its return with deterministic actions.

    Args:
        key: consumed.
        environment: the environment.
        settings: settings of PPO, with `redrawn`, as ranges change during episodes.
        randomising: hyperparameters of the ranges.
        start: the point, in natural units, shape [D].
        rounds: number of rounds, each with probes of the bounds.
        updates: number of PPO updates in a round.
        probes: number of probes in a round.

    Returns:
        The training and the ranges at the end, and the results of each round, along a leading axis.

    Raises:
        ValueError: for settings that do not redraw theta for every episode.
    """
    if not settings.redrawn:
        raise ValueError("redrawn: expected True, as the ranges change while environments run; got False")
    space = environment.space
    key_start, key_first, key_rounds = jax.random.split(key, 3)
    ranges = adr.init(space.to_inference(jnp.asarray(start)), space.box_to_inference(environment.feasible))
    first = ppo.init(key_start, environment, settings, adr.domain(key_first, ranges, space, POOL))

    def one(carry, key):
        training, ranges = carry
        key_domain, key_probes, key_episodes = jax.random.split(key, 3)
        episodes = training.episodes.replace(domain=adr.domain(key_domain, ranges, space, POOL))
        training, made = ppo.train(environment, settings, training.replace(episodes=episodes), updates)
        drawn = adr.probes(key_probes, ranges, probes)
        act = ppo.deterministic(environment, settings, training.params)
        outcomes = evaluate(key_episodes, environment, act, Domain(space.to_natural(drawn.theta)))
        ranges = adr.recorded(randomising, ranges, drawn, outcomes.value)
        return (training, ranges), Round(ranges.support, made.value[-1])

    (training, ranges), made = jax.lax.scan(one, (first, ranges), jax.random.split(key_rounds, rounds))
    return training, ranges, made
