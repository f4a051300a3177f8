"""Numbers of models by name: what is compiled with them, and names that match nothing."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
from envs_mujoco import ARM

from jaxlfi.envs.mujoco import effects, parameters
from jaxlfi.envs.mujoco.effects import state_place
from jaxlfi.envs.mujoco.measured import add_sensors, places


def specification(xml=ARM):
    spec = mujoco.MjSpec.from_string(xml)
    return spec, spec.compile()


def compiled(name, number, xml=ARM):
    spec, model = specification(xml)
    one = parameters.edit(spec, model, name)
    changed = spec.copy()
    one.apply(changed, number)
    return changed.compile(), model


@pytest.mark.parametrize(
    ("name", "number", "field", "place"),
    [
        ("joint/elbow/damping", 0.7, "dof_damping", 1),
        ("joint/elbow/frictionloss", 0.2, "dof_frictionloss", 1),
        ("joint/shoulder/armature", 0.3, "dof_armature", 0),
        ("joint/shoulder/stiffness", 2.0, "jnt_stiffness", 0),
        ("geom/rod/friction[1]", 0.4, "geom_friction", (0, 1)),
        ("geom/rod/solref[0]", 0.07, "geom_solref", (0, 0)),
        ("actuator/motor/gear[0]", 3.5, "actuator_gear", (0, 0)),
        ("body/fore/mass", 0.9, "body_mass", 2),
        ("body/fore/ipos[0]", 0.2, "body_ipos", (2, 0)),
        ("body/upper/inertia[1]", 0.0074, "body_inertia", (1, 1)),
        ("body/fore/pos[2]", -0.5, "body_pos", (2, 2)),
    ],
)
def test_a_number_is_that_of_the_compiled_model_and_others_of_its_kind_stay(name, number, field, place):
    changed, before = compiled(name, number)
    values, own = np.array(getattr(changed, field)), np.array(getattr(before, field))
    assert values[place] == pytest.approx(number)
    others = np.ones(values.shape, bool)
    others[place] = False
    np.testing.assert_allclose(values[others], own[others], rtol=1e-12)


def test_gravity_is_an_option():
    changed, _ = compiled("option/gravity[0]", 0.5)
    np.testing.assert_allclose(changed.opt.gravity, [0.5, 0, -9.81])


def test_a_mass_scales_the_inertia_and_what_depends_on_it_is_derived_anew():
    changed, before = compiled("body/fore/mass", 0.9)
    share = 0.9 / before.body_mass[2]
    np.testing.assert_allclose(changed.body_inertia[2], share * before.body_inertia[2], rtol=1e-10)
    np.testing.assert_allclose(changed.body_ipos[2], before.body_ipos[2], atol=1e-12)
    np.testing.assert_allclose(changed.body_subtreemass[1], before.body_mass[1] + 0.9)


def test_a_mass_is_that_of_a_geom_of_another_density():
    density = 700 * 1.7
    heavier, _ = specification(ARM.replace('density="700"', f'density="{density:g}"'))
    expected = heavier.compile()
    changed, _ = compiled("body/fore/mass", expected.body_mass[2])
    for field in ("body_mass", "body_inertia", "body_ipos", "dof_M0", "dof_invweight0"):
        np.testing.assert_allclose(getattr(changed, field), getattr(expected, field), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("joint/elbo/damping", "expected a joint such as elbow, got 'elbo'"),
        ("jont/elbow/damping", "expected one that begins with such as joint"),
        ("joint/elbow/dampign", "expected an attribute such as damping"),
        ("joint/elbow/__class__", "expected "),
        ("joint/elbow/name", "expected an attribute such as "),
        ("geom/rod/friction", "expected one of its 3 numbers, as geom/rod/friction\\[0\\], got all of them"),
        ("geom/rod/friction[3]", "expected an index from 0 to 2, got 3"),
        ("joint/elbow/armature[0]", "expected no index, as it is a single number"),
        ("damping", "expected names as joint/hinge/damping"),
        ("body/fore/inertia", "expected one of its 3 numbers"),
        ("body/world/mass", "expected a body that moves, got the world"),
    ],
)
def test_names_that_match_nothing_or_several_numbers(name, expected):
    spec, model = specification()
    with pytest.raises(ValueError, match=expected) as caught:
        effects.effects(spec, model, [name], [(0.1, 0.2)], ["angle"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sensor/angel/bias", "expected a signal such as angle, got 'angel'"),
        ("sensor/angle/scale", "expected gain, bias, delay, noise of a sensor, got 'scale'"),
        ("initial/elbow/pos", "expected initial/JOINT/qpos or initial/JOINT/qvel"),
        ("initial/wrist/qpos", "expected a joint such as"),
        ("control/gain", "expected control/delay"),
    ],
)
def test_names_of_what_is_no_part_of_the_model(name, expected):
    spec, model = specification()
    with pytest.raises(ValueError, match=expected):
        effects.effects(spec, model, [name], [(0.1, 0.2)], ["angle"])


def test_a_number_that_changes_nothing_is_refused():
    explicit = ARM.replace(
        '<joint name="elbow"', '<inertial pos="0 0 -0.1" mass="1" diaginertia="1 1 1"/><joint name="elbow"'
    ).replace('density="700"', 'name="outer" density="700"')
    spec, model = specification(explicit)
    with pytest.raises(ValueError, match="'geom/outer/density': expected a number that the model depends on"):
        effects.effects(spec, model, ["geom/outer/density"], [(500.0, 900.0)], ["angle"])


def test_bounds_that_mujoco_refuses_are_one_line():
    spec, model = specification()
    with pytest.raises(ValueError, match="'body/fore/mass': MuJoCo refuses a model with -1") as caught:
        effects.effects(spec, model, ["body/fore/mass"], [(-1.0, 1.0)], ["angle"])
    assert "\n" not in str(caught.value)


def test_places_in_the_state_of_joints_of_all_kinds():
    _, model = specification(
        """<mujoco><worldbody>
        <body><joint name="first"/><geom size="1"/></body>
        <body name="box"><freejoint name="free"/><geom size="1"/></body>
        <body><joint name="ball" type="ball"/><geom size="1"/></body>
        <body><joint name="last"/><geom size="1"/></body></worldbody></mujoco>"""
    )
    assert (model.nq, model.nv) == (13, 11)
    for name, place in {
        "first/qpos": 1, "free/qpos[0]": 2, "free/qpos[6]": 8, "ball/qpos[3]": 12, "last/qpos": 13,
        "first/qvel": 14, "free/qvel[5]": 20, "ball/qvel[0]": 21, "last/qvel": 24,
    }.items():  # fmt: skip
        assert state_place(model, name, f"initial/{name}") == place
    with pytest.raises(ValueError, match="expected an index from 0 to 5, got 6"):
        state_place(model, "free/qvel[6]", "initial/free/qvel[6]")


def test_positions_of_joints_and_bodies_are_measured_without_sensors_of_their_own():
    spec, _ = specification()
    names = ["joint/elbow/qpos", "body/fore/pos[0]", "body/fore/pos[2]", "joint/elbow/qvel", "velocity[1]"]
    add_sensors(spec, names)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.4, -0.7), (1.0, 2.0)
    mujoco.mj_forward(model, data)
    measured = data.sensordata[places(model, names)]
    np.testing.assert_allclose(measured[:4], [-0.7, -0.4 * np.sin(0.4), -0.4 * np.cos(0.4), 2.0], atol=1e-12)
    assert measured[4] == data.sensor("velocity").data[1]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("angel", "expected a sensor such as angle, got 'angel'"),
        ("velocity", "expected velocity\\[0\\] to velocity\\[2\\], got 'velocity'"),
        ("velocity[3]", "expected velocity\\[0\\] to velocity\\[2\\], got 'velocity\\[3\\]'"),
        ("joint/wrist/qpos", "'joint/wrist/qpos': expected one such as"),
    ],
)
def test_sensors_that_the_model_does_not_have(name, expected):
    spec, _ = specification()
    with pytest.raises(ValueError, match=expected):
        add_sensors(spec, [name])
        places(spec.compile(), [name])


SERVOS = """
<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" range="-1 1"/><geom size="0.1"/></body></worldbody><actuator>
  <position name="position" joint="hinge" kp="20" kv="1"/>
  <velocity name="velocity" joint="hinge" kv="3"/>
  <intvelocity name="integrated" joint="hinge" kp="20" actrange="-1 1"/>
  <position joint="hinge" kp="20" dampratio="1"/>
  <general name="general" joint="hinge" gainprm="20" biastype="affine" biasprm="0 -10 -1"/>
  <motor name="motor" joint="hinge"/>
