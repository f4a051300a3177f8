"""Simulations of whole scenes: random episodes over all parameters, the stack at rest, and the speed."""

import functools
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.parameters import FEASIBLE, WhipParameters, randomised
from jaxlfi.envs.whip.physics.engine import Engine, State, reset, rollout
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.scene import CUBES
from jaxlfi.envs.whip.rig import SECTION, START

BATCH = 100
"""Number of scenes that are simulated together."""


def random_scene(key: jax.Array) -> WhipParameters:
    """A DLO from all of Phi, its length uniform and its modulus log-uniform, and every nuisance from its range."""
    key_length, key_young, key_rest = jax.random.split(key, 3)
    (shortest, softest), (longest, stiffest) = FEASIBLE.low, FEASIBLE.high
    length = jax.random.uniform(key_length, minval=shortest, maxval=longest)
    young = jnp.exp(jax.random.uniform(key_young, minval=jnp.log(softest), maxval=jnp.log(stiffest)))
    return randomised(key_rest, length, young)


def random_targets(key: jax.Array, saturated: Array | bool) -> Float[Array, "16 2"]:
    """Set-points of an episode of random actions, clipped to the workspace.

    Args:
        key: key of the episode.
        saturated: whether actions are at their limits, like those of many learnt policies; otherwise they are uniform.
    """
    actions = jax.random.uniform(key, (rules.STEPS, 2), minval=-1.0, maxval=1.0)
    actions = rules.ACTION_LIMIT * jnp.where(saturated, jnp.sign(actions), actions)

    def move(target, action):
        target = jnp.clip(target + action, *rules.WORKSPACE)
        return target, target

    return jax.lax.scan(move, jnp.asarray(START), actions)[1]


def fastest_cube(states: State) -> Float[Array, ""]:
    """Greatest speed of a cube at the end of a control step, in m/s."""
    velocities = states.qvel[:, -6 * CUBES :].reshape(-1, CUBES, 6)[..., :3]
    return jnp.linalg.norm(velocities, axis=-1).max()


def random_episodes(engine: Engine, seed: int, count: int) -> dict[str, np.ndarray]:
    """Random episodes in random scenes, every other one with saturated actions.

    Returns:
        For each: the DLO's `length` (m) and `young` (Pa), whether its actions were `saturated`, whether it `failed`,
        the speed of its fastest cube (`cube`, m/s), the penetration of the table by the DLO (`depth`, m), and the
        largest distance of the gripper from its set-point (`lag`, m).
    """

    def episode(key, saturated):
        key_scene, key_targets = jax.random.split(key)
        parameters, targets = random_scene(key_scene), random_targets(key_targets, saturated)
        states = rollout(engine, parameters, targets)
        view = jax.vmap(lambda qpos: frames(engine.scene, parameters, qpos))(states.qpos)
        return {
            "length": parameters.length,
            "young": parameters.young,
            "saturated": saturated,
            "failed": states.failed[-1],
            "cube": fastest_cube(states),
            "depth": SECTION / 2 - view.dlo[..., 2].min(),
            "lag": jnp.linalg.norm(view.gripper - states.target, axis=-1).max(),
        }

    keys = jax.random.split(jax.random.key(seed), count)
    saturated = jnp.arange(count) % 2 == 1
    run = jax.jit(jax.vmap(episode))
    parts = [run(keys[i : i + BATCH], saturated[i : i + BATCH]) for i in range(0, count, BATCH)]
    return {name: np.concatenate([np.asarray(part[name]) for part in parts]) for name in parts[0]}


NUDGE = 1e-6
"""Initial speed of cubes at rest, in m/s, so that no engine excludes them from the simulation."""


def stack_at_rest(engine: Engine, parameters: WhipParameters, seconds: float = 5.0) -> dict[str, float]:
    """Movement of the stack of cubes while the gripper does not move, in m.

    Returns:
        The greatest movement of a cube from its place, `lateral` and `vertical`, and its greatest movement from its
        place after one second, `drift`.
    """
    start = reset(engine.scene, parameters)
    start = start.replace(qvel=start.qvel.at[-6 * CUBES :].add(NUDGE))
    steps = round(seconds / engine.scene.control_interval)
    cubes = np.asarray(_waiting(engine, steps, parameters, start), np.float64)
    moved = cubes - np.asarray(start.qpos, np.float64)[-7 * CUBES :].reshape(CUBES, 7)[:, :3]
    settled = round(1 / engine.scene.control_interval)
    return {
        "lateral": float(np.linalg.norm(moved[..., :2], axis=-1).max()),
        "vertical": float(np.abs(moved[..., 2]).max()),
        "drift": float(np.linalg.norm(cubes[settled:] - cubes[settled], axis=-1).max()),
    }


@functools.partial(jax.jit, static_argnums=(0, 1))
def _waiting(engine: Engine, steps: int, parameters: WhipParameters, state: State) -> Float[Array, "steps 6 3"]:
    """Positions of the cubes after each control step without an action."""

    def wait(state, _):
        state = engine.advance(parameters, state, state.target)
        return state, state.qpos[-7 * CUBES :].reshape(CUBES, 7)[:, :3]

    return jax.lax.scan(wait, state, None, steps)[1]


def steps_per_second(engines: Sequence[Engine], batch: int = BATCH, seed: int = 0, repeats: int = 3) -> list[float]:
    """Physics steps per second, of all threads together, in random episodes of random scenes.

    It is the best of several repetitions, which alternate between engines so that other load affects all of them.
    """

    def run(engine, keys):
        scenes, targets = jax.vmap(random_scene)(keys), jax.vmap(lambda key: random_targets(key, False))(keys)
        return jax.vmap(lambda *one: rollout(engine, *one).qpos[-1])(scenes, targets)

    keys = jax.random.split(jax.random.key(seed), batch)
    programs = [jax.jit(functools.partial(run, engine)) for engine in engines]
    seconds = np.empty((1 + repeats, len(programs)))
    for repeat in range(1 + repeats):  # the first one compiles programs and builds models
        for i, program in enumerate(programs):
            start = time.perf_counter()
            program(keys).block_until_ready()
            seconds[repeat, i] = time.perf_counter() - start
    substeps = np.array([engine.scene.substeps for engine in engines])
    return (batch * rules.STEPS * substeps / seconds[1:].min(axis=0)).tolist()
