"""Models that are made without compiling their meshes anew are those that MuJoCo compiles, number for number."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import stand_in
from jaxlfi.envs.mujoco.effects import built, effects
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter, saved
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.envs.mujoco.stand_in import StandIn

TEXT = """
<mujoco><option timestep="0.002"/>
  <asset><mesh name="foot" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .3 .1 .1 .1"/></asset>
  <worldbody><geom name="ground" type="plane" size="2 2 .1" friction="0.7"/>
    <body name="leg" pos="0 0 0.5"><joint name="slide" type="slide" axis="0 0 1"/>
      <geom name="thigh" type="capsule" size=".03 .1" mass="0.5"/>
      <body name="toe" pos=".1 0 -.2"><joint name="hinge" axis="0 1 0" damping="0.05"/>
        <geom name="sole" type="mesh" mesh="foot" density="400"/>
        <body name="load" pos="0 0 .1"><joint axis="0 1 0" stiffness="1"/>
          <geom type="sphere" size=".02" mass="0.2"/></body></body></body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/><jointpos name="height" joint="slide"/></sensor>
</mujoco>
"""
FREE = {
    "joint/hinge/damping": (0.01, 0.5),
    "body/toe/mass": (0.1, 2.0),
    "body/load/mass": (-0.4, 1.0),
    "body/load/ipos[0]": (-0.05, 0.05),
    "actuator/servo/kp": (5.0, 50.0),
    "geom/ground/friction[0]": (0.2, 1.0),
    "geom/thigh/size[0]": (0.02, 0.04),
    "option/gravity[2]": (-11.0, -9.0),
}
"""Parameters on which meshes, and what is derived of them, do not depend; some masses are refused."""


def of(bounds, text=TEXT):
    """The function that makes models, and the one that compiles them whole."""
    spec = mujoco.MjSpec.from_string(text)
    supports = [(abs(low) / 2, high) if "mass" in name else (low, high) for name, (low, high) in bounds.items()]
    does = effects(spec, spec.copy().compile(), list(bounds), supports, ["angle", "height"])
    build = stand_in.builder(spec, does, *np.array(list(bounds.values())).T)
    return build, lambda theta: built(spec, does, theta)


def numbers(build, theta):
    """All of a model but for what only views depend on, or that MuJoCo refuses it."""
    try:
        model = build(theta)
    except ValueError:
        return "refused"
    model.stat.extent = model.stat.meansize = model.stat.meanmass = 1.0
    model.stat.center = 0.0
    return saved(model)


def test_models_are_those_that_are_compiled_whole():
    build, whole = of(FREE)
    assert isinstance(build, StandIn)
    low, high = np.array(list(FREE.values())).T
    several = np.random.default_rng(7).uniform(low, high, (12, len(low)))
    found = [numbers(build, theta) for theta in several]
    assert found == [numbers(whole, theta) for theta in several]
    assert 0 < found.count("refused") < 8
    first, again = build(0.3 * low + 0.7 * high), build(high)
    assert first.body_mass[2] != again.body_mass[2]  # no two share their numbers


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ({"geom/sole/density": (100.0, 900.0)}, TEXT),
        ({"body/toe/ipos[0]": (-0.1, 0.1)}, TEXT),
        ({"body/toe/inertial[4]": (-0.2, 0.2)}, TEXT),
        ({"joint/hinge/damping": (0.01, 0.5)}, TEXT.replace('type="mesh" mesh="foot"', 'size=".1"')),
        (
            {"joint/hinge/damping": (0.01, 0.5)},
            TEXT.replace("/></asset>", "/></asset><option><flag sleep='enable'/></option>"),
        ),
    ],
)
def test_what_meshes_depend_on_is_compiled_whole(bounds, text):
    build, whole = of(bounds, text)
    assert not isinstance(build, StandIn)
    theta = np.array([high for _, high in bounds.values()])
    assert saved(build(theta)) == saved(whole(theta))


def test_simulations_are_the_same(monkeypatch):
    """A leg that falls on its foot and is moved by its servo."""
    times = 0.01 * np.arange(60)
    log = Log(times, {"servo": 0.5 * np.sin(9 * times), "angle": 0 * times, "height": -0.1 * times})
    several = [Parameter("body/toe/mass", (0.2, 1.0)), Parameter("joint/hinge/damping", (0.01, 0.5))]

    def simulated():
        simulator = simulator_of(
            mujoco_task(TEXT, several, log, noises={"angle": 0.01, "height": 0.01}, begins="model")
        )
        return simulator, simulator.clean(np.array([[0.3, 0.05], [0.9, 0.4]]))

    simulator, (rows, outcome) = simulated()
    assert isinstance(simulator.build, StandIn) and not outcome.any()
    monkeypatch.setattr(stand_in, "builder", lambda spec, does, low, high: lambda theta: built(spec, does, theta))
    _, (expected, _) = simulated()
    np.testing.assert_array_equal(rows, expected)
    assert np.abs(rows[0] - rows[1]).max() > 1e-3
