"""Evaluation of policies on the points of a domain."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.rl.domains import Domain, Draw
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.policy import Policy, Unit, remembered


class Outcomes(struct.PyTreeNode):
    """One episode at each point of a domain.

    Attributes:
        value: returns, shape [N].
        steps: lengths, shape [N].
        failed: whether the episode ended because the simulation became unstable, shape [N].
        facts: facts that the environment reports about each episode and its end, each [N].
    """

    value: Float[Array, "*batch n"]
    steps: Int[Array, "*batch n"]
    failed: Bool[Array, "*batch n"]
    facts: dict[str, Array]


Numbers = Array | np.ndarray
Scaling = tuple[tuple[Numbers, Numbers], tuple[Numbers, Numbers]]
Layers = tuple[Sequence[Numbers], Sequence[Numbers], Scaling, Mapping[str, Numbers]]
"""Weights, biases, scaling and recurrent unit of a policy (`jaxlfi.rl.policy.Policy`); the unit is empty if there is
none. For several policies, each has a leading axis."""


def stacked(policies: Sequence[Policy]) -> Layers:
    """Policies of the same widths as one pytree.

    Raises:
        ValueError: for policies of different widths.
    """
    every = [layers_of(one) for one in policies]
    shapes = [jax.tree.map(np.shape, one) for one in every]
    if any(own != shapes[0] for own in shapes):
        raise ValueError("policies: expected networks of the same widths; evaluate others by themselves")
    return jax.tree.map(lambda *leaves: np.stack(leaves), *every)


def layers_of(policy: Policy) -> Layers:
    """The layers of a policy."""
    return policy.weights, policy.biases, policy.scaling, {} if policy.unit is None else policy.unit.arrays


def acting(layers: Layers) -> Callable[[Array], Array]:
    """A policy in JAX: a function from an observation [O] to an action [A], in their units."""
    weights, biases, ((seen_centre, seen_scale), (centre, scale)), unit = layers

    def act(observation: Float[Array, " obs"]) -> Float[Array, " act"]:
        layer = (observation - seen_centre) / seen_scale
        memory = layer[..., :0]
        if unit:
            layer = remembered(own := Unit(**unit), layer, jnp)
            memory = layer[..., -own.size :]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            layer = jnp.tanh(layer @ weight + bias)
        action = jnp.clip(layer @ weights[-1] + biases[-1], -1.0, 1.0)
        return centre + scale * jnp.concatenate([action, memory], axis=-1)

    return act


def evaluate(key: jax.Array, environment: Environment, act: Callable[[Array], Array], domain: Domain) -> Outcomes:
    """Run one episode at each point with one policy.

    Args:
        key: consumed.
        environment: environment to act in.
        act: function from an observation [O] in its units to an action [A] in its units, in JAX.
        domain: points to evaluate at.
    """

    def episode(key, theta):
        state = environment.reset(key, theta)
        none = Outcomes(jnp.asarray(0.0), jnp.asarray(0), jnp.asarray(False), dict(state.facts))

        def step(carry, _):
            state, last, over, before = carry
            after = environment.step(state, act(state.observation))
            now = Outcomes(before.value + after.reward, before.steps + 1, after.truncated, dict(after.facts))
            last, outcome = _unless(over, last, after), _unless(over, before, now)
            over |= after.terminated | after.truncated
            return (after, last, over, outcome), None

        first = state, _unless(jnp.asarray(False), state, state), jnp.asarray(False), none
        (_, last, _, outcome), _ = jax.lax.scan(step, first, length=environment.steps)
        more = getattr(environment, "concluded", lambda state: {})(last)
        return outcome.replace(facts=outcome.facts | dict(more))

    return jax.vmap(episode)(jax.random.split(key, len(domain.theta)), domain.theta)


def _unless(over: Bool[Array, ""], old: Any, new: Any) -> Any:
    """The new values, or the old ones if an episode is over. Keys are cloned: nothing is drawn after the end."""
    is_key = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.tree.map(lambda a, b: jax.random.clone(b) if is_key(b) else jnp.where(over, a, b), old, new)


def cross_evaluate(
    environment: Environment, policies: Mapping[str, Policy], draws: Mapping[str, Draw], episodes: int, seed: int = 0
) -> list[dict[str, Any]]:
    """Evaluate every policy on every domain, all policies on the same episodes.

    Args:
        environment: environment to act in.
        policies: policies by name, all of the same widths.
        draws: functions that draw the points of each domain, by the domain's name.
        episodes: number of episodes on each domain.
        seed: seed of the points and episodes.

    Returns:
        A row for each policy and domain: mean return, its standard error, and means of the environment's facts.

    Raises:
        ValueError: for policies of another environment (names, units) or of different widths, and for `episodes` or a
            `seed` out of range.
    """
    if not 1 <= episodes < 2**31:
        raise ValueError(f"episodes: expected a number from 1 to 2^31 - 1, got {episodes}")
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed: expected a number from 0 to 2^63 - 1, got {seed}")
    for policy in policies.values():
        policy.require(environment.name, environment.observations, environment.actions)
    layers = stacked(list(policies.values()))

    @jax.jit
    def fares(key: jax.Array, domain: Domain) -> Outcomes:
        return jax.vmap(lambda layers: evaluate(key, environment, acting(layers), domain))(layers)

    rows = []
    for name, draw in draws.items():
        key_points, key_episodes = jax.random.split(jax.random.key(seed))
        outcomes = jax.device_get(fares(key_episodes, draw(key_points, episodes)))
        for place, policy in enumerate(policies):
            value = outcomes.value[place]
            error = float(value.std(ddof=1) / episodes**0.5) if episodes > 1 else float("nan")
            facts = {fact: float(np.mean(values[place])) for fact, values in outcomes.facts.items()}
            rows.append({"policy": policy, "domain": name, "return": float(value.mean()), "error": error, **facts})
    return rows
