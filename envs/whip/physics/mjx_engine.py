"""Physics by MJX: MuJoCo in JAX, the fast engine on accelerators."""

import functools
import importlib.util
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from mujoco import mjx

from jaxlfi.envs.whip.parameters import WhipParameters, median
from jaxlfi.envs.whip.physics.engine import State, ramp, reset, settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.mjx_model import apply_parameters
from jaxlfi.envs.whip.physics.mjx_step import step
from jaxlfi.envs.whip.physics.scene import Scene, base_model

IMPLEMENTATIONS = ("jax", "warp")
"""Of MJX: its own, and kernels in Warp for NVIDIA's accelerators."""
CONTACTS = 96
"""Of a scene, for which there is room with Warp: twice what a stack of cubes and a DLO on the table have."""


class MjxEngine:
    """MJX, in the precision that JAX is set to, single as a rule; states between control steps are single anyway."""

    def __init__(self, scene: Scene = Scene(), implementation: str = "jax", scenes: int = 4096):
        """An engine.

        Args:
            scene: what all its scenes have in common.
            implementation: "jax" or "warp".
            scenes: the most in a batch, of Warp, where they share the room for contacts.

        Raises:
            ValueError: for another implementation.
            ImportError: where Warp is not installed, with what to install.
        """
        if implementation not in IMPLEMENTATIONS:
            raise ValueError(f"implementation: expected one of {IMPLEMENTATIONS}, got {implementation!r}")
        if implementation == "warp" and importlib.util.find_spec("warp") is None:
            raise ImportError("engine: 'warp' needs Warp: pip install 'mujoco-mjx[warp]'")
        self.scene = scene
        compiled = base_model(scene).__copy__()
        if implementation == "jax":
            # Sparse matrices, MJX's choice for the chain of balls, are unrolled into a program of their own length.
            compiled.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
            room, advanced = {}, functools.partial(step, scene)
        else:
            # Warp never resets, and refuses to be told not to.
            compiled.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
            room, advanced = {"naconmax": CONTACTS * scenes, "njmax": 4 * CONTACTS}, mjx.step
        zeros = _zeros(scene)
        with jax.ensure_compile_time_eval():  # also where a traced function makes the engine
            model = mjx.put_model(compiled, impl=implementation)
            data = mjx.make_data(compiled, impl=implementation, **room)
            flat, unravel = ravel_pytree(zeros)
        # Tracing takes seconds. So it is done once for all programs, and as the arguments are one vector, once for each
        # kind of batch, whichever of them have the batch's axis.
        self._kind = flat.dtype
        self._simulate = jax.jit(lambda flat: _simulate(scene, advanced, model, data, *unravel(flat)))

    def advance(self, parameters: WhipParameters, state: State, target: Float[Array, "2"]) -> State:
        """One control interval; see `Engine.advance`."""
        with jax.default_matmul_precision("highest"):  # accelerators' 10 bits would not do
            flat, _ = ravel_pytree((parameters, state, target))
            return settled(state, *self._simulate(flat.astype(self._kind)))


def _zeros(scene: Scene):
    """Arguments of `advance`, to tell their shapes."""
    kinds = jax.eval_shape(lambda: (median(), reset(scene, median()), jnp.zeros(2)))
    return jax.tree.map(lambda kind: np.zeros(kind.shape, kind.dtype), kinds)


def _simulate(
    scene: Scene,
    advanced: Callable[[mjx.Model, mjx.Data], mjx.Data],
    model: mjx.Model,
    data: mjx.Data,
    parameters: WhipParameters,
    state: State,
    target,
):
    """Positions and velocities after a control interval, the target, and whether the simulation has broken down."""
    model = apply_parameters(scene, model, parameters)
    kind = data.qpos.dtype
    rest = (initial_positions(scene, parameters).astype(kind), jnp.zeros(model.nv, kind), jnp.zeros(model.nv, kind))
    # What has broken down goes on from rest, as the solver's iterations on it would hold up the whole batch.
    calmed = lambda failed, moving: jax.tree.map(lambda calm, now: jnp.where(failed, calm, now), rest, moving)

    def substep(carry, control):
        (qpos, qvel, warm), failed = carry
        now = advanced(model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, ctrl=control))
        # Where MuJoCo gives up, though the numbers may become reasonable again.
        failed |= ~(jnp.max(jnp.abs(jnp.concatenate([now.qpos, now.qvel, now.qacc]))) < mujoco.mjMAXVAL)
        return (calmed(failed, (now.qpos, now.qvel, now.qacc_warmstart)), failed), None

    start = calmed(state.failed, (state.qpos.astype(kind), state.qvel.astype(kind), rest[2]))
    controls = ramp(state.target, target, scene.substeps).astype(kind)
    ((qpos, qvel, _), failed), _ = jax.lax.scan(substep, (start, state.failed), controls)
    return qpos.astype(jnp.float32), qvel.astype(jnp.float32), target, failed
