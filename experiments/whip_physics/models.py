"""Chains to compare, each alone and clamped at the grip: MuJoCo's plain cable, and the beams made of it."""

import mujoco
import numpy as np

from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.chain import Chain, elasto_gravity
from jaxlfi.envs.whip.physics.scene import Scene, build, cube_names
from jaxlfi.envs.whip.rig import SECTION

KINDS = ("plain cable", "ball joints", "planar hinges")


def model(kind: str, elements: int, parameters: WhipParameters) -> mujoco.MjModel:
    """The DLO alone, hanging from a fixed grip, without weight or air.

    Args:
        kind: one of `KINDS`: MuJoCo's cable with equal elements, of which the first is held, and joints between them;
            ours with ball joints at the middle of elements; ours with hinges.
        elements: number of elements N.
        parameters: parameters as Python or NumPy numbers.

    Raises:
        ValueError: for another kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    chain = Chain(elements=elements, planar=kind == "planar hinges")
    made = _plain_cable(chain, parameters) if kind == "plain cable" else _clamped(chain, parameters)
    made.opt.gravity = 0
    made.opt.density = 0
    return made


def _clamped(chain: Chain, parameters: WhipParameters) -> mujoco.MjModel:
    """The scene without its cubes, contacts and actuators, with the gripper fixed."""
    spec = build(Scene(chain=chain), parameters)
    for part in (*spec.pairs, *spec.actuators, *spec.body("gripper").joints, *map(spec.body, cube_names())):
        spec.delete(part)
    return spec.compile()


def _plain_cable(chain: Chain, parameters: WhipParameters) -> mujoco.MjModel:
    """MuJoCo's cable composite of capsules with the DLO's density, whose joints have the stiffness E I / h.

    MuJoCo's plugin for a cable's elasticity gives the same stiffness, with I from the section of the geometries.
    """
    ends = np.linspace(0, float(parameters.length), chain.elements + 1)
    vertices = " ".join(f"{x:.17g} 0 0" for x in ends)
    stiffness, damping = (f(parameters.length, parameters.young) for f in (chain.stiffness, chain.damping))
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><worldbody><body name="grip" quat="0.5 0 0.5 0" pos="0.4 0 0.36">
      <composite prefix="cable" type="cable" vertex="{vertices}" initial="none">
        <joint kind="main" stiffness="{stiffness}" damping="{damping}"/>
        <geom type="capsule" size="{SECTION / 2}" density="{parameters.density}" contype="0" conaffinity="0"/>
      </composite>
    </body></worldbody></mujoco>""")


def with_number(parameters: WhipParameters, number: float) -> WhipParameters:
    """The same DLO with the Young's modulus that gives it this elasto-gravity number."""
    young = elasto_gravity(parameters.length, 1.0, parameters.density) / number
    return parameters.replace(young=young)
