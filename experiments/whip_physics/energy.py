"""Energy of a swinging chain over time."""

import mujoco
import numpy as np

from experiments.whip_physics import statics
from jaxlfi.envs.whip.rig import GRAVITY


def swing(model: mujoco.MjModel, timestep: float, seconds: float = 2.0, runge_kutta: bool = False) -> np.ndarray:
    """Energy of a clamped chain that is released from its equilibrium when held horizontally.

    Args:
        model: a clamped chain with its damping and air; it is modified.
        timestep: time step, in s.
        seconds: simulated time.
        runge_kutta: whether RK4 replaces the scene's integrator, Euler with implicit damping.

    Returns:
        Elastic, potential and kinetic energy above that of the chain at rest, as a fraction of its initial value, at
        the beginning of each step, shape [steps].
    """
    data = statics.equilibrium(model, np.zeros(3), np.array([GRAVITY, 0.0, 0.0]), loads=12)
    model.opt.gravity = (0, 0, -GRAVITY)
    model.opt.timestep = timestep
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4 if runge_kutta else mujoco.mjtIntegrator.mjINT_EULER
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    rest = statics.bent(model, np.zeros(model.nv))
    mujoco.mj_energyPos(model, rest)
    energy = np.empty(round(seconds / timestep))
    for step in range(len(energy)):
        mujoco.mj_step(model, data)  # computes the energy at the step's beginning
        energy[step] = data.energy.sum() - rest.energy[0]
    return energy / energy[0]
