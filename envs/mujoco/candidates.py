"""Uncertain parameters of a model, each with the model's own value and a first guess.

Joint damping and friction, rotor inertia, masses, gains and the control delay are what robot models most often get
wrong. Where the model has a value, the first guess is a factor around it; where it has none, the first guess follows
from the joint's inertia and the forces that act on it.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import columns, measured, parameters, servos
from jaxlfi.envs.mujoco.logs import Log

FACTOR, OF_MASSES, BEYOND = 3.0, 1.5, 10.0
"""Factors between a value and the bounds of its first guess, in general and of masses, and from those to Phi's."""
OFFSET = 0.02
"""First guess of a sensor's bias, as a fraction of the signal's range."""
MOST = 3
"""Largest number of candidates that are inferred by default."""
POSES = 16
"""Random poses at which the forces on the joints are evaluated."""
_OF_HINGES = {"damping": "N m s/rad", "frictionloss": "N m", "armature": "kg m^2", "stiffness": "N m/rad"}
_OF_SLIDES = {"damping": "N s/m", "frictionloss": "N", "armature": "kg", "stiffness": "N/m"}


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A parameter that may be inferred.

    Attributes:
        name: as in `parameters`.
        now: the model's value.
        support: bounds of a first guess, Theta_0.
        feasible: bounds of what is possible, Phi.
        unit: for tables.
        log: whether its logarithm is inferred.
        chosen: whether it is inferred by default.
    """

    name: str
    now: float
    support: tuple[float, float]
    feasible: tuple[float, float]
    unit: str = ""
    log: bool = False
    chosen: bool = False


def candidates(
    spec: mujoco.MjSpec, model: mujoco.MjModel, recorded: Sequence[Log], compared: Sequence[str]
) -> list[Candidate]:
    """Parameters of a model that may be inferred from recordings.

    Args:
        spec: of the model.
        model: with a sensor for each signal that is compared.
        recorded: recordings as tasks read them.
        compared: names of the signals that are compared.
    """
    found = []
    acting = _acting(model, recorded)
    seen = _seen(model, compared)
    for one in _of_all(model, recorded, compared, acting):
        kind = one.name.partition("/")[0]
        if one.name.endswith("/mass") and _masses_are_derived(spec):
            continue
        try:
            if kind not in ("control", "sensor"):
                parameters.edit(spec, model, one.name)
        except ValueError:
            continue  # equivalent to what the model states
        found.append(one)
    # Driven joints are the most informative; a base that slides through the world has hardly any friction.
    driven = {model.joint(int(joint)).name for joint in _driven(model)}
    by_driven = sorted(seen, key=lambda joint: joint not in driven)
    names = [one.name for one in found]
    wanted = [name for joint in by_driven if (name := f"joint/{joint}/damping") in names][:MOST] or names[:1]
    return [dataclasses.replace(one, chosen=one.name in wanted) for one in found]


def _of_all(
    model: mujoco.MjModel, recorded: Sequence[Log], compared: Sequence[str], acting: np.ndarray
) -> Iterator[Candidate]:
    yield from _of_joints(model, acting)
    for i in range(1, model.nbody):
        name, mass = model.body(i).name, float(model.body_mass[i])
        if name and mass > 0 and model.body_weldid[i]:
            yield _around(f"body/{name}/mass", mass, "kg", OF_MASSES)
    yield from _of_actuators(model)
    controls = [log.samples(name)[0] for name in columns.controls_of(model) for log in recorded if name in log.signals]
    if intervals := [float(np.median(np.diff(times))) for times in controls if len(times) > 1]:
        most = _rounded(5 * float(np.median(intervals)))
        yield Candidate("control/delay", 0.0, (0.0, most), (0.0, 5 * most), "s")
    for name in compared:
        unit = measured.unit(model, name)
        if unit in ("rad", "m") and not name.startswith("body/"):
            spans = [np.ptp(log.samples(name)[1]) for log in recorded if name in log.signals]
            reach = _rounded(OFFSET * float(max(spans, default=0.0)))
            if reach:
                bounds = (-reach, reach)
                yield Candidate(
                    f"sensor/{name.removeprefix('sensor/')}/bias", 0.0, bounds, (-5 * reach, 5 * reach), unit
                )
    for i in map(int, np.flatnonzero(_touching(model))):
        if (name := model.geom(i).name) and model.geom_friction[i, 0] > 0:
            yield _around(f"geom/{name}/friction[0]", float(model.geom_friction[i, 0]), "")


def _touching(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms may touch a geom of another body, by MuJoCo's contact filter; shape [ngeom]."""
    kinds, affinities, bodies = model.geom_contype, model.geom_conaffinity, model.body_weldid[model.geom_bodyid]
    parents = model.body_weldid[model.body_parentid[bodies]]
    may = kinds[:, None] & affinities | (kinds[:, None] & affinities).T
    related = (parents[:, None] == bodies) & (bodies > 0)
    return (may.astype(bool) & (bodies[:, None] != bodies) & ~related & ~related.T).any(axis=1)


