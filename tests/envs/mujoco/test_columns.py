"""Columns of recordings: which drive an actuator and which a sensor measures, where names are shared or missing."""

import warnings

import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco.columns import ControlWarning, arranged, control_names, signal_name
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import compile_spec, mujoco_task, specification
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.reading import Reading

HIPS = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body name="hip"><joint name="hip" axis="0 1 0" damping="0.1"/>
    <geom name="hip" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/><site name="hip"/></body></worldbody>
  <actuator><motor name="hip" joint="hip" ctrlrange="-1 1"/><motor joint="hip" gear="2"/></actuator>
  <sensor><jointpos name="hip" joint="hip"/><jointvel joint="hip"/><accelerometer name="felt" site="hip"/></sensor>
</mujoco>
"""
TIMES = 0.02 * np.arange(30)
PUSH, SWUNG, TURNED, LATE = (np.sin((3 + i) * TIMES) * 0.5 for i in range(4))
DAMPING = Parameter("joint/hip/damping", (0.01, 0.5))


def task(signals, measured=None, noises=None, parameters=(DAMPING,), xml=HIPS, **others):
    noises = {"hip": 0.01, "sensor/1": 0.01} if noises is None else noises
    return mujoco_task(xml, list(parameters), Log(TIMES, signals), measured, noises, **others)


ALL = {"actuator/hip": PUSH, "actuator/1": LATE, "sensor/hip": SWUNG, "sensor/1": TURNED}


@pytest.mark.parametrize(
    "signals",
    [
        ALL,
        {"hip": PUSH, "actuator/1": LATE, "sensor/hip": SWUNG, "sensor/1": TURNED},
        {"actuator/hip": PUSH, "actuator/1": LATE, "hip": SWUNG, "sensor/1": TURNED},
        {"actuator/0": PUSH, "actuator/1": LATE, "sensor/0": SWUNG, "sensor/1": TURNED},
    ],
)
def test_names_that_are_shared_or_missing(signals):
    """Controls and measurements are the same, whatever their names."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = task(signals)
    simulator = own.simulate.function
    assert simulator.signals == ("hip", "sensor/1") and simulator.actuators == ["actuator/hip", "actuator/1"]
    np.testing.assert_allclose(own.observation, np.stack([SWUNG, TURNED], axis=1), atol=1e-6)
    np.testing.assert_allclose(simulator.held(0, TIMES), np.stack([PUSH, LATE], axis=1))
    assert own.channels == ("hip [rad]", "sensor/1 [rad/s]")
    rows, _ = simulator.clean(np.array([[0.1]]))
    np.testing.assert_allclose(np.gradient(rows[0, :, 0], TIMES)[2:-2], rows[0, 2:-2, 1], atol=0.4)  # of 10 rad/s


def test_a_name_in_any_place_means_the_sensor_where_something_is_measured():
    noise = Parameter("sensor/hip/noise", (0.001, 0.1))
    own = task(ALL, ["sensor/hip"], {}, [noise, Parameter("actuator/1/gear[0]", (1.0, 3.0))])
    assert own.simulate.function.signals == ("hip",) and own.simulate.function.does.deviations == ((0, 0),)
    models = [own.simulate.function.build(np.array([0.1, gear])) for gear in (1.0, 3.0)]
    assert [model.actuator_gear[1, 0] for model in models] == [1.0, 3.0]
    for name in ("sensor/1/bias", "sensor/sensor/1/bias"):
        biased = task(ALL, None, None, [Parameter(name, (-0.1, 0.1))])
        assert biased.simulate.function.does.biases == ((1, 0),)
    given = task(ALL, ["hip", "sensor/1"], {"sensor/hip": 0.3, "sensor/1": 0.2})
    assert given.simulate.function.noise.tolist() == [0.3, 0.2]
    with pytest.raises(ValueError, match="noises: expected one of each signal, got sensor/hip, hip"):
        task(ALL, ["hip"], {"sensor/hip": 0.3, "hip": 0.2})


