"""Forces that a model lacks: a spring, a damper and dry friction of random size on each joint.

A random error of the measurements (`discrepancy`) shows how far a simulation is off, but not in which parameter's
direction: errors that the parameters can compensate leave no residual. An error of the forces acts as the parameters
do. A force that is a function of a joint's position and speed is, to first order, a spring, a damper and dry friction.
Each simulation draws their coefficients anew. They are not inferred, so that the parameters' posterior is marginal over
them (as nuisance parameters are marginalised by simulating them; Cranmer, Brehmer and Louppe 2020,
doi:10.1073/pnas.1912789117).
"""

import dataclasses

import mujoco
import numpy as np
import scipy.special
from jaxtyping import Float

MOST_STATES = 200
"""Largest number of states of a motion over which typical forces are averaged."""
BY_CHANCE = 1e-3
"""Significance level: residuals that noise alone exceeds less often than this show that the model lacks something."""
SEEN, TRIED = 1e-9, 500
"""Visibility, relative to the most visible direction, below which a direction is ignored; number of sizes tried."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclasses.dataclass(frozen=True)
class UnmodelledForces:
    """Standard deviations of forces that are added to a model, N numbers in SI units.

    Attributes:
        stiffness: of each joint's spring; 0 for balls and free bodies, shape [J].
        damping: of each degree of freedom, shape [V].
        friction: of each degree of freedom, shape [V].
    """

    stiffness: Float[np.ndarray, " joints"]
    damping: Float[np.ndarray, " dofs"]
    friction: Float[np.ndarray, " dofs"]

    @property
    def deviations(self) -> Float[np.ndarray, " numbers"]:
        """All standard deviations in one vector."""
        return np.concatenate([self.stiffness, self.damping, self.friction])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, for messages."""
        of = {"stiffness": self.stiffness, "damping": self.damping, "friction": self.friction}
        return tuple(f"unmodelled {what}[{i}]" for what, several in of.items() for i in range(len(several)))

    def times(self, factor: float) -> "UnmodelledForces":
        """The same forces, all larger by a factor."""
        return UnmodelledForces(factor * self.stiffness, factor * self.damping, factor * self.friction)

    def draws(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n numbers"]:
        """Independent draws, normal about zero."""
        return self.deviations * rng.standard_normal((n, len(self.deviations)))

    def add(self, model: mujoco.MjModel, numbers: Float[np.ndarray, " numbers"]) -> mujoco.MjModel:
        """The model with these forces added, changed in place; damping and friction stay at least 0."""
        stiffness, damping, friction = np.split(numbers, np.cumsum([len(self.stiffness), len(self.damping)]))
        model.jnt_stiffness += stiffness
        model.dof_damping[:] = np.maximum(model.dof_damping + damping, 0.0)
        model.dof_frictionloss[:] = np.maximum(model.dof_frictionloss + friction, 0.0)
        return model


def typical(model: mujoco.MjModel, states: Float[np.ndarray, "steps state"], spec: mujoco.mjtState) -> UnmodelledForces:
    """Springs, dampers and dry friction whose forces each have the root mean square of those that act in a motion.

    Args:
        model: the moving model.
        states: along the motion.
        spec: components of the states.
    """
    data, forces, places, speeds = mujoco.MjData(model), [], [], []
    scalar = np.isin(model.jnt_type, _SCALAR)
    own = model.jnt_qposadr[scalar]
    for state in states[:: -(-len(states) // MOST_STATES)]:
        mujoco.mj_setState(model, data, state, spec)
        mujoco.mj_forward(model, data)
        acting = [data.qfrc_passive, data.qfrc_actuator, data.qfrc_bias, data.qfrc_constraint]
        forces.append(np.sum(np.square(acting), axis=0))
        places.append(data.qpos[own] - model.qpos_spring[own])
        speeds.append(data.qvel.copy())
    force, speed = np.sqrt(np.mean(forces, axis=0)), np.sqrt(np.mean(np.square(speeds), axis=0))
    stiffness = np.zeros(model.njnt)
    stiffness[scalar] = _ratio(force[model.jnt_dofadr[scalar]], np.sqrt(np.mean(np.square(places), axis=0)))
    return UnmodelledForces(stiffness, _ratio(force, speed), force)


def estimated(
    residuals: Float[np.ndarray, " rows"],
    jacobian: Float[np.ndarray, "rows dim"],
    by_forces: Float[np.ndarray, "rows numbers"],
) -> tuple[float, float]:
    """The size of the forces that a model lacks, from the residuals that parameters cannot compensate.

    With P the projection on what is orthogonal to the parameters' directions J, and F what forces of size 1 change, P r
    has the covariance P (1 + a^2 F F^T) P. Residuals that noise does not explain are all attributed to such forces,
    whatever their directions, as models have other faults, too: the mean of |P r|^2 is a^2 tr(P F F^T) + tr(P).
    Otherwise a is estimated by restricted maximum likelihood (Patterson and Thompson 1971), so that noise along
    directions that no force moves does not count: by chance, |P r|^2 exceeds tr(P) in half of all cases.

    Args:
        residuals: at a point of least squares, in standard deviations of the noise.
        jacobian: of the parameters.
        by_forces: F.

    Returns:
        a, at least 0; and the factor by which 90 % intervals widen because few directions may be visible, so that a is
        uncertain: that of Student's t with tr(M)^2 / tr(M^2) degrees of freedom, M = P F F^T P (Satterthwaite 1946).
    """
    directions, _, _ = np.linalg.svd(jacobian, full_matrices=False)
    beside = lambda values: values - directions @ (directions.T @ values)
    along, sizes, _ = np.linalg.svd(beside(by_forces), full_matrices=False)
    left, visible = beside(residuals), sizes**2
    if not visible.any():
        return 0.0, 1.0
    total, degrees = float(np.sum(left**2)), len(left) - directions.shape[1]
    if beyond_noise(total, degrees):
        variance = (total - degrees) / np.sum(visible)
    else:
        variance = _most_likely((along.T @ left) ** 2, visible)
    if not variance:
        return 0.0, 1.0
    few = np.sum(visible) ** 2 / np.sum(visible**2)
    return float(np.sqrt(variance)), float(scipy.special.stdtrit(few, 0.95) / scipy.special.ndtri(0.95))


def beyond_noise(squares: float, degrees: int) -> bool:
    """Whether noise alone makes the sum of squared residuals as large as this with a probability below `BY_CHANCE`."""
    return bool(squares > scipy.special.chdtri(degrees, BY_CHANCE))


def _most_likely(squares: Float[np.ndarray, " k"], visible: Float[np.ndarray, " k"]) -> float:
    """The most likely a of independent normal numbers of variance 1 + a visible, from their squares; at least 0."""
    seen = visible > SEEN * visible.max()
    squares, visible = squares[seen], visible[seen]
    most = float(np.max(squares / visible))
    if not most:
        return 0.0
    tried = np.concatenate([[0.0], np.geomspace(SEEN * most, most, TRIED)])[:, None]
    minus_log = np.sum(np.log1p(tried * visible) + squares / (1 + tried * visible), axis=1)
    return float(tried[np.argmin(minus_log), 0])


def _ratio(force: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Ratios of forces to motions; 0 where nothing moves."""
    return np.divide(force, motion, out=np.zeros_like(force), where=motion > 1e-9)
