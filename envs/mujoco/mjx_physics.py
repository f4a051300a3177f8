"""Steps of MJX: the state that a step continues from, what sensors measure, and whether it is stable."""

from collections.abc import Sequence

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.mujoco.effects import STATE
from jaxlfi.envs.mujoco.mjx_models import Models, mjx

LARGEST = 1e10
"""Bound on positions, velocities and accelerations of a stable simulation, as in MuJoCo itself."""
INTEGRATORS = {
    mjx.IntegratorType.EULER: mjx.euler,
    mjx.IntegratorType.RK4: mjx.rungekutta4,
    mjx.IntegratorType.IMPLICITFAST: mjx.implicit,
}


class State(struct.PyTreeNode):
    """The state that a step continues from; everything else that MJX holds is derived from it.

    Attributes:
        time: in s.
        qpos: positions.
        qvel: velocities.
        act: activations of actuators.
        warmstart: accelerations that the solver begins with.
    """

    time: Float[Array, "*batch"]
    qpos: Float[Array, "*batch nq"]
    qvel: Float[Array, "*batch nv"]
    act: Float[Array, "*batch na"]
    warmstart: Float[Array, "*batch nv"]


class Physics:
    """A model's steps, with the numbers of any parameters.

    Attributes:
        models: MJX models of parameters.
    """

    def __init__(self, models: Models, compiled: mujoco.MjModel, places: Sequence[int]):
        """Check the model; nothing is compiled yet.

        Args:
            models: MJX models of parameters.
            compiled: MuJoCo's model at some parameters.
            places: of the signals among its sensor data.

        Raises:
            ValueError: for a model that MJX cannot simulate, in one line.
        """
        if compiled.nplugin:
            raise ValueError("model: MJX cannot simulate it: it has plugins")
        if models.base.opt.integrator not in INTEGRATORS:
            raise ValueError(f"model: MJX cannot simulate it: its integrator is {models.base.opt.integrator.name}")
        if "opt.timestep" in models.varied:
            raise ValueError("parameters: expected numbers other than the model's time step, got option/timestep")
        if mujoco.mj_stateSize(compiled, STATE) != 1 + compiled.nq + compiled.nv + compiled.na:
            raise ValueError("model: expected a state of positions, velocities and activations only, got more")
        self.models = models
        self._places, self._data = np.asarray(places), mjx.make_data(models.base)
        self._cuts = np.cumsum([1, compiled.nq, compiled.nv])
        self._accelerations = bool(np.any(compiled.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC))

    def state(self, numbers: Float[Array, " state"]) -> State:
        """The state of these numbers (`effects.STATE`)."""
        time, qpos, qvel, act = jnp.split(numbers, self._cuts)
        return State(time[0], qpos, qvel, act, jnp.zeros_like(qvel))

    def data(self, state: State, control: Float[Array, " act"]) -> mjx.Data:
        """MJX's data of a state."""
        return self._data.replace(
            time=state.time,
            qpos=state.qpos,
            qvel=state.qvel,
            act=state.act,
            qacc_warmstart=state.warmstart,
            ctrl=control,
        )

    def step(
        self, model: mjx.Model, state: State, control: Float[Array, " act"]
    ) -> tuple[State, Float[Array, " signals"], Bool[Array, ""]]:
        """The state after a step, the signals before it, and whether the step is stable."""
        data = mjx.forward(model, self.data(state, control))
        if self._accelerations:
            data = mjx.sensor_acc(model, data)  # forward leaves these out without constraints
        values = data.sensordata[self._places]
        after = state_of(INTEGRATORS[model.opt.integrator](model, data))
        return after, values, stable(state.qpos, state.qvel, data.qacc, values)

    def values(self, model: mjx.Model, data: mjx.Data) -> Float[Array, " signals"]:
        """Signals of a state; accelerations are computed only if a sensor needs them."""
        if self._accelerations:
            data = mjx.sensor_acc(model, mjx.forward(model, data))
        else:
            data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
            data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
        return data.sensordata[self._places]


def state_of(data: mjx.Data) -> State:
    """The state that the next step continues from."""
    return State(data.time, data.qpos, data.qvel, data.act, data.qacc_warmstart)


def stable(*numbers: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether all numbers are finite and below the bound of stable simulations."""
    together = jnp.concatenate(numbers)
    return jnp.all(jnp.isfinite(together) & (jnp.abs(together) < LARGEST))
