"""Successive episodes in many parallel environments, as Brax's `acting` steps them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.rl.domains import Domain, standardised
from jaxlfi.rl.environment import Environment, EnvState


class Episodes(struct.PyTreeNode):
    """N environments between two steps; its fields `obs`, `reward`, `done` and `info` are those of Brax's states.

    Attributes:
        env: states of the current episodes, some of which have just begun.
        key: random key of each environment, from which its next episode is drawn, shape [N].
        steps: number of steps of each episode so far, shape [N].
        sums: sum of the rewards of each episode so far, shape [N].
        domain: points theta of the environments.
        obs: scaled observations, followed by theta if the value function sees it, shape [N, O] or [N, O + D].
        reward: reward of the last step, shape [N].
        done: whether the last step ended an episode, 0 or 1, shape [N].
        info: what Brax's loss needs (`truncation`), and the episodes that ended (`ended`).
        theta: parameters of each current episode if the value function sees them, shape [N, D]; else None.
    """

    env: EnvState
    key: jax.Array
    steps: Int[Array, "*batch"]
    sums: Float[Array, "*batch"]
    domain: Domain
    obs: Float[Array, "*batch obs"]
    reward: Float[Array, "*batch"]
    done: Float[Array, "*batch"]
    info: dict[str, Any]
    theta: Any = None


class Ended(struct.PyTreeNode):
    """Episodes that ended in a step.

    Attributes:
        done: whether an episode ended; if not, the other fields describe one still under way.
        value: return of the episode, the sum of its rewards.
        steps: length of the episode.
        facts: facts that the environment reports about it.
    """

    done: Bool[Array, "*batch"]
    value: Float[Array, "*batch"]
    steps: Int[Array, "*batch"]
    facts: dict[str, Array]


class Batch:
    """N environments, each at its point of a domain; an episode that ends is followed by a new one in the same step.

    Every episode has its own keys: nuisances and initial states are redrawn, and nothing carries over from the last
    episode. With `redrawn`, theta is redrawn as well, from all points of the domain; otherwise environment i keeps the
    domain's i-th point.

    An episode that reaches its time limit is terminated: no reward follows, and Brax does not learn from the last step
    of a truncated episode. Only failed simulations, from which nothing can be learnt, are truncated.
    """

    def __init__(self, environment: Environment, n: int, redrawn: bool = False, privileged: bool = False):
        """Make N environments.

        Args:
            environment: environment, which runs one episode at a time.
            n: number of environments.
            redrawn: whether theta is redrawn for every episode.
            privileged: whether theta is added to the observations, for the value function.
        """
        self.environment, self.n, self.redrawn, self.privileged = environment, n, redrawn, privileged

    def reset(self, key: jax.Array, domain: Domain) -> Episodes:
        """The first episodes.

        Raises:
            ValueError: for another number of points than of environments, unless theta is redrawn.
        """
        if not self.redrawn and len(domain.theta) != self.n:
            raise ValueError(f"domain: expected {self.n} points, one an environment, got {len(domain.theta)}")
        keys, env, theta = self._begin(jax.random.split(key, self.n), domain)
        zeros = jnp.zeros(self.n)
        info = {"truncation": zeros, "ended": _ended(env, jnp.zeros(self.n, bool), zeros, jnp.zeros(self.n, int))}
        observed = self._observed(env.observation, theta)
        return Episodes(env, keys, jnp.zeros(self.n, int), zeros, domain, observed, zeros, zeros, info, theta)

    def step(self, state: Episodes, action: Float[Array, "n act"]) -> Episodes:
        """One step of all environments with scaled actions, which are limited to [-1, 1]."""
        scaled = self.environment.actions.from_unit(jnp.clip(action, -1.0, 1.0))
        env = jax.vmap(self.environment.step)(state.env, scaled)
        steps, sums = state.steps + 1, state.sums + env.reward
        truncated = env.truncated
        terminated = (env.terminated | (steps >= self.environment.steps)) & ~truncated
        done = terminated | truncated
        info = {"truncation": truncated.astype(jnp.float32), "ended": _ended(env, done, sums, steps)}

        # Keys advance with every step, so that none is used twice.
        next_keys, fresh, theta = self._begin(state.key, state.domain)
        choose: Callable[[Any, Any], Any] = lambda new, old: jax.vmap(jnp.where)(done, new, old)
        theta = jax.tree.map(choose, theta, state.theta)
        return Episodes(
            env=jax.tree.map(choose, fresh, env),
            key=next_keys,
            steps=jnp.where(done, 0, steps),
            sums=jnp.where(done, 0.0, sums),
            domain=state.domain,
            obs=self._observed(choose(fresh.observation, env.observation), theta),
            reward=env.reward,
            done=done.astype(jnp.float32),
            info=info,
            theta=theta,
        )

    def _observed(self, observation: Float[Array, "n obs"], theta: Any) -> Float[Array, "n seen"]:
        """Inputs of the networks."""
        seen = self.environment.observations.to_unit(observation)
        return jnp.concatenate([seen, standardised(self.environment, theta)], axis=-1) if self.privileged else seen

    def _begin(self, keys: jax.Array, domain: Domain) -> tuple[jax.Array, EnvState, Any]:
        """The environments' next keys, a new episode of each, and its theta if the value function sees it."""

        def one(key, index):
            following, key_theta, key_reset = jax.random.split(key, 3)
            if self.redrawn:
                index = jax.random.randint(key_theta, (), 0, len(domain.theta))
            theta = domain.theta[index]
            return following, self.environment.reset(key_reset, theta), theta if self.privileged else None

        return jax.vmap(one)(keys, jnp.arange(self.n))


def _ended(env: EnvState, done: Array, sums: Array, steps: Array) -> Ended:
    return Ended(done, sums, steps, dict(env.facts))
