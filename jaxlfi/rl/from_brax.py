"""Wrapper for environments of Brax and MuJoCo Playground that sets theta in their model for every episode."""

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support, check_within
from jaxlfi.rl.environment import EnvState, Signals

MODELS = ("sys", "_mjx_model")
"""Attributes that hold an environment's model, in Brax and in MuJoCo Playground."""


class Inner(struct.PyTreeNode):
    """State of the environment, and the parameters of its episode.

    Attributes:
        state: state of the wrapped environment.
        theta: parameters in natural units, shape [D].
    """

    state: Any
    theta: Float[Array, "*batch dim"]


@dataclasses.dataclass(frozen=True, eq=False)
class FromBrax:
    """An environment for `jaxlfi.rl`; see `from_brax`, which makes it."""

    env: Any
    apply: Callable[[Any, Array], Any]
    model: str
    name: str
    space: Space
    units: tuple[str, ...]
    feasible: Support
    supports: Mapping[str, Support]
    nominal: tuple[float, ...]
    observations: Signals
    actions: Signals
    steps: int

    def reset(self, key: jax.Array, theta: Float[Array, " dim"]) -> EnvState:
        """The start of an episode with these parameters."""
        state = self._with(theta).reset(jax.random.key_data(key))
        no = jnp.asarray(False)
        return EnvState(Inner(state, theta), state.obs, jnp.asarray(0.0), no, no, {"failed": no})

    def step(self, state: EnvState, action: Float[Array, " act"]) -> EnvState:
        """One step. If the result is not finite, the episode ends without a reward, with its last observation."""
        after = self._with(state.inner.theta).step(state.inner.state, action)
        failed = ~(jnp.all(jnp.isfinite(after.obs)) & jnp.isfinite(after.reward))
        return EnvState(
            inner=Inner(after, state.inner.theta),
            observation=jnp.where(failed, state.observation, after.obs),
            reward=jnp.where(failed, 0.0, after.reward),
            terminated=(after.done > 0) & ~failed,
            truncated=failed,
            facts={"failed": failed},
        )

    def _with(self, theta: Float[Array, " dim"]) -> Any:
        """The environment with a model of these parameters; the original is unchanged."""
        env = copy.copy(self.env)
        setattr(env, self.model, self.apply(getattr(self.env, self.model), theta))
        return env


def from_brax(
    env: Any,
    apply: Callable[[Any, Array], Any],
    support: Support,
    names: Sequence[str],
    units: Sequence[str] | None = None,
    log: Sequence[str] = (),
    feasible: Support | None = None,
    nominal: Sequence[float] | None = None,
    observations: Signals | None = None,
    steps: int = 1000,
    name: str | None = None,
) -> FromBrax:
    """Wrap an environment of Brax or MuJoCo Playground so that policies can be trained on a belief about it.

    Args:
        env: environment that is not wrapped: neither vectorised nor reset automatically.
        apply: function from the environment's model (`env.sys` in Brax, `env.mjx_model` in Playground) and theta [D] in
            natural units to the model with these parameters.
        support: Theta_0, in natural units.
        names: names of the parameters.
        units: units of the parameters.
        log: names of the parameters that are inferred as logarithms.
        feasible: Phi; Theta_0 by default.
        nominal: the point theta; the centre of Theta_0 by default.
        observations: names and scaling of the observations; by default they are not scaled.
        steps: maximum length of an episode.
        name: name of the environment; by default that of its class.

    Raises:
        ValueError: for a wrapped environment, one without a model, observations that are not one vector, names, units,
            observations and bounds that do not match, a point outside Phi, and episodes without a step.

    Example:
        >>> from jaxlfi.rl import ppo
        >>> from brax import envs
        >>> def heavier(sys, theta):
        ...     inertia = sys.link.inertia
        ...     return sys.replace(link=sys.link.replace(inertia=inertia.replace(mass=theta[0] * inertia.mass)))
        >>> env = envs.get_environment("inverted_pendulum", backend="generalized")
        >>> pendulum = from_brax(env, heavier, Support([0.5], [2.0]), names=("mass",))
        >>> networks = ppo.policy_networks(pendulum, ppo.PPO())
    """
    if getattr(env, "unwrapped", env) is not env:
        raise ValueError(f"env: expected an environment that is not wrapped, got {type(env).__name__}")
    model = next((name for name in MODELS if getattr(env, name, None) is not None), None)
    if model is None:
        raise ValueError(f"env: expected an environment with a model ({', '.join(MODELS)}), got {type(env).__name__}")
    if not isinstance(env.observation_size, int | np.integer):
        raise ValueError(f"env: expected observations that are one vector, got {env.observation_size}")
    if len(names) != support.dim:
        raise ValueError(f"names: expected {support.dim}, one per parameter of the support, got {list(names)}")
    if unknown := [one for one in log if one not in names]:
        raise ValueError(f"log: expected names of parameters ({', '.join(names)}), got {', '.join(unknown)}")
    if units is not None and len(units) != len(names):
        raise ValueError(f"units: expected {len(names)}, one per parameter, got {list(units)}")
    if observations is not None and observations.size != env.observation_size:
        raise ValueError(
            f"observations: expected {env.observation_size}, as the environment has, got {observations.size}"
        )
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    feasible = support if feasible is None else feasible
    check_within(support, feasible)
    nominal = np.asarray(support.centre if nominal is None else nominal, float)
    if nominal.shape != (support.dim,) or not bool(feasible.contains(nominal)):
        raise ValueError(f"nominal: expected {support.dim} numbers within Phi, got {nominal.tolist()}")
    return FromBrax(
        env=env,
        apply=apply,
        model=model,
        name=name or type(env).__name__,
        space=Space(tuple(names), tuple(one in log for one in names)),
        units=tuple(units or [""] * len(names)),
        feasible=feasible,
        supports={"initial": support},
        nominal=tuple(map(float, nominal)),
        observations=observations or _plain("observation", int(env.observation_size)),
        actions=_plain("action", int(env.action_size)),
        steps=steps,
    )


def _plain(word: str, size: int) -> Signals:
    """Signals that are not scaled."""
    return Signals(tuple(f"{word} {i}" for i in range(size)), ("",) * size, (0.0,) * size, (1.0,) * size)
