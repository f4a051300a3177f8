"""Equilibria and vibrations of a clamped chain, by root finding and eigenvalues, without simulation."""

import mujoco
import numpy as np
from scipy import linalg, optimize


def links(model: mujoco.MjModel) -> list[int]:
    """The bodies of a chain, from the grip to the tip."""
    return [i for i in range(model.nbody) if model.body(i).name.startswith(("link", "cable"))]


def mass(model: mujoco.MjModel) -> float:
    """Mass of a chain, in kg."""
    return float(model.body_mass[links(model)].sum())


def nodes(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Points of the centreline from the grip to the tip, in m, shape [links + 1, 3]."""
    bodies = links(model)
    return np.concatenate([data.xpos[bodies], tip(model, data, bodies[-1])[None]])


def tip(model: mujoco.MjModel, data: mujoco.MjData, link: int) -> np.ndarray:
    """The far end of a link, in m, shape [3]."""
    length = 2 * model.geom_size[model.body_geomadr[link], 1]
    return data.xpos[link] + length * data.xmat[link].reshape(3, 3)[:, 0]


def bent(model: mujoco.MjModel, angles: np.ndarray) -> mujoco.MjData:
    """The chain bent by a rotation vector (or an angle) at each of its joints, at rest, shape [nv]."""
    data = mujoco.MjData(model)
    _bend(model, data, angles)
    return data


def _bend(model, data, angles) -> None:
    data.qpos[:] = model.qpos0
    mujoco.mj_integratePos(model, data.qpos, angles, 1.0)
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)


def equilibrium(model: mujoco.MjModel, force: np.ndarray, weight: np.ndarray, loads: int = 1) -> mujoco.MjData:
    """The equilibrium of springs, a force at the tip and weight, followed from the straight chain.

    Args:
        model: a clamped chain; its gravity is set to `weight`.
        force: force at the tip, in N, shape [3].
        weight: gravity, in m/s^2, shape [3].
        loads: number of geometrically spaced steps in which both are applied.

    Raises:
        RuntimeError: if no equilibrium was found.
    """
    lever = float(np.ptp(nodes(model, bent(model, np.zeros(model.nv)))[:, 2]))
    scale = lever * (np.linalg.norm(force) + np.linalg.norm(weight) * mass(model))
    data, jacobian, last = mujoco.MjData(model), np.zeros((3, model.nv)), links(model)[-1]

    def imbalance(angles, fraction):
        model.opt.gravity = fraction * weight
        _bend(model, data, angles)
        mujoco.mj_jac(model, data, jacobian, None, tip(model, data, last), last)
        return (data.qfrc_passive - data.qfrc_bias + fraction * jacobian.T @ force) / scale

    angles = np.zeros(model.nv)
    # Twice at the full load: with a fresh Jacobian, limp chains converge further.
    for fraction in [*np.geomspace(1e-3, 1.0, loads)[:-1], 1.0, 1.0]:
        angles = optimize.root(imbalance, angles, args=(fraction,), tol=1e-13).x
    left = np.abs(imbalance(angles, 1.0)).max()
    if not left < 1e-9:
        raise RuntimeError(f"equilibrium: expected torques that balance to 1e-9 of load times length, got {left:.1e}")
    return data


def tip_deflection(model: mujoco.MjModel, load: float) -> float:
    """Displacement along x of a weightless chain's tip under a force along x, in m."""
    data = equilibrium(model, np.array([load, 0.0, 0.0]), np.zeros(3))
    line = nodes(model, data)
    return line[-1, 0] - line[0, 0]


def sagged(model: mujoco.MjModel, gravity: float) -> np.ndarray:
    """Nodes of a chain held horizontally: distances from the clamp and below it, in m, shape [links + 1, 2]."""
    # Gravity is rotated by 90 degrees instead of the chain: weight acts along x, the clamp points along -z.
    data = equilibrium(model, np.zeros(3), np.array([gravity, 0.0, 0.0]), loads=12)
    line = nodes(model, data) - nodes(model, data)[0]
    return np.stack([-line[:, 2], line[:, 0]], axis=-1)


def in_plane(model: mujoco.MjModel) -> np.ndarray:
    """DoFs that bend a straight chain in the plane y = 0."""
    every = np.arange(model.nv)
    return every[1::3] if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_BALL else every


def frequencies(model: mujoco.MjModel) -> np.ndarray:
    """Natural frequencies of small bending in the plane about the straight chain, in rad/s, ascending."""
    plane = in_plane(model)
    data = bent(model, np.zeros(model.nv))
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    step = 1e-5 * np.eye(model.nv)[plane]
    stiffness = [(bent(model, -e).qfrc_passive - bent(model, e).qfrc_passive)[plane] / 2e-5 for e in step]
    return np.sqrt(linalg.eigh(np.array(stiffness), mass[np.ix_(plane, plane)], eigvals_only=True))
