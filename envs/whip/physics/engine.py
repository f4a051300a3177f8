"""One contract for the physics, whichever simulator computes it."""

import functools
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.rig import START


class State(struct.PyTreeNode):
    """State of the physics of one scene.

    Attributes:
        qpos: MuJoCo's joint positions.
        qvel: MuJoCo's joint velocities.
        target: the gripper's set-point, x and z in m.
        failed: whether the simulation has become unstable; it then stays where it was last finite.
    """

    qpos: Float[Array, "*time nq"]
    qvel: Float[Array, "*time nv"]
    target: Float[Array, "*time 2"]
    failed: Bool[Array, "*time"]

    def stopped(self, over: Bool[Array, "*time"]) -> "State":
        """The same state, marked as failed where an episode is over: engines do not simulate failed scenes."""
        return self.replace(failed=self.failed | over)


class Engine(Protocol):
    """A simulator of whipping scenes. Its methods are for one scene, batched by `vmap`, and can be traced by JAX."""

    scene: Scene

    def advance(self, parameters: WhipParameters, state: State, target: Float[Array, "2"]) -> State:
        """Simulate one control interval, in which the set-point moves evenly from the state's to the new one.

        Args:
            parameters: of the scene.
            state: to start from.
            target: the new set-point, x and z in m.
        """


def reset(scene: Scene, parameters: WhipParameters) -> State:
    """The DLO hanging at rest from the gripper at its start, the cubes stacked."""
    qpos = initial_positions(scene, parameters)
    velocities = 2 + scene.chain.elements * scene.chain.dofs + 6 * 6
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    return State(single(qpos), single(jnp.zeros(velocities)), single(START), jnp.asarray(False))


def rollout(engine: Engine, parameters: WhipParameters, targets: Float[Array, "time 2"]) -> State:
    """States at the start and after each of the given set-points, shape [T + 1]."""
    return scan_states(functools.partial(engine.advance, parameters), reset(engine.scene, parameters), targets)


def scan_states(step: Callable[[State, Array], State], first: State, inputs: Float[Array, "time 2"]) -> State:
    """The state at the start and after each of T inputs, stacked, shape [T + 1]."""

    def body(state, given):
        state = step(state, given)
        return state, state

    _, states = jax.lax.scan(body, first, inputs)
    return jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, states)


def act(engine: Engine, parameters: WhipParameters, state: State, action: Float[Array, "2"]) -> State:
    """Simulate one control interval under an action (dx, dz) in m, which is clipped to its limit."""
    return engine.advance(parameters, state, rules.moved_target(state.target, action))


def settled(before: State, qpos: Array, qvel: Array, target: Array, failed: Array) -> State:
    """The next state, or the last one, marked as failed, where a simulation has become unstable."""
    failed = before.failed | failed | ~jnp.all(jnp.isfinite(qpos)) | ~jnp.all(jnp.isfinite(qvel))
    keep = lambda old, new: jnp.where(failed, old, new)
    return State(keep(before.qpos, qpos), keep(before.qvel, qvel), jnp.asarray(target, jnp.float32), failed)


def ramp(before: Float[Array, "2"], after: Float[Array, "2"], substeps: int, xp=jnp):
    """Set-points of every substep of a control interval, shape [substeps, 2].

    A set-point that jumped would make soft DLOs chaotic: a change of 10 % in the modulus, or of the time step, would
    move their keypoints by a tenth of the image.
    """
    # Includes the start, as semi-implicit Euler's positions lead by a substep.
    fraction = xp.arange(substeps)[:, None] / substeps
    return before + fraction * (after - before)