</actuator></mujoco>
"""


@pytest.mark.parametrize(
    ("name", "gain", "bias"),
    [
        ("actuator/position/kp", 40, (-40, -1)),
        ("actuator/0/kp", 40, (-40, -1)),
        ("actuator/position/kv", 20, (-20, -40)),
        ("actuator/position/gear[0]", 20, (-20, -1)),
        ("actuator/velocity/kv", 40, (0, -40)),
        ("actuator/integrated/kp", 40, (-40, 0)),
        ("actuator/general/gainprm[0]", 40, (-10, -1)),
        ("actuator/motor/gainprm[0]", 40, (0, 0)),
    ],
)
def test_gains_of_servos(name, gain, bias):
    """Position servos go to where their control says, whatever their gain is."""
    changed, _ = compiled(name, 40.0, SERVOS)
    row = 0 if name.split("/")[1] == "0" else changed.actuator(name.split("/")[1]).id
    assert changed.actuator_gainprm[row, 0] == gain and changed.actuator_biasprm[row, 1:3].tolist() == list(bias)


def test_a_damping_ratio_stays_with_another_gain():
    softer, stiffer = (compiled("actuator/3/kp", number, SERVOS)[0].actuator_biasprm[3] for number in (10.0, 40.0))
    assert stiffer[2] == pytest.approx(2 * softer[2]) and stiffer[2] < 0


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("actuator/position/gainprm[0]", r"actuator/position/kp, which changes gainprm\[0\] and biasprm\[1\]"),
        ("actuator/0/biasprm[1]", r"expected actuator/0/kp, which changes gainprm\[0\] and biasprm\[1\]"),
        ("actuator/velocity/gainprm[0]", r"actuator/velocity/kv, which changes gainprm\[0\] and biasprm\[2\]"),
        ("actuator/velocity/biasprm[2]", "expected actuator/velocity/kv, which"),
        ("actuator/velocity/kp", "expected kp or kv of a position servo, or kv of a velocity servo"),
        ("actuator/motor/kp", "expected kp or kv of a position servo"),
        ("actuator/position/kp[0]", "without an index"),
        ("actuator/position/group", "expected an attribute .*, got 'group'"),
        ("actuator/7/gear[0]", "expected a actuator such as"),
        ("actuator/position/kv", "kv: expected a gain of at least 0, got -40"),
    ],
)
def test_a_part_of_a_gain_is_refused(name, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        compiled(name, -40.0, SERVOS)
    assert "\n" not in str(refusal.value)