def _of_joints(model: mujoco.MjModel, acting: np.ndarray) -> Iterator[Candidate]:
    """Damping, friction, armature and stiffness of hinges and slides."""
    for i in range(model.njnt):
        name, kind, dof = model.joint(i).name, mujoco.mjtJoint(model.jnt_type[i]), int(model.jnt_dofadr[i])
        units = {mujoco.mjtJoint.mjJNT_HINGE: _OF_HINGES, mujoco.mjtJoint.mjJNT_SLIDE: _OF_SLIDES}.get(kind)
        if not name or units is None:
            continue
        inertia = float(model.dof_M0[dof])
        largest = {"damping": 2 * inertia, "frictionloss": 0.1 * float(acting[dof]), "armature": 0.5 * inertia}
        values = {
            "damping": float(np.ravel(model.dof_damping[dof])[0]),
            "frictionloss": float(model.dof_frictionloss[dof]),
            "armature": float(model.dof_armature[dof]),
            "stiffness": float(np.ravel(model.jnt_stiffness[i])[0]),
        }
        for attribute, value in values.items():
            if value > 0:
                yield _around(f"joint/{name}/{attribute}", value, units[attribute])
            elif _rounded(largest.get(attribute, 0.0)) > 0:
                most = _rounded(largest[attribute])
                yield Candidate(f"joint/{name}/{attribute}", 0.0, (0.0, most), (0.0, BEYOND * most), units[attribute])


def _of_actuators(model: mujoco.MjModel) -> Iterator[Candidate]:
    """Gains of servos, and gears of motors."""
    for i in range(model.nu):
        element = f"actuator/{model.actuator(i).name or i}"
        if mujoco.mjtGain(model.actuator_gaintype[i]) != mujoco.mjtGain.mjGAIN_FIXED:
            continue
        unit = _OF_HINGES if measured.control_units(model, i)[:1] in (("rad",), ("rad/s",)) else _OF_SLIDES
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
        if mujoco.mjtBias(model.actuator_biastype[i]) == mujoco.mjtBias.mjBIAS_NONE:
            if (gear := float(model.actuator_gear[i, 0])) > 0:
                yield _around(f"{element}/gear[0]", gear, "")
        elif gain > 0 and bias[1] == -gain:
            yield _around(f"{element}/{servos.GAINS[0]}", float(gain), unit["stiffness"])
            if bias[2] < 0:
                yield _around(f"{element}/{servos.GAINS[1]}", float(-bias[2]), unit["damping"])
        elif gain > 0 and bias[2] == -gain:
            yield _around(f"{element}/{servos.GAINS[1]}", float(gain), unit["damping"])


def _around(name: str, value: float, unit: str, factor: float = FACTOR) -> Candidate:
    support = _rounded(value / factor), _rounded(value * factor)
    return Candidate(
        name, value, support, (_rounded(support[0] / BEYOND), _rounded(support[1] * BEYOND)), unit, log=True
    )


def _rounded(number: float) -> float:
    """The number to two digits, as a person would write it."""
    return float(f"{number:.2g}")


def _acting(model: mujoco.MjModel, recorded: Sequence[Log]) -> np.ndarray:
    """The largest force on each degree of freedom: of gravity at some poses, and of the recorded controls."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    for i, name in enumerate(columns.controls_of(model)):
        largest = [np.abs(log.samples(name)[1]).max() for log in recorded if name in log.signals]
        data.ctrl[i] = max(largest, default=0.0)
    most = np.zeros(model.nv)
    for _ in range(POSES):
        mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 1.0)
        mujoco.mj_forward(model, data)
        most = np.maximum(most, np.maximum(np.abs(data.qfrc_bias), np.abs(data.qfrc_actuator)))
    return most


def _seen(model: mujoco.MjModel, compared: Sequence[str]) -> list[str]:
    """Names of the joints whose position or velocity is compared, in the model's order."""
    kinds = (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL)
    items = {item for kind, item in (measured.of_sensor(model, name) for name in compared) if kind in kinds}
    return [model.joint(item).name for item in sorted(items)]


def _driven(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the joints that actuators act on."""
    of_joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return model.actuator_trnid[np.isin(model.actuator_trntype, of_joints), 0]


def _masses_are_derived(spec: mujoco.MjSpec) -> bool:
    """Whether masses follow from geoms, or from a given total, and not from the bodies' own."""
    return bool(
        spec.compiler.settotalmass > 0
        or spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    )
