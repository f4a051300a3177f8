"""Evaluation of policies in simulation, on the points of domains; all policies get the same episodes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from experiments.policies.study import FEM, SIMULATED, Study
from jaxlfi.cli.domains import domain
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.environment import WhipEnvironment
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.envs.whip.vision.keypoints import ON_DLO
from jaxlfi.rl.evaluation import acting, stacked
from jaxlfi.rl.policy import Policy

BROAD = ("uniform", "median")
KNOWN = tuple(f"{dlo}-true" for dlo in (*FEM, *SIMULATED))
"""Points of known parameters, with the nuisances of training; for FEM objects, the light DLO that moves alike."""
DOMAINS = (*BROAD, *(f"{dlo}-{how}" for how in ("edge", "none") for dlo in FEM), *KNOWN)
"""Domains that policies are evaluated on."""
Act = Callable[[Array, Array], Array]
"""Function from an observation [28] and the index of the step to an action (dx, dz) in m."""


@struct.dataclass
class Performed:
    """Episodes, each until its end; later values are NaN.

    Attributes:
        value: returns, shape [E].
        hit: whether the top cube was hit, shape [E].
        clean: whether only the top cube was hit, shape [E].
        outside: whether the gripper left its workspace, shape [E].
        failed: whether the simulation became unstable, shape [E].
        steps: lengths, shape [E].
        actions: displacements of the set-point, in m, shape [E, 16, 2].
        gripper: height of the gripper above the table after each step, in m, shape [E, 16].
        lowest: height of the DLO's lowest keypoint, as seen by the camera, in m, shape [E, 16].
    """

    value: Float[Array, "*batch"]
    hit: Bool[Array, "*batch"]
    clean: Bool[Array, "*batch"]
    outside: Bool[Array, "*batch"]
    failed: Bool[Array, "*batch"]
    steps: Int[Array, "*batch"]
    actions: Float[Array, "*batch 16 2"]
    gripper: Float[Array, "*batch 16"]
    lowest: Float[Array, "*batch 16"]


def lowest(camera: Camera, observation: Float[Array, "28"]) -> Float[Array, ""]:
    """Height of the DLO's lowest keypoint, in m; the DLO is in the plane y = 0, and the camera looks along y."""
    v = observation[3 : 2 + 2 * ON_DLO : 2]
    return camera.position[2] + (0.5 - v.max()) * -camera.position[1] / camera.focal_length


def perform(key: jax.Array, environment: WhipEnvironment, act: Act, theta: Float[Array, "episodes 2"]) -> Performed:
    """An episode at each point, as in `jaxlfi.rl.evaluation.evaluate`, with the actions and heights in addition."""

    def episode(key, theta):
        def step(carry, time):
            state, over = carry
            action = act(state.observation, time)
            after = environment.step(state, action)
            seen = after.observation
            row = (after.reward, after.facts, action, seen[1], lowest(side_camera(after.inner.parameters), seen))
            # Scenes of episodes that are over are no longer simulated.
            inner = after.inner
            stopped = inner.episode.replace(state=inner.episode.state.stopped(over | after.terminated))
            after = after.replace(inner=inner.replace(episode=stopped))
            return (after, over | after.terminated | after.truncated), (row, over)

        first = environment.reset(key, theta), jnp.asarray(False)
        _, ((rewards, facts, actions, gripper, low), over) = jax.lax.scan(step, first, jnp.arange(rules.STEPS))
        steps = jnp.sum(~over)
        last = {name: fact[steps - 1] for name, fact in facts.items()}
        until = lambda rows: jnp.where(over.reshape(-1, *[1] * (rows.ndim - 1)), jnp.nan, rows)
        return Performed(
            value=jnp.sum(jnp.where(over, 0.0, rewards)),
            hit=last["hit"],
            clean=last["clean_hit"],
            outside=last["outside"],
            failed=last["failed"],
            steps=steps,
            actions=until(actions),
            gripper=until(gripper),
            lowest=until(low),
        )

    return jax.vmap(episode)(jax.random.split(key, len(theta)), theta)


class Simulation:
    """Evaluation in simulation, compiled once for all policies and once for all action sequences."""

    def __init__(self, study: Study, environment: WhipEnvironment, episodes: int, seed: int = 0):
        """Nothing is done yet."""
        self._study, self._environment, self._episodes, self._seed = study, environment, episodes, seed

        def policy(key, theta, layers):
            act = acting(layers)
            return perform(key, environment, lambda observation, _: act(observation), theta)

        self._policies = jax.jit(jax.vmap(policy, in_axes=(None, None, 0)))
        self._actions = jax.jit(lambda key, theta, rows: perform(key, environment, lambda _, time: rows[time], theta))

    def of_policies(self, policies: list[Policy], name: str) -> Performed:
        """Episodes of policies with the same layer widths on a domain, shape [S, E]."""
        return jax.device_get(self._policies(*self._episodes_of(name), stacked(policies)))

    def of_actions(self, actions: Float[np.ndarray, "16 2"], name: str) -> Performed:
        """Episodes of a sequence of actions on a domain, shape [1, E]."""
        performed = jax.device_get(self._actions(*self._episodes_of(name), jnp.asarray(actions, jnp.float32)))
        return jax.tree.map(lambda leaf: leaf[None], performed)

    def _episodes_of(self, name: str) -> tuple[jax.Array, Array]:
        key_points, key_episodes = jax.random.split(jax.random.key(self._seed))
        _, draw = domain(self._environment, self._study.domain(name))
        return key_episodes, draw(key_points, self._episodes).theta
