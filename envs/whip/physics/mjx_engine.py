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

from jaxlfi.envs.whip.parameters import WhipParameters, median
from jaxlfi.envs.whip.physics.engine import State, ramp, reset, settled
from jaxlfi.envs.whip.physics.kinematics import initial_positions
from jaxlfi.envs.whip.physics.mjx_model import apply_parameters
from jaxlfi.envs.whip.physics.mjx_step import step
from jaxlfi.envs.whip.physics.scene import Scene, base_model
from jaxlfi.io.quiet_imports import quiet_imports

with quiet_imports():
    from mujoco import mjx

IMPLEMENTATIONS = ("jax", "warp")
"""Implementations of MJX: its own in JAX, and kernels in Warp for NVIDIA's accelerators."""
CONTACTS = 96
"""Maximum number of contacts per scene with Warp: twice that of a stack of cubes and a DLO on the table."""


class MjxEngine:
    """MJX in the precision of JAX, single by default; states between control steps are always single."""

    def __init__(self, scene: Scene = Scene(), implementation: str = "jax", scenes: int = 4096):
        """An engine.

        Args:
            scene: settings that all scenes of the engine share.
            implementation: "jax" or "warp".
            scenes: maximum size of a batch with Warp, whose scenes share the memory for contacts.

        Raises:
            ValueError: for an unknown implementation.
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
            # Warp never resets, and does not accept the flag that disables it.
            compiled.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
            room, advanced = {"naconmax": CONTACTS * scenes, "njmax": 4 * CONTACTS}, mjx.step
        zeros = _zeros(scene)
        with jax.ensure_compile_time_eval():  # also if a traced function makes the engine
            model = mjx.put_model(compiled, impl=implementation)
            data = mjx.make_data(compiled, impl=implementation, **room)
            flat, unravel = ravel_pytree(zeros)
        # Tracing takes seconds. So it is done once for all programs, and as the arguments are one vector, once for each
        # kind of batch, whichever of them have the batch's axis.
        self._kind = flat.dtype
        self._simulate = jax.jit(lambda flat: _simulate(scene, advanced, model, data, *unravel(flat)))

    def advance(self, parameters: WhipParameters, state: State, target: Float[Array, "2"]) -> State:
        """One control interval; see `Engine.advance`."""
        with jax.default_matmul_precision("highest"):  # accelerators' 10 bits are too few
            flat, _ = ravel_pytree((parameters, state, target))
            return settled(state, *self._simulate(flat.astype(self._kind)))


def _zeros(scene: Scene):
    """Zeros with the shapes of the arguments of `advance`."""
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
    """Positions and velocities after a control interval, the target, and whether the simulation is unstable."""
    model = apply_parameters(scene, model, parameters)
    kind = data.qpos.dtype
    rest = (initial_positions(scene, parameters).astype(kind), jnp.zeros(model.nv, kind), jnp.zeros(model.nv, kind))
    # Unstable scenes continue from rest, or the solver's iterations on them would delay the whole batch.
    calmed = lambda failed, moving: jax.tree.map(lambda calm, now: jnp.where(failed, calm, now), rest, moving)

    def substep(carry, control):
        (qpos, qvel, warm), failed = carry
        now = advanced(model, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, ctrl=control))
        # MuJoCo's own criterion, though the numbers may become reasonable again.
        failed |= ~(jnp.max(jnp.abs(jnp.concatenate([now.qpos, now.qvel, now.qacc]))) < mujoco.mjMAXVAL)
        return (calmed(failed, (now.qpos, now.qvel, now.qacc_warmstart)), failed), None

    start = calmed(state.failed, (state.qpos.astype(kind), state.qvel.astype(kind), rest[2]))
    controls = ramp(state.target, target, scene.substeps).astype(kind)
    ((qpos, qvel, _), failed), _ = jax.lax.scan(substep, (start, state.failed), controls)
    return qpos.astype(jnp.float32), qvel.astype(jnp.float32), target, failed