def test_one_column_of_a_shared_name_is_the_control():
    signals = {"hip": PUSH, "actuator/1": LATE, "sensor/1": TURNED}
    with pytest.warns(ControlWarning, match="log: hip is taken as the control of .* measurements of .* sensor/hip"):
        own = task(signals, noises={"sensor/1": 0.01})
    assert own.simulate.function.signals == ("sensor/1",)
    np.testing.assert_allclose(own.simulate.function.held(0, TIMES)[:, 0], PUSH)
    with (
        pytest.warns(ControlWarning),
        pytest.raises(ValueError, match=r"the sensor hip measures, as sensor/hip; got the control of the actuator hip"),
    ):
        task(signals, ["hip", "sensor/1"])


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        (
            {"actuator/hip": PUSH, "actuator/0": PUSH},
            "expected one column of actuator/hip, got actuator/hip and actuator/0",
        ),
        ({"actuator/0": PUSH, "sensor/hip": PUSH, "hip": PUSH}, "expected one column of hip, got sensor/hip and hip"),
        ({"actuator/hip": PUSH, "sensor/hip": PUSH}, "got none of actuator/1 among"),
        ({"actuator/hip": PUSH, "actuator/1": PUSH, "sensor/7": PUSH}, "expected a sensor such as .*, got 'sensor/7'"),
        ({"actuator/hip": PUSH, "actuator/1": PUSH, "actuator/9": PUSH}, "expected a sensor such as .*'actuator/9'"),
    ],
)
def test_columns_of_nothing_and_of_the_same_are_refused(signals, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        task(
            signals, noises={"x": 1.0} if "x" in signals else {name: 0.1 for name in signals if "sensor/7" in name} | {}
        )
    assert "\n" not in str(refusal.value)


def test_actuators_of_several_controls_are_refused():
    xml = HIPS.replace('<motor joint="hip" gear="2"/>', '<pid name="tracked" joint="hip" kp="1"/>')
    with pytest.raises(ValueError, match="expected actuators of one control each, got 2 of actuator tracked"):
        task(ALL, xml=xml)
    with pytest.raises(ValueError, match="got 2 of actuator tracked"):
        Reading(compile_spec(specification(xml)), Goal(("hip",), 0.02, 1.0, {"hip": (0.0, 1.0)}))


def test_names_by_themselves():
    assert control_names(["a", "b", ""], ["b", ""]) == ["a", "actuator/b", "actuator/2"]
    sensors = ["imu", "", "sensor/odd"]
    for name, expected in (
        ("imu[2]", "imu[2]"),
        ("sensor/imu[2]", "imu[2]"),
        ("sensor/0[1]", "imu[1]"),
        ("sensor/1[2]", "sensor/1[2]"),
        ("sensor/odd", "sensor/odd"),
        ("joint/hip/qpos", "joint/hip/qpos"),
        ("sensor/none", "sensor/none"),
    ):
        assert signal_name(name, sensors) == expected
    log = Log(TIMES, {"motor": PUSH, "angle": SWUNG})
    assert arranged(log, ["motor"], ["angle"]) is log


# ----------------------------------------------------------------------------------------------------------- clamped


def clamped(control, xml=HIPS, parameters=(DAMPING,)):
    """The message about a control of the first actuator."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        task(ALL | {"actuator/hip": control, "actuator/1": 9 * control}, parameters=parameters, xml=xml)
    return [str(one.message) for one in said]


def test_controls_beyond_the_range_are_counted():
    control = np.where(np.arange(30) < 12, 1.5, np.where(np.arange(30) < 15, -3.0, 0.2))
    assert clamped(control) == [
        "log: actuator/hip: 50 % of its samples are beyond the actuator's ctrlrange, -1 to 1, where MuJoCo clamps "
        "them: they go from -3 to 1.5"
    ]
    control[20] = np.nan
    assert "51.7 % of its samples" in clamped(control)[0]
    for inside in (np.clip(control, -1, 1), np.clip(control, -1.000001, 1.000001)):
        assert clamped(inside) == []
    assert (
        clamped(control, HIPS.replace('timestep="0.01"/>', 'timestep="0.01"><flag clampctrl="disable"/></option>'))
        == []
    )
    assert clamped(control, HIPS.replace(' ctrlrange="-1 1"', "")) == []
    assert clamped(control, parameters=[Parameter("actuator/hip/ctrlrange[1]", (0.5, 2.0))]) == []


def test_limits_of_policies_are_within_the_range():
    model = compile_spec(specification(HIPS))
    goal = {"observed": ("hip",), "interval": 0.02, "duration": 1.0, "targets": {"hip": (0.0, 1.0)}}
    within = Goal(**goal, limits={"hip": (-1.0, 0.5), "actuator/1": (-9.0, 9.0)})
    assert Reading(model, within).actions.names == ("hip", "actuator/1")
    with pytest.raises(ValueError, match=r"limits: hip: expected limits within .* \[-1.0, 1.0\]; got \[-2.0, 0.5\]"):
        Reading(model, Goal(**goal, limits={"hip": (-2.0, 0.5), "actuator/1": (-9.0, 9.0)}))
