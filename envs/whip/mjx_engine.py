"""Physics by MJX: MuJoCo in JAX, the fast engine on accelerators."""

import functools

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

from envs.whip.apply import apply_parameters
from envs.whip.engine import State, ramp, settled
from envs.whip.mjx_step import step
from envs.whip.parameters import WhipParameters
from envs.whip.scene import Scene, base_model


class MjxEngine:
    """MJX, in the precision that JAX is set to, single as a rule."""

    def __init__(self, scene: Scene = Scene()):
        """An engine; the scene is what all its scenes have in common."""
        self.scene = scene
        compiled = base_model(scene).__copy__()
        # Sparse matrices, MJX's choice for the chain of balls, are unrolled into a program of their own length.
        compiled.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        with jax.ensure_compile_time_eval():  # also where a traced function makes the engine
            self._model, self._data = mjx.put_model(compiled), mjx.make_data(compiled)
        # Traced once, whatever programs it is called from: that takes seconds, most of them of collisions.
        self._simulate = jax.jit(functools.partial(_simulate, scene, self._model, self._data))

    def advance(self, parameters: WhipParameters, state: State, target: Float[Array, "2"]) -> State:
        """One control interval; see `Engine.advance`."""
        with jax.default_matmul_precision("highest"):  # accelerators' 10 bits would not do
            return settled(state, *self._simulate(parameters, state, target))


def _simulate(scene: Scene, model: mjx.Model, data: mjx.Data, parameters: WhipParameters, state: State, target):
    """Positions and velocities after a control interval, the target, and whether the simulation has broken down."""
    model = apply_parameters(scene, model, parameters)
    precision = data.qpos.dtype

    def substep(carry, control):
        (qpos, qvel, warm), failed = carry
        now = step(scene, model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, ctrl=control))
        # Where MuJoCo gives up, though its numbers may become reasonable again.
        worst = jnp.max(jnp.abs(jnp.concatenate([now.qpos, now.qvel, now.qacc])))
        carry = (now.qpos, now.qvel, now.qacc_warmstart)
        return (carry, failed | ~(worst < mujoco.mjMAXVAL)), None

    start = (state.qpos.astype(precision), state.qvel.astype(precision), jnp.zeros_like(state.qvel, precision))
    controls = ramp(state.target, jnp.asarray(target), scene.substeps).astype(precision)
    ((qpos, qvel, _), failed), _ = jax.lax.scan(substep, (start, jnp.asarray(False)), controls)
    return qpos.astype(jnp.float32), qvel.astype(jnp.float32), target, failed
