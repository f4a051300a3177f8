"""A step of MJX with batched kinematics of the chain, and a solver that is robust in single precision."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.scene import CUBES, Scene
from jaxlfi.envs.whip.quaternions import normalised, product, rotation
from jaxlfi.io.quiet_imports import quiet_imports

with quiet_imports():
    from mujoco import mjx

PARTS = (
    mjx.com_pos,
    mjx.crb,
    mjx.factor_m,
    mjx.collision,
    mjx.make_constraint,
    mjx.transmission,
    mjx.fwd_velocity,
    mjx.fwd_actuation,
    mjx.fwd_acceleration,
)
"""The stages of `mjx.step` between kinematics and solver that the scene needs, in their order."""
HEAVIER = (0.0, 1e-5, 1e-3)
"""By which fractions the diagonal of the mass matrix is increased in the solver's attempts."""


def step(scene: Scene, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """One physics step of one scene, in place of `mjx.step`."""
    data = kinematics(scene, model, data)
    for part in PARTS:
        data = part(model, data)
    return mjx.euler(model, solve(model, data))


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """The result of `mjx.solve`; if it is not finite, that with slightly more inertia of the joints.

    In single precision the matrix of Newton's method, which contains the stiffness of the contacts, is at times
    indistinguishable from an indefinite one (scaled to a unit diagonal, its smallest eigenvalue is about 3e-7), and
    Cholesky's method stops: in one of 100,000 steps of random episodes.
    """
    inertia = data._impl.M

    def attempt(carry):
        number, _ = carry
        diagonal = jnp.diag(jnp.asarray(HEAVIER, inertia.dtype)[number] * jnp.diagonal(inertia))
        solved = mjx.solve(model, data.tree_replace({"_impl.M": inertia + diagonal}))
        return number + 1, (solved.qacc, solved.qfrc_constraint)

    def unsolved(carry):
        number, (qacc, _) = carry
        return (number == 0) | ((number < len(HEAVIER)) & ~jnp.all(jnp.isfinite(qacc)))

    _, (qacc, forces) = jax.lax.while_loop(unsolved, attempt, (0, (data.qacc, data.qfrc_constraint)))
    return data.replace(qacc=qacc, qfrc_constraint=forces)


def kinematics(scene: Scene, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """The result of `mjx.kinematics` for the bodies of `scene.build`, computed for all links at once.

    MJX goes from link to link. On a processor XLA makes one kernel of that (jax 0.9), which computes every link's
    ancestors anew for each number it needs: 1.5 s for a step of twelve links. Elsewhere it compiles to twenty thousand
    instructions.
    """
    slides, joints, cubes = jnp.split(data.qpos, [2, scene.first_cube])
    joints, orientations = _links(scene.chain, joints)
    cubes = cubes.reshape(CUBES, 7)
    cubes = jnp.concatenate([cubes[:, :3], normalised(cubes[:, 3:])], axis=1)
    grip = jnp.stack([slides[0], jnp.zeros_like(slides[0]), slides[1]])

    # Bodies: the world, the gripper, the grip that points the DLO down, links, cubes.
    world, held = jnp.zeros((1, 3)), jnp.stack([grip, grip])
    upright = jnp.tile(jnp.eye(1, 4), (2, 1))
    xquat = jnp.concatenate([upright, orientations[:1], orientations, cubes[:, 3:]])
    xmat = rotation(xquat)
    offsets = _rotated(xmat[3 : -CUBES - 1], model.body_pos[4:-CUBES])
    xpos = jnp.concatenate([world, held, grip[None], grip + jnp.cumsum(offsets, axis=0), cubes[:, :3]])

    of_geoms, of_joints = model.geom_bodyid, model.jnt_bodyid
    return data.replace(
        qpos=jnp.concatenate([slides, joints, cubes.ravel()]),
        xpos=xpos,
        xquat=xquat,
        xmat=xmat,
        xipos=xpos + _rotated(xmat, model.body_ipos),
        ximat=rotation(product(xquat, model.body_iquat)),
        # Not so for the slides, for which it does not matter.
        xanchor=xpos[of_joints],
        xaxis=_rotated(xmat[model.body_parentid[of_joints]], model.jnt_axis),
        geom_xpos=xpos[of_geoms] + _rotated(xmat[of_geoms], model.geom_pos),
        geom_xmat=rotation(product(xquat[of_geoms], model.geom_quat)),
    )


def _links(chain: Chain, joints: Float[Array, " positions"]):
    """The joints' positions, normalised, and the links' orientations [N + 1, 4], the clamped one's first."""
    if chain.planar:
        halves = jnp.concatenate([jnp.zeros(1), jnp.cumsum(joints)]) / 2 + jnp.pi / 4
        still = jnp.zeros_like(halves)
        return joints, jnp.stack([jnp.cos(halves), still, jnp.sin(halves), still], axis=-1)
    bends = normalised(joints.reshape(chain.elements, 4))
    down = jnp.array([[0.5, 0.0, 0.5, 0.0]]) * 2**0.5
    return bends.ravel(), jax.lax.associative_scan(product, jnp.concatenate([down, bends]))


def _rotated(matrices: Float[Array, "n 3 3"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(matrices * vectors[:, None], axis=-1)
