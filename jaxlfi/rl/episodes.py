"""Episodes one after another, in many environments side by side, as Brax's `acting` steps them."""

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
        env: the episodes that go on, or have just begun.
        key: of each environment; its next episode is drawn with it, shape [N].
        steps: of each episode so far, shape [N].
        sums: of the rewards of each episode so far, shape [N].
        domain: theta of the environments.
        obs: as a policy sees them, and theta after that, where the value function sees it; shape [N, O] or [N, O + D].
        reward: of the last step, shape [N].
        done: whether the last step ended an episode, 0 or 1, shape [N].
        info: what Brax's loss asks for (`truncation`), and the episodes that ended (`ended`).
        theta: of each environment's episode, where the value function sees it, shape [N, D]; else None.
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
        done: whether one did; the other fields are of episodes still under way where it is false.
        value: its return, the sum of its rewards.
        steps: its length.
        facts: what its environment says of it.
    """

    done: Bool[Array, "*batch"]
    value: Float[Array, "*batch"]
    steps: Int[Array, "*batch"]
    facts: dict[str, Array]


class Batch:
    """N environments, each at its point of a domain; an episode that ends is followed by a new one in the same step.

    Every episode begins with its own keys: nuisances and first states are redrawn, and nothing of the last episode is
    left. Where domains are `redrawn`, so is theta, from all points of the domain; otherwise environment i stays with
    the domain's i-th point.

    The end of an episode by its time limit is a termination: no reward follows it. Brax would leave the last step out
    of what is learnt if it were a truncation. What is truncated is a failed simulation, of which nothing can be learnt.
    """

    def __init__(self, environment: Environment, n: int, redrawn: bool = False, privileged: bool = False):
        """N environments.

        Args:
            environment: for one episode.
            n: how many.
            redrawn: whether theta is redrawn for every episode.
            privileged: whether theta is added to what is observed, for the value function.
        """
        self.environment, self.n, self.redrawn, self.privileged = environment, n, redrawn, privileged

    def reset(self, key: jax.Array, domain: Domain) -> Episodes:
        """The first episodes.

        Raises:
            ValueError: for another number of points than environments, unless they are redrawn.
        """
        if not self.redrawn and len(domain.theta) != self.n:
            raise ValueError(f"domain: expected {self.n} points, one an environment, got {len(domain.theta)}")
        keys, env, theta = self._begin(jax.random.split(key, self.n), domain)
        zeros = jnp.zeros(self.n)
        info = {"truncation": zeros, "ended": _ended(env, jnp.zeros(self.n, bool), zeros, jnp.zeros(self.n, int))}
        observed = self._observed(env.observation, theta)
        return Episodes(env, keys, jnp.zeros(self.n, int), zeros, domain, observed, zeros, zeros, info, theta)

    def step(self, state: Episodes, action: Float[Array, "n act"]) -> Episodes:
        """One step of all, by actions as a policy gives them; they are limited to [-1, 1]."""
        scaled = self.environment.actions.from_unit(jnp.clip(action, -1.0, 1.0))
        env = jax.vmap(self.environment.step)(state.env, scaled)
        steps, sums = state.steps + 1, state.sums + env.reward
        truncated = env.truncated
        terminated = (env.terminated | (steps >= self.environment.steps)) & ~truncated
        done = terminated | truncated
        info = {"truncation": truncated.astype(jnp.float32), "ended": _ended(env, done, sums, steps)}

        # Keys move on with every step, so that none is used twice.
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
        """What the networks see."""
        seen = self.environment.observations.to_unit(observation)
        return jnp.concatenate([seen, standardised(self.environment, theta)], axis=-1) if self.privileged else seen

    def _begin(self, keys: jax.Array, domain: Domain) -> tuple[jax.Array, EnvState, Any]:
        """The environments' next keys, an episode of each, and its theta, where that is seen."""

        def one(key, index):
            following, key_theta, key_reset = jax.random.split(key, 3)
            if self.redrawn:
                index = jax.random.randint(key_theta, (), 0, len(domain.theta))
            theta = domain.theta[index]
            return following, self.environment.reset(key_reset, theta), theta if self.privileged else None

        return jax.vmap(one)(keys, jnp.arange(self.n))


def _ended(env: EnvState, done: Array, sums: Array, steps: Array) -> Ended:
    return Ended(done, sums, steps, dict(env.facts))
