"""Policies of the study: their trainings, and their episodes on the objects, with baselines that learn nothing."""

import functools
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments import chance
from experiments.policies import actions
from experiments.settled import domains
from experiments.settled.domains import OBJECTS
from jaxlfi.io import files
from jaxlfi.registry import ENVIRONMENTS
from jaxlfi.rl import training
from jaxlfi.rl.domains import Domain, Draw
from jaxlfi.rl.evaluation import Outcomes, acting, evaluate, layers_of
from jaxlfi.rl.policy import Policy, load
from jaxlfi.rl.settings import PPO, QUICK

SETTINGS: PPO = QUICK.replace(total_steps=20_000)
"""Settings of all trainings: `quick`, shorter."""
SEEDS = 3
"""Number of trainings of an arm that is the same on all objects."""
PLACES = 16
"""Number of episodes of a policy on an object; stack, camera and other nuisances are the same for all policies."""
TRIED, AGAIN = 16, 64
"""Number of episodes of each constant action, and of each of the best few in a second comparison."""
KEPT = ("value", "steps", "hit", "clean_hit", "outside", "failed", "settled_hit", "settled_clean", "displaced")
"""Values that are kept of an episode."""
LEARNING = ("/curve", "/trained")
"""Arrays that are kept of learning, for each arm."""
Played = dict[str, np.ndarray]
"""Values of each episode, shape [seeds, places], by arm, object and name, as ARM/OBJECT/NAME."""


WHIP = "whip,reward=settled"
"""The whipping task, rewarded once the scene has settled."""
WITH_HISTORY = "jaxlfi.envs.whip.environment:with_history,history=6,reward=settled"
"""The same task, for policies that see the last six observations and five actions."""


def reference(arm: str) -> str:
    """The environment of an arm's policies, as named by `jaxlfi train`."""
    return WITH_HISTORY if arm == "history" else WHIP


@functools.cache
def environment(name: str = WHIP) -> Any:
    """The environment of a reference."""
    return ENVIRONMENTS.load(name)


def learn(folder: Path, name: str, draws: Mapping[str, Draw], seeds: tuple[int, ...], settings: PPO) -> None:
    """Train policies in parallel; interrupted trainings are continued, and finished ones kept.

    Args:
        folder: folder of the trainings.
        name: name of the environment.
        draws: functions that draw the points of each domain.
        seeds: seeds of the trainings of each domain.
        settings: settings of PPO.

    Raises:
        ValueError: if the folder has other trainings.
    """
    if not (folder / "config.json").exists():
        plan = training.Plan(name, environment(name), settings, None, draws, seeds)
        training.begin(plan, folder)
    there = trained(folder), training.settings_of(training.read_config(folder))
    if there != ([name for name in draws for _ in seeds], settings):
        raise ValueError(f"{folder}: expected trainings with these domains, seeds and settings: remove it")
    if not training.finished(folder):
        training.resumed(folder, environment(name), functools.partial(_report, folder.name, settings))


def _report(name: str, settings: PPO, updates: int, curves: Mapping[str, np.ndarray]) -> None:
    value, seconds = curves["value"], curves["seconds"][:, 0].sum()
    did = f"{len(value)} of {settings.updates} updates in {seconds:.0f} s"
    print(f"{name}: {did}, return {np.nanmean(value[-updates:]):.2f}", flush=True)


def trained(folder: Path) -> list[str]:
    """Domains of the trainings in a folder, one per training."""
    return [one["domain"] for one in training.read_config(folder)["trainings"]]


def policies(folder: Path, domain: str) -> list[Policy]:
    """The policies of a domain, in the order of their seeds, from a folder of trainings or one of several such."""
    paths = folder.rglob(f"{domain}/seed_*/policy.npz")
    return [load(path) for path in sorted(paths, key=lambda path: path.parent.name)]


@functools.cache
def _deployed(name: str):
    """The compiled function from the layers of a policy for each object to its episodes there."""

    def one(layers, theta):
        return evaluate(places(), environment(name), acting(layers), Domain(jnp.broadcast_to(theta, (PLACES, 2))))

    return jax.jit(jax.vmap(one))


def places() -> Array:
    """The key of the places; the same for every policy on every object."""
    return jax.random.key(7)


def deployed(own: Sequence[Policy], name: str = WHIP) -> Outcomes:
    """Episodes [objects, places] of a policy for each object, on that object, in an environment."""
    layers = jax.tree.map(lambda *leaves: np.stack(leaves), *map(layers_of, own))
    return jax.device_get(_deployed(name)(layers, jnp.asarray(domains.truths(), jnp.float32)))


def played(arm: str, seeds: Sequence[Outcomes]) -> Played:
    """Episodes of an arm by name, from those of each seed."""
    found = {}
    for place, name in enumerate(OBJECTS):
        for what in KEPT:
            value = [np.asarray(getattr(one, what, None) if what in vars(one) else one.facts[what]) for one in seeds]
            found[f"{arm}/{name}/{what}"] = np.stack([of_all[place] for of_all in value])
    return found


def arm(folder: Path, name: str) -> Played:
    """Episodes of the policies of an arm, from the folder of its trainings."""
    if name in domains.BROAD:
        own = [policies(folder, name)] * len(OBJECTS)
    else:
        own = [policies(folder, f"{name}-{dlo}") for dlo in OBJECTS]
    return played(name, [deployed(of_seed, reference(name)) for of_seed in zip(*own, strict=True)])


def learning(folder: Path, name: str) -> Played:
    """Learning curves and training points (mm, Pa) of an arm's policies, from the folder of its trainings."""
    own = [place for place, one in enumerate(trained(folder)) if one.split("-")[0] == name]
    curves = files.read_arrays(folder / "curves.npz")["value"][:, own].astype(np.float32)
    return {f"{name}/curve": curves, f"{name}/trained": files.read_sealed(folder / "domains.npz")["trained"][own]}


def floors() -> Played:
    """Episodes of the constant action that is best on Theta_0, and of random actions."""
    env = environment()
    chosen = actions.constant(env, TRIED, AGAIN)["actions"][0]
    found = played("constant", [deployed([constant(chosen)] * len(OBJECTS))])
    keys = jax.random.split(jax.random.key(8), SEEDS)
    everywhere = jnp.asarray(domains.truths(), jnp.float32)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def random(key, theta):
        return evaluate(places(), env, chance.policy(env.actions, key), Domain(jnp.broadcast_to(theta, (PLACES, 2))))

    return found | played("random", [jax.device_get(random(jax.random.key_data(key), everywhere)) for key in keys])


def constant(action: Float[np.ndarray, "2"]) -> Policy:
    """A policy with a constant action: a network of the same shape as all others, with zero weights."""
    env = environment()
    widths = (env.observations.size, *SETTINGS.hidden, env.actions.size)
    weights = tuple(np.zeros(pair, np.float32) for pair in itertools.pairwise(widths))
    last = np.asarray(env.actions.to_unit(action), np.float32)
    biases = (*(np.zeros(width, np.float32) for width in SETTINGS.hidden), last)
    schema = {"environment": env.name, "observations": vars(env.observations), "actions": vars(env.actions)}
    return Policy(weights, biases, schema)
