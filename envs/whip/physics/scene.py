"""The whipping scene as a MuJoCo model: gripper, DLO, table and six stacked cubes (sections VI-A to VI-C)."""

import dataclasses
import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from jaxlfi.envs.whip import frames
from jaxlfi.envs.whip.parameters import MEDIAN, WhipParameters
from jaxlfi.envs.whip.physics.chain import Chain, link_inertias, link_masses
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, GRAVITY, HAND, RGBA, SECTION, STACK, START

CUBES = len(frames.COLOURS)
SINKING = np.array([40.06, 106.59, 159.92, 199.98, 226.71, 240.08]) * 1e-6
"""Total penetration of the contacts below each cube of a stack at rest, bottom-up, in m.

It follows from the softness of the contacts and does not depend on the cubes' size and density.
"""


@dataclasses.dataclass(frozen=True)
class Scene:
    """Settings of the simulation that all scenes share.

    Attributes:
        chain: division of the DLO into links.
        timestep: of the physics, in s.
        iterations: of Newton's solver; with 2 the stack of cubes explodes.
        line_search: iterations of the solver's line search.
        air: density of the air, which causes drag on the DLO, in kg/m^3.
        stiffness, damping: of the impedance controller of the gripper, in N/m and N s/m: critical damping at 30 rad/s
            for its mass of 1 kg.
        control_interval: between two actions, in s.
    """

    chain: Chain = Chain()
    timestep: float = 0.004
    iterations: int = 10
    line_search: int = 20
    air: float = 1.2
    stiffness: float = 900.0
    damping: float = 60.0
    control_interval: float = CONTROL_INTERVAL

    @property
    def substeps(self) -> int:
        """Number of physics steps between two actions."""
        return round(self.control_interval / self.timestep)

    @property
    def first_cube(self) -> int:
        """Index of the first cube's position in qpos."""
        return 2 + self.chain.elements * (1 if self.chain.planar else 4)


def compile_model(scene: Scene, parameters: WhipParameters = MEDIAN) -> mujoco.MjModel:
    """The MuJoCo model of one scene, with parameters in NumPy or Python numbers.

    Raises:
        ValueError: if the model has plugins, which MJX would ignore silently.
    """
    return refuse_plugins(build(scene, parameters).compile())


def refuse_plugins(model: mujoco.MjModel) -> mujoco.MjModel:
    """Refuse models with plugins, which MJX ignores silently, so that the engines would differ.

    Raises:
        ValueError: if there are any.
    """
    if model.nplugin:
        raise ValueError(f"model: expected no plugins, as MJX ignores them silently, got {model.nplugin}")
    return model


def build(scene: Scene, parameters: WhipParameters = MEDIAN) -> mujoco.MjSpec:
    """The specification of one scene, to be compiled or changed."""
    spec = mujoco.MjSpec.from_string(_cable_xml(scene.chain, parameters))
    spec.modelname = "whip"
    option = spec.option
    option.timestep = scene.timestep
    option.gravity = (0, 0, -GRAVITY)
    option.density = scene.air
    # Implicit in the velocities by the joints' damping; MJX has no drag for implicitfast.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations, option.ls_iterations, option.tolerance = scene.iterations, scene.line_search, 1e-8
    # A failed simulation must look like one: by default MuJoCo resets it to its beginning.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.boundmass = spec.compiler.boundinertia = 0
    _add_gripper(spec, scene)
    _make_beam(spec, scene.chain, parameters)
    _add_cubes(spec, parameters)
    _add_contacts(spec, scene.chain)
    # Of MJX: the most contacts that are solved for, and that geometries are tested for.
    spec.add_numeric(name="max_contact_points", data=[48])
    spec.add_numeric(name="max_geom_pairs", data=[24])
    return spec


def link_names(chain: Chain) -> list[str]:
    """Names of the links' bodies and geometries, from the grip on."""
    return [f"link{i}" for i in range(chain.links)]


def cube_names() -> list[str]:
    """Names of the cubes' bodies, joints and geometries, bottom-up."""
    return [f"{colour} cube" for colour in frames.COLOURS]


def cube_positions(parameters: WhipParameters, xp=np):
    """Centres of the cubes at rest, shape [6, 3], in m."""
    side, stack = parameters.cube_side, parameters.stack
    heights = side * (xp.arange(CUBES) + 0.5) - SINKING
    return xp.stack([xp.full(CUBES, STACK) + stack[0], xp.zeros(CUBES) + stack[1], heights], axis=-1)


