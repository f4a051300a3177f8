"""Models without purely visual parts, which MuJoCo would compile every time: meshes, textures and materials.

A mesh is left out where its geoms neither collide nor make up a body's mass, and nothing else refers to them. Whether
the rest is the same model, number for number, is checked by compiling both.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco.parameters import PATTERN
from jaxlfi.envs.mujoco.ties import expression

SEEING = (mujoco.mjtSensor.mjSENS_RANGEFINDER, mujoco.mjtSensor.mjSENS_TACTILE, mujoco.mjtSensor.mjSENS_PLUGIN)
"""Sensors that detect geoms which do not collide."""
_OF_LOOKS = ("n", "geom", "bvh", "oct", "mesh", "tex", "mat", "vis", "skin", "path")
"""Prefixes of fields that may differ between a model with and without visual parts: sizes, names and these."""
_ALSO = frozenset(
    "buffer signature body_geomnum body_geomadr body_bvhadr body_bvhnum dof_length site_matid tendon_matid".split()
)
"""Further such fields; lengths of degrees of freedom matter only to sleep, with which models stay whole."""


def without(spec: mujoco.MjSpec, model: mujoco.MjModel, names: Sequence[str]) -> mujoco.MjSpec:
    """A specification without purely visual parts; itself, if that would make a difference.

    Args:
        spec: of a model; it stays as it is.
        model: as compiled.
        names: of parameters, whose geoms stay.
    """
    asleep = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    if model.nplugin or asleep or any(sensor.type in SEEING for sensor in spec.sensors):
        return spec
    bare = spec.copy()
    for geom in [geom for geom in bare.geoms if _only_seen(bare, geom) and not _named(geom.name, names)]:
        bare.delete(geom)
    used = {geom.meshname for geom in bare.geoms}
    left_out = [mesh for mesh in bare.meshes if mesh.name not in used]
    if not (bare.skins or bare.flexes):
        for one in (*bare.geoms, *bare.sites, *bare.tendons):
            one.material = ""
        left_out += [*bare.materials, *bare.textures]
    if not left_out:
        return spec
    for asset in left_out:
        bare.delete(asset)
    try:
        return bare if same(model, bare.copy().compile()) else spec
    except ValueError:  # something refers to a part that was left out
        return spec


def same(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether two compiled models move alike: all their numbers except visual ones are the same."""
    for name in dir(one):
        before = getattr(one, name, None)
        if name.startswith(("_", *_OF_LOOKS)) or name in _ALSO or callable(before):
            continue
        if isinstance(before, np.ndarray | int | float) and not np.array_equal(before, getattr(other, name)):
            return False
    return _colliding(one) == _colliding(other) and one.stat.meaninertia == other.stat.meaninertia


def _colliding(model: mujoco.MjModel) -> list[bytes]:
    """All fields of colliding geoms that collisions depend on."""
    fields = [name for name in dir(model) if name.startswith("geom_") and name not in ("geom_matid", "geom_dataid")]
    hit = np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0)
    return [np.asarray(getattr(model, name))[hit].tobytes() for name in fields]


def _only_seen(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    if geom.type != mujoco.mjtGeom.mjGEOM_MESH or geom.contype or geom.conaffinity or geom.fluid_ellipsoid:
        return False
    if not geom.parent.explicitinertial and geom.mass != 0 and geom.density != 0:
        return False
    referred = {(sensor.objname, sensor.refname) for sensor in spec.sensors}
    referred |= {(pair.geomname1, pair.geomname2) for pair in spec.pairs}
    return not geom.name or not any(geom.name in two for two in referred)


def _named(geom: str, names: Sequence[str]) -> bool:
    """Whether any parameter is of a geom."""
    own = [name.partition("/")[2].rpartition("/")[0] for name in names if name.startswith("geom/")]
    return any(expression(one).fullmatch(geom) if PATTERN.search(one) else one == geom for one in own)
