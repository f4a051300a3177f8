"""Models of MJX for given parameters: the edited fields, and those that MuJoCo would derive from them."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.chain import link_inertias, link_masses
from jaxlfi.envs.whip.physics.edits import edits, indices
from jaxlfi.envs.whip.physics.scene import CUBES, Scene, base_model
from jaxlfi.io.quiet_imports import quiet_imports

with quiet_imports():
    from mujoco import mjx


def apply_parameters(scene: Scene, model: mjx.Model, parameters: WhipParameters) -> mjx.Model:
    """The model of a scene, from that of any other of the same `scene`; pure, for one scene and batched by vmap.

    It agrees with MuJoCo's compiled models, except for fields that MJX does not use: the viewer's statistics
    (`stat.center`, `extent`, `meanmass`, `meansize`) and `actuator_acc0`, which belongs to muscles.

    Args:
        scene: settings that all scenes share.
        model: of any of them, as from `mjx.put_model(base_model(scene))`.
        parameters: of the scene.
    """
    compiled, changed = base_model(scene), {}
    for field, index, values in (*edits(scene, parameters, jnp), *derived(scene, parameters)):
        before = changed.get(field, getattr(model, field).reshape(getattr(compiled, field).shape))
        changed[field] = before.at[index].set(values)
    inertia = jnp.mean(changed["dof_M0"])  # scales the solver's tolerance
    # Warp's bounding boxes have an axis more than MuJoCo's.
    fields = {field: values.reshape(getattr(model, field).shape) for field, values in changed.items()}
    return model.tree_replace(fields | {"stat.meaninertia": inertia})


def derived(scene: Scene, parameters: WhipParameters):
    """The fields that `mj_setConst` derives from the edits, as edits.

    Masses of subtrees, the diagonal of the inertia matrix where the DLO hangs straight down, and the inverse inertia
    of bodies and joints there. MuJoCo inverts the matrix for the latter. Here the inverse is found by the
    articulated-body algorithm (Featherstone 2008, ch. 7), whose terms hardly cancel for a straight chain: single
    precision keeps seven digits, of which inverting the matrix would lose four.
    """
    compiled, chain = base_model(scene), scene.chain
    body = lambda name: compiled.body(name).id
    held = np.array([body("gripper"), body("grip"), body("link0")])
    links = indices(scene).links[1:]
    hand = compiled.body_mass[held[:2]].sum()

    lengths = chain.fractions * parameters.length
    masses = link_masses(lengths, parameters.density)
    along, across = link_inertias(lengths, parameters.density)
    below = jnp.cumsum(masses[::-1])[::-1]
    total = hand + below[0]
    swinging = respond(lengths[1:], masses[1:], across[1:], hand + masses[0])
    first = 2 + np.arange(chain.elements * chain.dofs)  # the first two DoFs are the gripper's

    yield "body_subtreemass", held, jnp.stack([total, below[0], below[0]])
    yield "body_subtreemass", links, below[1:]
    yield "dof_M0", np.arange(2), total
    lateral = _moments(lengths, masses, across)
    yield "body_invweight0", (held, 0), (swinging.base + 1 / total) / 3
    yield "dof_invweight0", np.arange(2), jnp.stack([swinging.base, 1 / total])
    if chain.planar:
        yield "dof_M0", first, lateral
        yield "body_invweight0", (links, 0), (swinging.centres + 1 / total) / 3
        yield "body_invweight0", (links, 1), swinging.rotations / 3
        yield "dof_invweight0", first, swinging.joints
    else:  # the gripper does not move out of the plane; links only twist about their own axis
        aside = respond(lengths[1:], masses[1:], across[1:], jnp.inf)
        twists = 1 / along[1:]
        between = twists + jnp.concatenate([jnp.zeros(1), twists[:-1]])
        axial = jnp.cumsum(along[:0:-1])[::-1]
        yield "dof_M0", first, jnp.stack([axial, lateral, lateral], axis=-1).ravel()
        yield "body_invweight0", (links, 0), (swinging.centres + aside.centres + 1 / total) / 3
        yield "body_invweight0", (links, 1), (swinging.rotations + aside.rotations + twists) / 3
        yield "dof_invweight0", first, jnp.repeat((swinging.joints + aside.joints + between) / 3, 3)
    yield from _of_cubes(scene, parameters, total)


def _of_cubes(scene: Scene, parameters: WhipParameters, total):
    compiled = base_model(scene)
    cubes = indices(scene).cubes
    places = np.arange(compiled.nv - 6 * CUBES, compiled.nv).reshape(CUBES, 6)
    side, mass = parameters.cube_side, parameters.cube_density * parameters.cube_side**3
    inertia = mass * side**2 / 6
    yield "body_subtreemass", cubes, mass
    yield "body_subtreemass", 0, total + CUBES * mass
    for column, value in enumerate((mass, inertia)):
        dofs = places[:, 3 * column : 3 * column + 3]
        yield "dof_M0", dofs, value
        yield "dof_invweight0", dofs, 1 / value
        yield "body_invweight0", (cubes, column), 1 / value


class Response(struct.PyTreeNode):
    """Accelerations in one plane by unit forces and torques, of a straight chain that hangs from a mass.

    Attributes:
        base: of the mass it hangs from by a force across the chain, in 1/kg.
        centres: of links' centres by a force there, in 1/kg, shape [N].
        rotations: of links by a torque, in 1/(kg m^2), shape [N].
        joints: of joints by their own torque, in 1/(kg m^2), shape [N].
    """

    base: Float[Array, ""]
    centres: Float[Array, " links"]
    rotations: Float[Array, " links"]
    joints: Float[Array, " links"]


def respond(
    lengths: Float[Array, " links"], masses: Float[Array, " links"], inertias: Float[Array, " links"], base
) -> Response:
    """The articulated-body algorithm for a straight chain in one plane.

    Args:
        lengths: of the links, each joined to the one before it at its start, shape [N], in m.
        masses: of the links, at their middles, in kg.
        inertias: about their centres, across the chain, in kg m^2.
        base: the mass it hangs from, which moves across the chain and does not rotate; may be infinite, in kg.
    """

    def fold(tip, link):
        """From the apparent mass at a link's end to that at its joint, and how the link rotates about its joint."""
        length, mass, inertia = link
        arm = length / 2
        spin = inertia + mass * arm**2 + tip * length**2
        ratio = (mass * arm + tip * length) / spin  # rotation as its joint is moved, in rad per m
        felt = (inertia * (mass + tip) + mass * tip * (length - arm) ** 2) / spin
        return felt, (spin, ratio)

    def unfold(before, link):
        """From the parent's response at the joint, a symmetric matrix over rotation and shift, to the link's end."""
        (rotation, mixed, shift), (length, spin, ratio) = before, link
        joint = 1 / spin + rotation + 2 * ratio * mixed + ratio**2 * shift
        at = lambda place: shift * (1 - ratio * place) ** 2 + place**2 / spin
        rotation = 1 / spin + ratio**2 * shift
        mixed = length / spin - ratio * shift * (1 - ratio * length)
        return (rotation, mixed, at(length)), (at(length / 2), rotation, joint)

    links = (lengths, masses, inertias)
    zero = jnp.zeros_like(lengths[0])
    felt, (spins, ratios) = jax.lax.scan(fold, zero, links, reverse=True)
    base = 1 / (base + felt)
    _, (centres, rotations, joints) = jax.lax.scan(unfold, (zero, zero, base), (lengths, spins, ratios))
    return Response(base, centres, rotations, joints)


def _moments(lengths, masses, inertias):
    """Moments of inertia of all links beyond a joint about it, shape [N], links counted from the clamped one."""
    ends = jnp.cumsum(lengths)
    arms = (ends - lengths / 2)[1:] - ends[:-1, None]
    return jnp.sum(jnp.triu(inertias[1:] + masses[1:] * arms**2), axis=1)