def _cable_xml(chain: Chain, parameters: WhipParameters) -> str:
    """MuJoCo's cable, held by the gripper, with its joints at the middle of the elements, along its own x axis."""
    ends = np.concatenate([[0.0], np.cumsum(chain.fractions)]) * float(parameters.length)
    vertices = " ".join(f"{x:.17g} 0 0" for x in ends)
    return f"""
    <mujoco><worldbody><body name="gripper" pos="{START[0]} 0 {START[1]}"><body name="grip" quat="0.5 0 0.5 0">
      <composite prefix="cable" type="cable" vertex="{vertices}" initial="none">
        <joint kind="main"/> <geom type="capsule" size="{SECTION / 2}" contype="0" conaffinity="0"/>
      </composite>
    </body></body></worldbody></mujoco>"""


def _set_inertia(body: mujoco.MjsBody, mass: float, inertia: list[float], at: Sequence[float] = (0, 0, 0)) -> None:
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = mass, inertia, at


def _add_gripper(spec: mujoco.MjSpec, scene: Scene) -> None:
    table = spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.05], rgba=RGBA["table"]
    )
    table.contype = table.conaffinity = 0
    gripper = spec.body("gripper")
    gripper.gravcomp = 1
    _set_inertia(gripper, 1.0, [1e-3] * 3)
    hand = gripper.add_geom(
        name="gripper",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=HAND,
        pos=[0, 0, HAND[2]],
        rgba=RGBA["gripper"],
    )
    hand.contype = hand.conaffinity = 0
    for name, axis, start in (("x", [1, 0, 0], START[0]), ("z", [0, 0, 1], START[1])):
        gripper.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, ref=start)
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=scene.stiffness, kv=scene.damping)


def _make_beam(spec: mujoco.MjSpec, chain: Chain, parameters: WhipParameters) -> None:
    """Give the cable's links the mass and inertia of the square section, and its joints the beam's stiffness."""
    length, young, density = float(parameters.length), float(parameters.young), float(parameters.density)
    for part in (*spec.excludes, *spec.sites):  # all contacts are explicit pairs
        spec.delete(part)
    bodies = [body for body in spec.bodies if body.name.startswith("cable")]
    lengths = chain.fractions * length
    along, across = link_inertias(lengths, density)
    masses = link_masses(lengths, density)
    for i, (name, body) in enumerate(zip(link_names(chain), bodies, strict=True)):
        body.name = name
        _set_inertia(body, masses[i], [along[i], across[i], across[i]], at=[lengths[i] / 2, 0, 0])
        geom = body.geoms[0]
        geom.name, geom.rgba, geom.mass = name, RGBA["dlo"], 0
        for joint in body.joints:
            joint.name = f"joint{i}"
            joint.stiffness[0] = chain.stiffness(length, young)
            joint.damping[0] = chain.damping(length, young)
            if chain.planar:
                joint.type, joint.axis = mujoco.mjtJoint.mjJNT_HINGE, [0, 1, 0]


def _add_cubes(spec: mujoco.MjSpec, parameters: WhipParameters) -> None:
    side, density = float(parameters.cube_side), float(parameters.cube_density)
    for name, colour, place in zip(cube_names(), frames.COLOURS, cube_positions(parameters), strict=True):
        body = spec.worldbody.add_body(name=name, pos=place)
        _set_inertia(body, density * side**3, [density * side**5 / 6] * 3)
        body.add_freejoint(name=name)
        geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[side / 2] * 3, rgba=RGBA[colour], mass=0)
        geom.contype = geom.conaffinity = 0


def _add_contacts(spec: mujoco.MjSpec, chain: Chain) -> None:
    """The pairs that can touch: everything with the table and the cubes, but not the DLO with itself."""
    links, cubes = link_names(chain), cube_names()
    pairs = [("table", cube) for cube in cubes]
    pairs += [(cubes[i], cubes[j]) for i in range(CUBES) for j in range(i + 1, CUBES)]
    pairs += [(link, cube) for link in links for cube in cubes]
    pairs += [("table", link) for link in links[1:]]
    pairs += [("gripper", cube) for cube in cubes]
    for first, second in pairs:
        spec.add_pair(
            geomname1=first,
            geomname2=second,
            condim=3,
            friction=[0.6, 0.6, 0.005, 0.0001, 0.0001],
            solref=[0.01, 1],
            solimp=[0.9, 0.95, 0.001, 0.5, 2],
        )


@functools.lru_cache(maxsize=8)
def base_model(scene: Scene) -> mujoco.MjModel:
    """The model of the median scene, from which all others differ in numbers only."""
    return compile_model(scene)


@functools.lru_cache(maxsize=8)
def bare_model(scene: Scene) -> mujoco.MjModel:
    """The median scene as in `base_model` but without cubes, and with position sensors.

    The sensors report the centres of the gripper and of the links, in m.
    """
    spec = build(scene)
    for pair in list(spec.pairs):
        if pair.geomname2 in cube_names():
            spec.delete(pair)
    for name in cube_names():
        spec.delete(spec.body(name))
    for name in ("gripper", *link_names(scene.chain)):
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=name, name=name
        )
    return refuse_plugins(spec.compile())
