"""Open-loop baselines: the constant action that is best on Theta_0 in simulation, and plans."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.policies.simulation import perform
from experiments.policies.study import FEM, Study
from jaxlfi.envs.whip import planner, rules
from jaxlfi.envs.whip.environment import WhipEnvironment
from jaxlfi.envs.whip.parameters import MEDIAN, MILLIMETRES, median
from jaxlfi.io import files, provenance
from jaxlfi.rl import domains

OWN = {f"plan-{dlo}": f"{dlo}-mean" for dlo in FEM}
"""Plans for an object's posterior mean."""
NAMES = ("constant", "plan-median", *OWN)
"""The best constant action, and plans for the median DLO and for the posterior mean of each object."""
STEPS = 9
"""Number of constant actions tried along each axis."""
TRIED, AGAIN = 32, 128
"""Number of episodes of each constant action, and of each of the best few in a second comparison."""
FEW = 8


def search(study: Study, environment: WhipEnvironment, name: str) -> Path:
    """Find a baseline's actions [16, 2]; existing ones are kept."""
    path = study.actions(name)
    if not path.exists():
        print(f"\n== actions: {name}", flush=True)
        arrays = constant(environment) if name == "constant" else plan(study, environment, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_json(path.with_suffix(".json"), {"name": name, **provenance.environment()})
        files.write_arrays(path, arrays)
    return path


def constant(environment: WhipEnvironment, tried: int = TRIED, again: int = AGAIN) -> dict[str, np.ndarray]:
    """The best of a grid of constant actions, by its mean return on points of Theta_0, in simulation.

    Args:
        environment: environment to act in.
        tried: number of episodes of each action.
        again: number of episodes of each of the best few in a second comparison.
    """
    axis = np.linspace(-rules.ACTION_LIMIT, rules.ACTION_LIMIT, STEPS)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float32)
    support = environment.supports["initial"]

    def returns(seed: int, actions: np.ndarray, n: int) -> np.ndarray:
        key_points, key_episodes = jax.random.split(jax.random.key(seed))
        theta = domains.uniform(key_points, support, n).theta

        @jax.jit
        def all_of(actions):
            one = lambda action: perform(key_episodes, environment, lambda *_: action, theta).value.mean()
            return jax.vmap(one)(actions)

        return np.concatenate([all_of(jnp.asarray(part)) for part in np.split(actions, len(actions) // STEPS or 1)])

    value = returns(0, grid, tried)
    best = grid[np.argsort(value)[-FEW:]]
    best_value = returns(1, best, again)
    chosen = best[np.argmax(best_value)]
    return {
        "actions": np.tile(chosen, (rules.STEPS, 1)),
        "value": best_value.max(),
        "grid": grid,
        "grid_value": value,
    }


def plan(study: Study, environment: WhipEnvironment, name: str) -> dict[str, np.ndarray]:
    """The plan of the cross-entropy method for a known DLO, whose nuisances are those of mu."""
    theta = study.point(OWN[name]) if name in OWN else (MEDIAN.length * MILLIMETRES[0], MEDIAN.young)
    engine = environment.whip.engine
    scene = median(*(np.asarray(theta) / MILLIMETRES))
    found = jax.device_get(jax.jit(lambda key: planner.plan(key, engine, scene))(jax.random.key(0)))
    return {"actions": found.actions, "value": found.value, "theta": np.asarray(theta)}
