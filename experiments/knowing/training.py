"""Trainings of the study: all those of an environment in parallel, as one compiled program."""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.knowing.domains import OBJECTS
from experiments.knowing.slide import Slide
from jaxlfi.rl import ppo
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.randomisation import adr_training
from jaxlfi.rl.randomisation.adr import Adr
from jaxlfi.rl.settings import PPO

SETTINGS = PPO(
    learning_rate=1e-3,
    annealing=0.9,
    discount=1.0,
    initial_deviation=0.5,
    environments=32,
    unroll=20,
    segments=8,
    minibatches=4,
    epochs=8,
    total_steps=163_840,
    hidden=(32, 32),
    redrawn=True,
)
"""256 updates on an episode or more in each of 32 environments; the same for all arms."""
CHUNK = 32
"""Number of updates between two reports."""
RANDOMISING = Adr(low_threshold=-0.25, high_threshold=-0.1, buffer=16, step=0.05)
"""Settings of ADR; performance is the return, the negative distance from the mark in metres."""
PROBES = 64
"""Number of episodes at bounds after every eighth update."""
EVERY = 8
EPISODES = 128
"""Number of episodes in a policy's evaluation on an object; all policies get the same marks and noise."""


def train(env: Slide, pools: Float[np.ndarray, "runs pool 2"], seeds: Float[np.ndarray, " runs"]):
    """Networks of R trainings, each on its pool with its seed."""
    keys = jnp.stack([jax.random.key_data(jax.random.key(int(seed))) for seed in seeds])
    begin = jax.jit(jax.vmap(lambda key, pool: ppo.init(jax.random.wrap_key_data(key), env, SETTINGS, Domain(pool))))
    go_on = jax.jit(jax.vmap(lambda state: ppo.train(env, SETTINGS, state, CHUNK)))
    state, began = begin(keys, jnp.asarray(pools)), time.monotonic()
    for done in range(CHUNK, SETTINGS.updates + 1, CHUNK):
        state, made = go_on(state)
        print(
            f"{done} updates, {time.monotonic() - began:.0f} s, return {float(made.value[:, -1].mean()):.3f}",
            flush=True,
        )
    return state.params


def train_with_adr(env: Slide, seeds: Float[np.ndarray, " runs"]):
    """Networks of trainings under automatic domain randomisation, and their ranges in natural units [R, 2, D]."""
    keys = jnp.stack([jax.random.key_data(jax.random.key(int(seed))) for seed in seeds])
    one = lambda key: adr_training.train(
        jax.random.wrap_key_data(key), env, SETTINGS, RANDOMISING, jnp.asarray(env.nominal),
        SETTINGS.updates // EVERY, EVERY, PROBES,
    )  # fmt: skip
    training, ranges, _ = jax.jit(jax.vmap(one))(keys)
    return training.params, jnp.exp(jnp.stack([ranges.support.low, ranges.support.high], axis=1))


@functools.partial(jax.jit, static_argnums=(0, 1))
def fares(env: Slide, act_of: Callable, params, theta: Float[Array, "2"]) -> Float[Array, " episodes"]:
    """Returns of a policy on an object."""
    domain = Domain(jnp.broadcast_to(theta, (EPISODES, 2)))
    return evaluate(jax.random.key(7), env, act_of(params), domain).value


def returns(env: Slide, act_of: Callable, params) -> dict[str, Float[np.ndarray, "runs episodes"]]:
    """Returns of R policies on each object."""
    every = jax.vmap(lambda own, theta: fares(env, act_of, own, theta), in_axes=(0, None))
    return {name: np.asarray(every(params, jnp.asarray(theta))) for name, theta in OBJECTS.items()}


@functools.cache
def learnt(env: Slide) -> Callable:
    """The function from networks to a deterministic policy."""
    return functools.partial(ppo.deterministic, env, SETTINGS)


def constant(force: Float[Array, ""]) -> Callable:
    """A policy that always pushes with the same force."""
    return lambda observation: force[None]
