"""Edits that write parameters into a compiled model, the same for models of MuJoCo and of MJX.

The fields that MuJoCo derives from these when it compiles a model (`mj_setConst`) are not among them.
"""

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.chain import link_inertias, link_masses
from jaxlfi.envs.whip.physics.scene import Scene, bare_model, base_model, cube_names, cube_positions, link_names
from jaxlfi.envs.whip.rig import SECTION

Edit = tuple[str, Any, Any]
"""A field of the model, an index into it, and its values there."""


def edits(scene: Scene, parameters: WhipParameters, xp=np) -> Iterator[Edit]:
    """All fields of a model that depend on parameters, as declared in `scene.build`.

    Args:
        scene: the scene that the model was compiled from.
        parameters: of one scene; NumPy's numbers for `xp=numpy`, JAX's for `xp=jax.numpy`.
        xp: the array library.
    """
    yield from dlo_edits(scene, parameters, xp)
    yield from cube_edits(scene, parameters, xp)


def dlo_edits(scene: Scene, parameters: WhipParameters, xp=np) -> Iterator[Edit]:
    """The fields of the DLO that depend on parameters."""
    chain, at = scene.chain, indices(scene)
    bodies, geoms, joints = at.links, at.link_geoms, at.joints
    lengths = chain.fractions * parameters.length
    along, across = link_inertias(lengths, parameters.density)
    radius, half = SECTION / 2, lengths / 2
    yield "body_pos", (bodies[1:], 0), lengths[:-1]
    yield "body_ipos", (bodies, 0), half
    yield "body_mass", bodies, link_masses(lengths, parameters.density)
    yield "body_inertia", bodies, xp.stack([along, across, across], axis=-1)
    yield "geom_pos", (geoms, 0), half
    yield "geom_size", (geoms, 1), half
    yield "geom_rbound", geoms, radius + half
    yield "geom_aabb", (geoms, 5), radius + half  # a capsule lies along its own z
    yield "jnt_stiffness", joints, chain.stiffness(parameters.length, parameters.young)
    yield "dof_damping", at.dofs, chain.damping(parameters.length, parameters.young)


def cube_edits(scene: Scene, parameters: WhipParameters, xp=np) -> Iterator[Edit]:
    """The fields of the cubes that depend on parameters."""
    side, density = parameters.cube_side, parameters.cube_density
    at = indices(scene)
    bodies, geoms, places = at.cubes, at.cube_geoms, at.cube_places
    positions = cube_positions(parameters, xp)
    yield "body_pos", bodies, positions
    yield "qpos0", places, positions
    yield "qpos_spring", places, positions
    yield "body_mass", bodies, density * side**3
    yield "body_inertia", bodies, density * side**5 / 6
    yield "geom_size", geoms, side / 2
    yield "geom_rbound", geoms, side / 2 * 3**0.5
    yield "geom_aabb", (geoms[:, None], np.arange(3, 6)), side / 2


@dataclasses.dataclass(frozen=True)
class _Indices:
    """Where the parts of a scene stand in its model.

    Attributes:
        links, link_geoms: bodies and geometries of the links, from the grip on.
        joints, dofs: the DLO's joints, and their degrees of freedom.
        cubes, cube_geoms: bodies and geometries of the cubes, bottom-up.
        cube_places: of the cubes' positions in qpos, shape [6, 3].
    """

    links: np.ndarray
    link_geoms: np.ndarray
    joints: np.ndarray
    dofs: np.ndarray
    cubes: np.ndarray
    cube_geoms: np.ndarray
    cube_places: np.ndarray


@functools.lru_cache(maxsize=8)
def indices(scene: Scene) -> _Indices:
    """Looked up once, as names cost more than the edits."""
    model, chain = base_model(scene), scene.chain
    joints = np.array([model.joint(f"joint{i}").id for i in range(1, chain.links)])
    free = [model.joint(name).id for name in cube_names()]
    return _Indices(
        links=np.array([model.body(name).id for name in link_names(chain)]),
        link_geoms=np.array([model.geom(name).id for name in link_names(chain)]),
        joints=joints,
        dofs=np.concatenate([model.jnt_dofadr[j] + np.arange(chain.dofs) for j in joints]),
        cubes=np.array([model.body(name).id for name in cube_names()]),
        cube_geoms=np.array([model.geom(name).id for name in cube_names()]),
        cube_places=model.jnt_qposadr[free][:, None] + np.arange(3),
    )


def edited_model(scene: Scene, parameters: WhipParameters, data: mujoco.MjData | None = None) -> mujoco.MjModel:
    """The model of `scene.compile_model`, made several times faster by editing the compiled median one."""
    return edited(base_model(scene), edits(scene, parameters), data)


def edited_bare_model(scene: Scene, parameters: WhipParameters, data: mujoco.MjData | None = None) -> mujoco.MjModel:
    """The model of a scene without its cubes; all other parts have the same indices."""
    return edited(bare_model(scene), dlo_edits(scene, parameters), data)


def edited(model: mujoco.MjModel, changes: Iterable[Edit], data: mujoco.MjData | None = None) -> mujoco.MjModel:
    """A copy of a model with fields changed, and those that MuJoCo derives from them.

    Args:
        model: to copy.
        changes: to its fields.
        data: memory to derive fields in, of a model of the same sizes, which is overwritten; allocating it would take
            longer than all the rest.
    """
    model = model.__copy__()
    for field, index, values in changes:
        getattr(model, field)[index] = values
    mujoco.mj_setConst(model, data or mujoco.MjData(model))
    model.stat.meaninertia = np.mean(model.dof_M0)  # scales the solver's tolerance
    return model
