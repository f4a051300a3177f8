"""One number for several elements: what is compiled with it, against models with the values written in."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import config
from jaxlfi.envs.mujoco.effects import built, effects
from jaxlfi.envs.mujoco.model_task import mujoco_task, named
from jaxlfi.envs.mujoco.parameters import Parameter

LEGS = """
<mujoco><worldbody><body name="torso"><freejoint name="root"/><geom name="hull" size="0.2"/>
  <body name="left_thigh"><joint name="left_hip" axis="0 1 0" damping="0.2" armature="0.01"/>
    <inertial pos="0.02 0.03 -0.1" mass="{left:g}" diaginertia="0.01 0.011 0.012"/><geom name="left_leg" size="0.05"/></body>
  <body name="right_thigh"><joint name="right_hip" axis="0 1 0" damping="{right:g}" armature="0.02"/>
    <inertial pos="0.02 {side:g} -0.1" mass="2" diaginertia="0.01 0.011 0.012"/><geom name="right_leg" size="0.05"/></body>
  <body name="tail"><joint axis="0 1 0" stiffness="3"/><geom name="tail_tip" size="0.05"/></body></body></worldbody>
  <actuator><position name="left_motor" joint="left_hip" kp="20" kv="1"/>
    <position name="right_motor" joint="right_hip" kp="30" kv="2"/><motor name="plain" joint="left_hip"/></actuator>
