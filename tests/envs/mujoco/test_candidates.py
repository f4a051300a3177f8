"""Numbers of a model that a task's file offers, against the model."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import candidates, measured
from jaxlfi.envs.mujoco.logs import Log

LEG = """
<mujoco>
  <compiler {compiler}/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction="0.7"/>
    <body name="trunk" pos="0 0 1">
      <joint name="rail" type="slide" axis="0 0 1"/>
      <geom name="trunk" size="0.1" mass="2"/>
      <body name="thigh" pos="0 0 -0.1">
        <joint name="hip" axis="0 1 0" damping="0.3" armature="0.02"/>
        <geom name="thigh" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
        <body name="shank" pos="0 0 -0.3">
          <joint name="knee" axis="0 1 0" frictionloss="0.06" stiffness="4"/>
          <geom name="foot" type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.015" mass="0.1"/>
        </body>
      </body>
    </body>
    <body name="stand"><geom name="stand" size="0.1" pos="4 0 0" mass="9"/></body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="20" kv="0.5"/>
    <motor joint="knee" gear="3"/>
    <velocity name="winch" joint="rail" kv="7"/>
  </actuator>
</mujoco>
"""


def offered(compared, controls=("hip",), compiler='angle="radian"', once=()):
    spec = mujoco.MjSpec.from_string(LEG.format(compiler=compiler))
    own = spec.copy()
    measured.add_sensors(own, compared)
    times = 0.01 * np.arange(200)
    signals = {name: np.sin(times) for name in (*compared, *controls)}
    signals |= {name: np.where(times == 0.5, 1.0, np.nan) for name in once}
    found = candidates.candidates(spec, own.compile(), [Log(times, signals)], compared)
    return {one.name: one for one in found}


def test_values_are_those_of_the_model_and_first_guesses_are_around_them():
    found = offered(["joint/knee/qpos", "joint/hip/qvel"])
    expected = {
        "joint/hip/damping": 0.3, "joint/hip/armature": 0.02, "joint/hip/frictionloss": 0.0,
        "joint/knee/damping": 0.0, "joint/knee/frictionloss": 0.06, "joint/knee/stiffness": 4.0,
        "joint/rail/damping": 0.0, "body/trunk/mass": 2.0, "body/thigh/mass": 0.4, "body/shank/mass": 0.1,
        "actuator/hip/kp": 20.0, "actuator/hip/kv": 0.5, "actuator/1/gear[0]": 3.0, "actuator/winch/kv": 7.0,
        "control/delay": 0.0, "sensor/joint/knee/qpos/bias": 0.0,
        "geom/floor/friction[0]": 0.7, "geom/foot/friction[0]": 1.0, "geom/trunk/friction[0]": 1.0,
    }  # fmt: skip
    assert {name: found[name].now for name in expected} == pytest.approx(expected)
    for one in found.values():
        assert one.feasible[0] <= one.support[0] <= one.now <= one.support[1] <= one.feasible[1]
        assert one.support[0] < one.support[1] and (one.feasible[0] > 0) == one.log
    assert found["joint/hip/damping"].unit == "N m s/rad" and found["joint/rail/damping"].unit == "N s/m"
    assert found["actuator/hip/kp"].unit == "N m/rad" and found["actuator/winch/kv"].unit == "N s/m"
    assert found["control/delay"].support == (0.0, pytest.approx(0.05))


def test_what_stands_still_or_touches_nothing_is_left_out():
    found = offered(["joint/knee/qpos"])
    assert not {"body/stand/mass", "geom/thigh/friction[0]", "sensor/joint/hip/qpos/bias"} & set(found)
    assert "control/delay" not in offered(["joint/knee/qpos"], controls=())
    assert "control/delay" not in offered(["joint/knee/qpos"], once=("hip",))


@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'settotalmass="5"'])
def test_masses_that_the_compiler_derives_are_left_out(compiler):
    found = offered(["joint/knee/qpos"], compiler=compiler)
    assert found and not any(name.endswith("/mass") for name in found)


def test_first_guesses_of_what_a_model_lacks_are_of_the_size_of_what_acts():
    """Friction is below the joint's gravity torque, and damping stops it within a few seconds at most."""
    found = offered(["joint/knee/qpos"])
    # The trunk and the leg weigh 24.5 N, which is on the rail at every pose.
    assert found["joint/rail/frictionloss"].support[1] == pytest.approx(0.1 * 2.5 * 9.81, rel=0.2)
    assert found["joint/rail/damping"].support[1] == pytest.approx(2 * 2.5, rel=0.05)


def test_the_damping_of_measured_joints_is_chosen_first_of_those_that_are_driven():
    chosen = lambda found: [name for name, one in found.items() if one.chosen]
    assert chosen(offered(["joint/knee/qpos", "joint/hip/qvel"])) == ["joint/hip/damping", "joint/knee/damping"]
    assert chosen(offered(["body/thigh/pos[0]"])) == ["joint/rail/damping"]
