"""Parameters written into a model of MJX, with all that MJX reads of what MuJoCo derives from them."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float
from mujoco import mjx

from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.chain import link_inertias, link_masses
from jaxlfi.envs.whip.physics.edits import edits
from jaxlfi.envs.whip.physics.scene import CUBES, Scene, base_model, cube_names, link_names


def apply_parameters(scene: Scene, model: mjx.Model, parameters: WhipParameters) -> mjx.Model:
    """The model of a scene, from that of any other of the same `scene`; pure, for one scene and batched by vmap.

    It agrees with MuJoCo's compiled models, of which it leaves out what MJX has no use for: the viewer's statistics
    (`stat.center`, `extent`, `meanmass`, `meansize`) and `actuator_acc0`, which is of muscles.

    Args:
        scene: what all its scenes have in common.
        model: of one of them, as from `mjx.put_model(base_model(scene))`.
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
    """What `mj_setConst` derives from the edits, as edits.

    Masses below bodies, the diagonal of the inertia matrix where the DLO hangs straight down, and the inverse inertia
    that bodies and joints feel there. MuJoCo inverts the matrix for the latter. Here the inverse is found by the
    articulated-body algorithm (Featherstone 2008, ch. 7), whose terms hardly cancel for a straight chain: single
    precision keeps seven digits, of which inverting the matrix would lose four.
    """
    compiled, chain = base_model(scene), scene.chain
    body = lambda name: compiled.body(name).id
    held = np.array([body("gripper"), body("grip"), body("link0")])
    links = np.array([body(name) for name in link_names(chain)[1:]])
    hand = compiled.body_mass[held[:2]].sum()

    lengths = chain.fractions * parameters.length
    masses = link_masses(lengths, parameters.density)
    along, across = link_inertias(lengths, parameters.density)
    below = jnp.cumsum(masses[::-1])[::-1]
    total = hand + below[0]
    swinging = respond(lengths[1:], masses[1:], across[1:], hand + masses[0])
    first = 2 + np.arange(chain.elements * chain.freedoms)  # of the freedoms, two are the gripper's

    yield "body_subtreemass", held, jnp.stack([total, below[0], below[0]])
    yield "body_subtreemass", links, below[1:]
    yield "dof_M0", np.arange(2), total
    lateral = _moments(lengths, masses, across)
    yield "body_invweight0", (held, 0), (swinging.base + 1 / total) / 3
    yield "dof_invweight0", np.arange(2), jnp.stack([swinging.base, 1 / total])
    if chain.planar:
        yield "dof_M0", first, lateral
        yield "body_invweight0", (links, 0), (swinging.centres + 1 / total) / 3
        yield "body_invweight0", (links, 1), swinging.turns / 3
        yield "dof_invweight0", first, swinging.joints
    else:  # out of the plane the gripper does not move; about their own axis links only twist
        aside = respond(lengths[1:], masses[1:], across[1:], jnp.inf)
        twists = 1 / along[1:]
        between = twists + jnp.concatenate([jnp.zeros(1), twists[:-1]])
        axial = jnp.cumsum(along[:0:-1])[::-1]
        yield "dof_M0", first, jnp.stack([axial, lateral, lateral], axis=-1).ravel()
        yield "body_invweight0", (links, 0), (swinging.centres + aside.centres + 1 / total) / 3
        yield "body_invweight0", (links, 1), (swinging.turns + aside.turns + twists) / 3
        yield "dof_invweight0", first, jnp.repeat((swinging.joints + aside.joints + between) / 3, 3)
    yield from _of_cubes(scene, parameters, total)


def _of_cubes(scene: Scene, parameters: WhipParameters, total):
    compiled = base_model(scene)
    cubes = np.array([compiled.body(name).id for name in cube_names()])
    places = np.arange(compiled.nv - 6 * CUBES, compiled.nv).reshape(CUBES, 6)
    side, mass = parameters.cube_side, parameters.cube_density * parameters.cube_side**3
    inertia = mass * side**2 / 6
    yield "body_subtreemass", cubes, mass
    yield "body_subtreemass", 0, total + CUBES * mass
    for column, value in enumerate((mass, inertia)):
        freedoms = places[:, 3 * column : 3 * column + 3]
        yield "dof_M0", freedoms, value
        yield "dof_invweight0", freedoms, 1 / value
        yield "body_invweight0", (cubes, column), 1 / value


@struct.dataclass
class Response:
    """Accelerations in one plane by unit forces and torques, of a straight chain that hangs from a mass.

    Attributes:
        base: of the mass it hangs from by a force across the chain, in 1/kg.
        centres: of links' centres by a force there, in 1/kg, shape [N].
        turns: of links by a torque, in 1/(kg m^2), shape [N].
        joints: of joints by their own torque, in 1/(kg m^2), shape [N].
    """

    base: Float[Array, ""]
    centres: Float[Array, " links"]
    turns: Float[Array, " links"]
    joints: Float[Array, " links"]


def respond(
    lengths: Float[Array, " links"], masses: Float[Array, " links"], inertias: Float[Array, " links"], base
) -> Response:
    """The articulated-body algorithm for a straight chain in one plane.

    Args:
        lengths: of the links, each joined to the one before it at its start, shape [N], in m.
        masses: of the links, at their middles, in kg.
        inertias: about their centres, across the chain, in kg m^2.
        base: the mass it hangs from, which moves across the chain and does not turn; may be infinite, in kg.
    """

    def fold(tip, link):
        """From the mass that is felt at a link's end to that at its joint: how it turns about it, and with what."""
        length, mass, inertia = link
        arm = length / 2
        spin = inertia + mass * arm**2 + tip * length**2
        ratio = (mass * arm + tip * length) / spin  # turns it makes as its joint is moved, per m
        felt = (inertia * (mass + tip) + mass * tip * (length - arm) ** 2) / spin
        return felt, (spin, ratio)

    def unfold(before, link):
        """From how the parent responds at the joint, as a symmetric matrix of turn and shift, to the link's end."""
        (turn, mixed, shift), (length, spin, ratio) = before, link
        joint = 1 / spin + turn + 2 * ratio * mixed + ratio**2 * shift
        at = lambda place: shift * (1 - ratio * place) ** 2 + place**2 / spin
        turn = 1 / spin + ratio**2 * shift
        mixed = length / spin - ratio * shift * (1 - ratio * length)
        return (turn, mixed, at(length)), (at(length / 2), turn, joint)

    links = (lengths, masses, inertias)
    zero = jnp.zeros_like(lengths[0])
    felt, (spins, ratios) = jax.lax.scan(fold, zero, links, reverse=True)
    base = 1 / (base + felt)
    _, (centres, turns, joints) = jax.lax.scan(unfold, (zero, zero, base), (lengths, spins, ratios))
    return Response(base, centres, turns, joints)


def _moments(lengths, masses, inertias):
    """Moments of inertia of all links beyond a joint about it, shape [N], links counted from the clamped one."""
    ends = jnp.cumsum(lengths)
    arms = (ends - lengths / 2)[1:] - ends[:-1, None]
    return jnp.sum(jnp.triu(inertias[1:] + masses[1:] * arms**2), axis=1)
