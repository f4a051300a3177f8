"""Settings of a model that MuJoCo simulates, and that MJX ignores or interprets differently.

MJX refuses much of what it cannot simulate, but not all. A setting that is not MuJoCo's default is refused here, by
name, unless MJX reads it or it makes no difference to the model. Options and flags that this table does not
know, such as those of a later release, are refused as well.
"""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

READ = frozenset(
    "cone density disableflags enableflags gravity impratio integrator iterations jacobian ls_iterations ls_tolerance "
    "magnetic sdf_initpoints solver timestep tolerance viscosity wind".split()
)
"""Options that MJX reads, or refuses itself."""
_CONVEX = [
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("HFIELD", "ELLIPSOID", "CYLINDER", "MESH", "SDF")
]


def _convex(model: mujoco.MjModel) -> bool:
    """Whether general convex shapes may collide, for which MuJoCo searches contacts iteratively."""
    return bool((np.isin(model.geom_type, _CONVEX) & ((model.geom_contype | model.geom_conaffinity) != 0)).any())


def _enabled(model: mujoco.MjModel, flag: mujoco.mjtEnableBit) -> bool:
    return bool(model.opt.enableflags & flag)


def _group_disabled(model: mujoco.MjModel) -> bool:
    return any(0 <= group <= 30 and model.opt.disableactuator >> int(group) & 1 for group in model.actuator_group)


_overridden = lambda model: _enabled(model, mujoco.mjtEnableBit.mjENBL_OVERRIDE)
_never, _always = lambda model: False, lambda model: True

OPTIONS: Mapping[str, Callable[[mujoco.MjModel], bool]] = {
    "ccd_iterations": _convex,
    "ccd_tolerance": _convex,
    "disableactuator": _group_disabled,
    "noslip_iterations": _always,
    "noslip_tolerance": lambda model: model.opt.noslip_iterations > 0,
    "o_friction": _overridden,
    "o_margin": _overridden,
    "o_solimp": _overridden,
    "o_solref": _overridden,
    "sdf_iterations": _convex,
    "sleep_tolerance": lambda model: _enabled(model, mujoco.mjtEnableBit.mjENBL_SLEEP),
}
"""Other options, and whether they make a difference to a model."""

DISABLED: Mapping[str, Callable[[mujoco.MjModel], bool]] = {
    **dict.fromkeys("constraint equality frictionloss limit contact gravity clampctrl warmstart".split(), _never),
    **dict.fromkeys("filterparent actuation refsafe sensor eulerdamp".split(), _never),  # MJX reads these
    **dict.fromkeys("midphase autoreset island".split(), _never),  # other ways to the same result
    **dict.fromkeys("spring damper".split(), _always),  # MJX leaves out all passive forces with either
    **dict.fromkeys("nativeccd multiccd".split(), _convex),
}
"""Disabled flags, and whether MJX then simulates a model differently."""
ENABLED: Mapping[str, Callable[[mujoco.MjModel], bool]] = {
    **dict.fromkeys("override energy fwdinv diagexact".split(), _never),  # MJX itself refuses these
    "invdiscrete": _never,  # inverse dynamics only
    **dict.fromkeys("sleep ipc".split(), _always),
}
"""Enabled flags, and whether MJX then simulates a model differently."""

ELEMENTS: Mapping[str, float] = {
    "actuator_actearly": 0,
    "actuator_armature": 0,
    "actuator_damping": 0,
    "actuator_dampingpoly": 0,
    "actuator_delay": 0,
    "actuator_plugin": -1,
    "body_plugin": -1,
    "dof_dampingpoly": 0,
    "geom_adhesion": 0,
    "geom_gap": 0,
    "geom_plugin": -1,
    "geom_surfacevel": 0,
    "jnt_stiffnesspoly": 0,
    "pair_adhesion": 0,
    "pair_gap": 0,
    "sensor_delay": 0,
    "sensor_interval": 0,
    "sensor_plugin": -1,
    "tendon_dampingpoly": 0,
    "tendon_stiffnesspoly": 0,
}
"""Attributes of elements that MJX does not read, and their values that do nothing."""
_RANGEFINDER, _TACTILE = int(mujoco.mjtSensor.mjSENS_RANGEFINDER), int(mujoco.mjtSensor.mjSENS_TACTILE)
_UNCUT = [int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}")) for kind in ("FRAMELINACC", "FRAMEANGACC", "CONTACT")]
"""Sensors whose cutoff MJX does not apply."""