</mujoco>
"""  # noqa: E501


def legs(left=2.0, right=0.5, side=-0.03):
    return LEGS.format(left=left, right=right, side=side)


def compiled(name, number, tie, xml=None):
    spec = named(mujoco.MjSpec.from_string(xml or legs()))
    model = spec.compile()
    bounds = (0.5 * number, 1.5 * number) if number > 0 else (1.5 * number, 0.5 * number)
    does = effects(spec, model, [name], [bounds], [], [tie])
    return built(spec, does, np.array([number])), model


@pytest.mark.parametrize(
    ("name", "tie", "number", "field", "expected"),
    [
        ("joint/*_hip/damping", "shared", 0.7, "dof_damping", [0] * 6 + [0.7, 0.7, 0]),
        ("joint/*/damping", "shared", 0.7, "dof_damping", [0] * 6 + [0.7, 0.7, 0.7]),
        ("joint/*/damping", "scaled", 3.0, "dof_damping", [0] * 6 + [0.6, 1.5, 0]),
        ("joint/?eft_hip/damping", "scaled", 3.0, "dof_damping", [0] * 6 + [0.6, 0.5, 0]),
        ("joint/*/damping", {"*_hip": 1.0, "3": -0.5}, 0.4, "dof_damping", [0] * 6 + [0.4, 0.4, -0.2]),
        ("joint/left_hip/armature", "scaled", 2.0, "dof_armature", [0] * 6 + [0.02, 0.02, 0]),
        ("actuator/*_motor/kp", "scaled", 1.5, "actuator_gainprm", [30, 45, 1]),
        ("actuator/*/kp", "shared", 25.0, "actuator_gainprm", [25, 25, 1]),
    ],
)
def test_what_one_number_means_for_all_that_a_pattern_matches(name, tie, number, field, expected):
    found, _ = compiled(name, number, tie)
    values = getattr(found, field)
    np.testing.assert_allclose(values[:, 0] if values.ndim > 1 else values, expected, rtol=1e-12)
    if field == "actuator_gainprm":
        np.testing.assert_allclose(found.actuator_biasprm[:2, 1], -np.array(expected[:2]), rtol=1e-12)


@pytest.mark.parametrize("tie", ["mirrored", {"left*": 1, "right*": -1}])
def test_sides_are_mirrored(tie):
    found, before = compiled("body/*_thigh/ipos[1]", 0.05, tie)
    np.testing.assert_allclose(found.body_ipos[:, 1], [0, 0, 0.05, -0.05, 0], atol=1e-15)
    np.testing.assert_allclose(found.body_ipos[:, [0, 2]], before.body_ipos[:, [0, 2]], atol=1e-15)
    written = mujoco.MjModel.from_xml_string(legs(side=-0.05).replace("0.02 0.03", "0.02 0.05"))
    np.testing.assert_allclose(found.dof_invweight0, written.dof_invweight0, rtol=1e-9)


def test_masses_scale_their_inertias_and_bodies_without_one_are_passed_over():
    found, before = compiled("body/*/mass", 1.5, "scaled", legs(left=1.0))
    np.testing.assert_allclose(found.body_mass, 1.5 * before.body_mass, rtol=1e-12)
    np.testing.assert_allclose(found.body_inertia, 1.5 * before.body_inertia, rtol=1e-9)


def test_sensors_and_states_share_numbers_by_patterns():
    names = ["sensor/velocity/delay", "sensor/*/gain", "initial/*/qpos", "sensor/vel*/noise"]
    tied = [None, "shared", "shared", "shared"]
    spec = mujoco.MjSpec.from_string(ARM)
    signals = ["angle", *(f"velocity[{i}]" for i in range(3))]
    does = effects(spec, spec.compile(), names, [(0.1, 0.2)] * 4, signals, tied)
    assert does.lags == ((1, 0), (2, 0), (3, 0)) and does.gains == ((0, 1), (1, 1), (2, 1), (3, 1))
    assert does.starts == ((1, 2), (2, 2)) and does.deviations == ((1, 3), (2, 3), (3, 3))


def test_a_pattern_in_a_task_and_in_its_file(tmp_path):
    parameter = Parameter("joint/*/damping", (0.01, 0.2), log=True, tie="shared")
    noisy = Parameter("sensor/*/noise", (0.001, 0.1), tie="shared")
    simulator = mujoco_task(ARM, [parameter, noisy], recorded()).simulate.function
    expected = recorded(edit=lambda model: model.dof_damping.__setitem__(slice(None), 0.11))
    rows, _ = simulator.clean([[0.11, 0.01]])
    np.testing.assert_allclose(rows[0, :, 0], expected.signals["angle"], atol=1e-9)
    assert simulator.noise.tolist() == [0, 0, 0, 0]
    table = {"support": [0.5, 2.0], "tie": "scaled", "log": True}
    assert config.parameters_of({"parameters": {"joint/*/damping": table}})[0].tie == "scaled"


@pytest.mark.parametrize(
    ("name", "tie", "expected"),
    [
        ("joint/*_hipp/damping", "shared", "a pattern that matches the name of a joint, such as .*_hip, .*_hipp'"),
        ("joint/ro*/damping", "shared", "a pattern that matches the name of a joint"),  # free
        ("hinge/*/damping", "shared", "expected a pattern that begins with such as"),
        ("joint/*/dampign", "shared", "expected an attribute such as damping"),
        ("joint/*/damping", "twice", "tie: expected shared, scaled, mirrored or a factor for each pattern, got twice"),
        ("joint/*/damping", None, "tie: expected shared, scaled, mirrored or a factor for each pattern, got none"),
        ("joint/*/damping", {"left*": "a"}, "tie: expected shared, scaled, mirrored or a factor for each pattern"),
        ("joint/*/damping", {"left*": 1, "right*": -1}, "tie: expected one factor for 3, got none"),
        ("joint/*_hip/damping", {"left*": 1, "*hip": -1}, "tie: expected one factor for left_hip, got several"),
        ("option/gravity[0]", "scaled", "tie: expected shared, as the model has no values of them to scale"),
    ],
)  # fmt: skip
def test_patterns_that_fit_nothing_are_one_line(name, tie, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        Parameter(name, (0.1, 0.2), tie=tie)
        compiled(name, 0.1, tie)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("one", "other", "what"),
    [
        ("joint/*/damping", "joint/left_hip/damping", "joint/left_hip/damping"),
        ("joint/left*/damping", "joint/*_hip/damping", "joint/left_hip/damping"),
        ("actuator/0/gear[0]", "actuator/left_motor/gear", None),
        ("actuator/0/kp", "actuator/left_motor/kp", "actuator/left_motor/kp"),
        ("joint/left_hip/damping", "joint/left_hip/damping[0]", "joint/left_hip/damping"),
        ("initial/left*/qpos", "initial/left_hip/qpos", "initial/8/0"),
    ],
)
def test_two_parameters_of_one_number_are_refused(one, other, what):
    spec = named(mujoco.MjSpec.from_string(legs()))
    tied = ["shared" if "*" in name else None for name in (one, other)]
    expected = "expected one of its 6 numbers" if what is None else f"expected one for each number, got .* of {what}$"
    with pytest.raises(ValueError, match=expected):
        effects(spec, spec.compile(), [one, other], [(0.1, 0.2)] * 2, [], tied)
