"""The scene of a reference object as a MuJoCo model: a soft body in the gripper, table and cubes."""

import mujoco
import numpy as np

from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.parameters import MEDIAN, WhipParameters
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.rig import SECTION, STACK, START

SIMULATOR = f"MuJoCo {mujoco.__version__}, trilinear finite elements"
"""The simulator, as recordings name it."""
TIMESTEP = 0.002
"""Time step of the physics, in s."""
CELL = 0.0125
"""Approximate length of a finite element, in m; each spans the whole section."""
SKIN = 0.0005
"""Thickness of the contact layer around the finite elements, in m."""

PLACE = MEDIAN.replace(cube_density=1.54e-3 / 0.025**3)
"""The scene of the real DLOs: the median one, with cubes of 1.54 g (section VI-B)."""


def cells(dlo: ReferenceObject) -> int:
    """Number of finite elements along the object."""
    return round(dlo.length / CELL)


def whip_model(dlo: ReferenceObject, place: WhipParameters = PLACE) -> mujoco.MjModel:
    """The object hanging from the gripper beside the stack.

    Args:
        dlo: the object in the gripper.
        place: the scene, of which the cubes and the position of the stack are used.
    """
    x, z = START
    spec = _specification(
        dlo,
        (x, 0.0, z),
        f"""
        <geom name="table" type="plane" size="1 1 0.05" contype="1" conaffinity="1"/>
        <body name="gripper" pos="{x} 0 {z}" gravcomp="1">
          <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
          <joint name="x" type="slide" axis="1 0 0" ref="{x}"/>
          <joint name="z" type="slide" axis="0 0 1" ref="{z}"/>
          <geom type="box" size="0.02 0.015 0.03" pos="0 0 0.03" mass="0" contype="2" conaffinity="2"/>
        </body>
        {"".join(_cube(i, place) for i in range(len(COLOURS)))}
        """,
        """
        <actuator>
          <position name="x" joint="x" kp="900" kv="60"/>
          <position name="z" joint="z" kp="900" kv="60"/>
        </actuator>""",
    )
    # Not a child of the gripper: MuJoCo would then apply the soft body's forces to it twice.
    flex = spec.flexes[0]
    held = np.array(list(flex.nodebody)) == "world"
    flex.nodebody = np.where(held, "gripper", flex.nodebody).tolist()
    flex.node = (np.reshape(flex.node, (-1, 3)) - np.outer(held, [x, 0.0, z])).ravel()
    return spec.compile()


def cantilever_model(
    dlo: ReferenceObject, gravity: tuple[float, float, float], timestep: float = 0.01
) -> mujoco.MjModel:
    """The object alone, hanging from a clamp that does not move.

    Args:
        dlo: the object in the clamp.
        gravity: in m/s^2; along x the object is a horizontal cantilever.
        timestep: in s.
    """
    model = _specification(dlo).compile()
    model.opt.gravity, model.opt.timestep = gravity, timestep
    return model


def centreline(dlo: ReferenceObject, data: mujoco.MjData) -> np.ndarray:
    """Points of the object's axis from the grip to the tip, in m, shape [cells + 1, 3]."""
    levels = data.flexvert_xpos.reshape(2, 2, cells(dlo) + 1, 3)
    return levels.mean(axis=(0, 1))[::-1]


def _soft_body(dlo: ReferenceObject, top: tuple[float, float, float]) -> str:
    """Eight-noded cells, one behind the other, the topmost nodes fixed to the world."""
    n, side = cells(dlo), SECTION - 2 * SKIN
    middle = top[2] - dlo.length / 2
    return f"""
    <flexcomp name="dlo" type="grid" dim="3" dof="trilinear" count="2 2 {n + 1}" cellcount="1 1 {n}"
      spacing="{side} {side} {dlo.length / n}" pos="{top[0]} {top[1]} {middle}" mass="{dlo.mass}" radius="{SKIN}">
      <elasticity young="{dlo.young}" poisson="{dlo.poisson}" damping="{dlo.damping}"/>
      <contact contype="1" conaffinity="1" selfcollide="none" condim="3" friction="0.6" solref="0.01 1"/>
      <pin gridrange="0 0 {n} 1 1 {n}"/>
    </flexcomp>"""


def _cube(i: int, place: WhipParameters) -> str:
    side, (x, y) = float(place.cube_side), np.asarray(place.stack, float)
    return f"""
    <body name="{COLOURS[i]}" pos="{STACK + x} {y} {side * (i + 0.5)}">
      <freejoint/>
      <geom type="box" size="{side / 2} {side / 2} {side / 2}" density="{float(place.cube_density)}"
        contype="3" conaffinity="3"/>
    </body>"""


def _specification(dlo: ReferenceObject, top=(0.0, 0.0, 0.0), bodies: str = "", actuators: str = "") -> mujoco.MjSpec:
    # The discrete integrator takes the soft body's stiffness implicitly. With fewer iterations it does not converge
    # for stiff objects. A failed simulation must look like one: by default MuJoCo resets it to its beginning.
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco>
      <compiler boundmass="0" boundinertia="0"/>
      <option timestep="{TIMESTEP}" integrator="discrete" solver="CG" iterations="300" ls_iterations="20">
        <flag autoreset="disable"/>
      </option>
      <default><geom condim="3" friction="0.6" solref="0.01 1"/></default>
      <worldbody>{_soft_body(dlo, top)}{bodies}</worldbody>
      {actuators}
    </mujoco>""")
    # MuJoCo gives each node the same mass, so that the tip would have twice its own.
    n = cells(dlo)
    for body in spec.bodies:
        if body.name.startswith("dlo_"):
            tip = body.name.endswith("_0")
            body.mass = dlo.mass / n / (8 if tip else 4)
    return spec