class MjxWarning(UserWarning):
    """MJX integrates a model differently from MuJoCo if steps are long."""


def refuse_ignored(model: mujoco.MjModel) -> None:
    """Check that MJX reads everything in a model that makes a difference.

    Raises:
        ValueError: naming what it does not read, in one line.
    """
    if found := [*_options(model), *_flags(model), *_elements(model), *_sensors(model)]:
        raise ValueError(f"model: MJX cannot simulate it: it ignores or misreads {', '.join(found)}")


def warn_of_saturation(model: mujoco.MjModel) -> None:
    """Warn of actuators that MJX damps, with the integrator implicitfast, while their force is saturated."""
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return
    gain = (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_AFFINE)) & (model.actuator_gainprm[:, 2] != 0)
    bias = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)) & (model.actuator_biasprm[:, 2] != 0)
    several = np.flatnonzero((gain | bias) & (model.actuator_forcelimited != 0))
    if len(several):
        warnings.warn(
            f"model: while the force of {', '.join(_name(model, 'actuator', i) for i in several)} is at the end of its "
            "forcerange, implicitfast of MJX damps it by its velocity gain, and MuJoCo does not: keep the step short",
            MjxWarning,
            stacklevel=3,
        )


def option_names() -> list[str]:
    """All options that the installed MuJoCo has."""
    option = mujoco.MjOption()
    return [name for name in dir(option) if not name.startswith("_") and not callable(getattr(option, name))]


def flag_names(kind: Any) -> dict[int, str]:
    """Names of flags by their bits, as MJCF has them: of `mujoco.mjtDisableBit` or `mujoco.mjtEnableBit`."""
    return {int(bit): name.partition("_")[2].lower() for name, bit in kind.__members__.items() if "L_" in name}


def _options(model: mujoco.MjModel) -> list[str]:
    default, found = mujoco.MjOption(), []
    for name in option_names():
        changed = not np.array_equal(getattr(model.opt, name), getattr(default, name))
        if name not in READ and changed and OPTIONS.get(name, _always)(model):
            found.append("option/actuatorgroupdisable" if name == "disableactuator" else f"option/{name}")
    return found


def _flags(model: mujoco.MjModel) -> list[str]:
    found = []
    for kind, table, flags, state in (
        (mujoco.mjtDisableBit, DISABLED, model.opt.disableflags, "disable"),
        (mujoco.mjtEnableBit, ENABLED, model.opt.enableflags, "enable"),
    ):
        for bit, name in flag_names(kind).items():
            if flags & bit and table.get(name, _always)(model):
                found.append(f'flag {name}="{state}"')
    return found


def _elements(model: mujoco.MjModel) -> list[str]:
    found = []
    for field, nothing in ELEMENTS.items():
        values = np.asarray(getattr(model, field, np.zeros(0)))
        used = np.flatnonzero((values != nothing).any(axis=tuple(range(1, values.ndim))))
        kind, _, attribute = field.partition("_")
        if kind in ("dof", "jnt"):
            used, kind = model.dof_jntid[used] if kind == "dof" else used, "joint"
        found += [f"{attribute} of {kind} {_name(model, kind, i)}" for i in np.unique(used)]
    fluid = model.opt.density > 0 or model.opt.viscosity > 0 or model.opt.wind.any()
    for i in np.flatnonzero(model.geom_fluid.any(axis=1)) if fluid else ():
        found.append(f"fluidshape of geom {_name(model, 'geom', i)}")
    return found


def _sensors(model: mujoco.MjModel) -> list[str]:
    found = []
    for i, kind in enumerate(model.sensor_type):
        several = kind == _RANGEFINDER and (
            model.sensor_objtype[i] != int(mujoco.mjtObj.mjOBJ_SITE) or model.sensor_intprm[i, 0] != 1
        )
        if kind == _TACTILE or several:
            found.append(f"sensor {_name(model, 'sensor', i)}")
        elif kind in _UNCUT and model.sensor_cutoff[i]:
            found.append(f"cutoff of sensor {_name(model, 'sensor', i)}")
    return found


def _name(model: mujoco.MjModel, kind: str, number: int | np.integer) -> str:
    return getattr(model, kind)(int(number)).name or str(number)
