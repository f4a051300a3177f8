"""Recordings that are put right or said to look wrong before anything is simulated."""

import csv
import warnings

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.cli import parser as cli
from jaxlfi.envs.mujoco import simulator
from jaxlfi.envs.mujoco.logs import Log, RecordingWarning
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.recordings import repeats
from jaxlfi.envs.mujoco.simulator import simulator_of

WHEEL = """
<mujoco model="wheel">
  <option timestep="0.002"/>
  <worldbody>
    <body name="disc">
      <joint name="axle" axis="0 1 0" damping="0.01"/>
      <geom name="disc" type="cylinder" size="0.1 0.01" euler="90 0 0" mass="0.3"/>
      <geom type="sphere" size="0.02" pos="0.08 0 0" mass="0.05"/>
    </body>
    <body name="cart" pos="0 0.5 0">
      <joint name="rail" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="axle"/><position name="servo" joint="rail" kp="20"/></actuator>
  <sensor>
    <jointpos name="angle" joint="axle"/>
    <jointvel name="rate_rpm" joint="axle"/>
    <jointpos name="place" joint="rail"/>
  </sensor>
</mujoco>
"""
DAMPING = Parameter("joint/axle/damping", (0.001, 0.05), log=True)
NOISE = {"angle": 0.002, "rate_rpm": 0.02, "place": 0.001}
SIGNALS = list(NOISE)


def simulated(count=150, xml=WHEEL, start=0.0):
    """Times, controls and sensors by a plain loop, with noise."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, times, sensed = mujoco.MjData(model), 0.01 * np.arange(count), []
    data.qpos[0] = start
    controls = np.stack([0.15 * np.sin(2 * times) + 0.1, 0.2 * np.cos(3 * times)], axis=1)
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        sensed.append(data.sensordata.copy())
        for _ in range(5):
            mujoco.mj_step(model, data)
    sensed = np.array(sensed) + np.random.default_rng(0).normal(size=(count, 3)) * list(NOISE.values())
    return times, dict(zip(["motor", "servo", *SIGNALS], [*controls.T, *sensed.T], strict=True))


TIMES, RECORDED = simulated()
UNITS = {"time": "s", "motor": "N m", "servo": "m", "angle": "rad", "rate_rpm": "rad/s", "place": "m"}


def log(units=UNITS, times=TIMES, **changed):
    return Log(times, {**RECORDED, **changed}, "a.csv", units)


def task(recorded, **others):
    return mujoco_task(WHEEL, [DAMPING], recorded, noises=NOISE, **others)


def observed(recorded, **others):
    return simulator_of(task(recorded, **others)).observation


def without(*names):
    return {name: unit for name, unit in UNITS.items() if name not in names}


def test_what_fits_the_model_is_taken_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(observed(log()), np.stack([RECORDED[name] for name in SIGNALS], axis=1), rtol=1e-6)
        degrees = log(UNITS | {"angle": "deg", "place": "mm"}, angle=np.degrees(RECORDED["angle"]))
        np.testing.assert_allclose(observed(degrees)[:, 0], RECORDED["angle"], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(observed(degrees)[:, 2], 1e-3 * RECORDED["place"], rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "unit", "expected"),
    [
        ("angle", "kg", "angle: expected rad as the sensor, got kg"),
        ("angle", "%", "angle: expected rad as the sensor, got 1"),
        ("rate_rpm", "deg", "rate_rpm: expected rad/s as the sensor, got rad"),
        ("place", "deg", "place: expected m as the sensor, got rad"),
        ("servo", "deg", "servo: expected m as the actuator, got rad"),
        ("motor", "deg/s", "motor: expected N m or N or V or A or 1 or count as the actuator, got rad/s"),
    ],
)
def test_units_that_the_model_cannot_have_are_one_line(name, unit, expected):
    with pytest.raises(ValueError, match=expected):
        task(log(UNITS | {name: unit}))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_times_that_are_no_seconds_are_refused_with_the_unit_that_they_look_like(factor, unit):
    for units in (without("time"), UNITS | {"time": unit}):
        given = log(units, factor * TIMES)
        if "time" in given.units:
            np.testing.assert_allclose(given.times, TIMES, rtol=1e-9)
        else:
            with pytest.raises(ValueError, match=f"expected times in s, got rows .* in {unit} they would be 0.01 s"):
                task(given)


def test_times_that_are_said_to_be_seconds_are_believed_as_far_as_memory_goes():
    with pytest.warns(RecordingWarning, match=r"got rows 10 apart, 5e\+03 steps of the model: in ms they would be"):
        task(log(UNITS, 1e3 * TIMES))
    with (
        pytest.raises(ValueError, match=r"a\.csv: expected an episode whose simulation fits into memory, got one of"),
        pytest.warns(RecordingWarning),
    ):
        task(log(UNITS, 1e9 * TIMES))


def test_fewer_long_simulations_are_made_at_once(monkeypatch):
    own = simulator_of(task(log()))
    monkeypatch.setattr(simulator, "MEMORY", 2 * own._bytes())
    fewer = simulator_of(task(log()))
    assert fewer._chunk == 2
    theta = np.geomspace(0.001, 0.05, 5)[:, None]
    np.testing.assert_array_equal(fewer.clean(theta)[0], own.clean(theta)[0])


def test_times_in_minutes_look_wrong():
    with pytest.warns(RecordingWarning, match="12 of them in a step of the model: in min they would be 0.01 s apart"):
        task(log(without("time"), TIMES / 60))


def test_angles_that_look_like_degrees_are_said():
    with pytest.warns(RecordingWarning) as caught:
        task(log(without("angle"), angle=np.degrees(RECORDED["angle"])))
    (line,) = [str(one.message) for one in caught]
    low, high = (f"{end:.4g}" for end in (RECORDED["angle"].min(), RECORDED["angle"].max()))
    assert f"if these are degrees, that is {low} to {high} rad: say which, as 'angle [deg]' or 'angle [rad]'" in line


def test_units_that_only_a_name_says():
    with pytest.warns(RecordingWarning, match=r"a\.csv: rate_rpm: read in rpm, as its name says"):
        found = observed(log(without("rate_rpm"), rate_rpm=RECORDED["rate_rpm"] * 30 / np.pi))
    np.testing.assert_allclose(found[:, 1], RECORDED["rate_rpm"], rtol=1e-5, atol=1e-6)


def test_a_name_that_says_a_unit_besides():
    signals = {("angle_deg" if name == "angle" else name): own for name, own in RECORDED.items()}
    signals["angle_deg"] = np.degrees(signals["angle_deg"])
    with pytest.warns(RecordingWarning, match=r"a\.csv: angle_deg: read as angle in deg"):
        own = simulator_of(task(Log(TIMES, signals, "a.csv", without("angle"))))
    assert own.signals == ("angle", "rate_rpm", "place")
    np.testing.assert_allclose(own.observation[:, 0], RECORDED["angle"], rtol=1e-5, atol=1e-6)


def test_an_encoder_is_made_continuous_and_begins_in_the_turn_of_the_model():
    for begin in (-np.pi, 0.0):
        wrapped = (RECORDED["angle"] - begin) % (2 * np.pi) + begin
        with pytest.warns(RecordingWarning, match="angle: wraps after 6.283 rad, .*: made continuous"):
            found = observed(log(angle=wrapped))
        np.testing.assert_allclose(found[:, 0], RECORDED["angle"], atol=1e-5)
    with pytest.warns(RecordingWarning, match="angle: 6.283 rad taken off twice, as the model begins there"):
        found = observed(log(angle=RECORDED["angle"] + 4 * np.pi))
    np.testing.assert_allclose(found[:, 0], RECORDED["angle"], atol=1e-5)


def test_an_encoder_without_a_unit_of_a_joint_with_limits():
    """Its readings are beyond the limits, but are no degrees."""
    limited = WHEEL.replace('name="axle"', 'name="axle" range="-100 100" limited="true" stiffness="0.3"')
    times, recorded = simulated(xml=limited)
    wrapped = recorded | {"angle": (recorded["angle"] - 0.3) % (2 * np.pi) + 0.3}
    with pytest.warns(RecordingWarning) as caught:
        own = mujoco_task(limited, [DAMPING], Log(times, wrapped, "a.csv", without("angle")), noises=NOISE)
    assert ["wraps after 6.283 rad" in str(one.message) for one in caught] == [True]
    np.testing.assert_allclose(simulator_of(own).observation[:, 0], recorded["angle"], atol=1e-5)
    degrees = recorded | {"angle": 5 / np.abs(recorded["angle"]).max() * recorded["angle"]}
    with pytest.warns(RecordingWarning, match="angle: no unit, read in rad from .* if these are degrees"):
        mujoco_task(limited, [DAMPING], Log(times, degrees, "a.csv", without("angle")), noises=NOISE)


def test_a_beginning_elsewhere_is_said_once_for_each_signal():
    with pytest.warns(RecordingWarning) as caught:
        task([log(), log(angle=RECORDED["angle"] + 0.5, place=RECORDED["place"] - 0.1)], begins="model")
    lines = sorted(str(one.message) for one in caught)
    assert len(lines) == 2
    assert "angle: the recording begins at 0.5003 rad, the model at 0 rad: 250 standard deviations of the" in lines[0]
    assert "place: the recording begins at -0.09936 m, the model at 0 m: 99.4 standard deviations of the" in lines[1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        task(log(angle=RECORDED["angle"] + 0.5), initial={"axle/qpos": 0.5})
        begins = Parameter("initial/axle/qpos", (0.0, 1.0))
        mujoco_task(WHEEL, [DAMPING, begins], log(angle=RECORDED["angle"] + 0.5), noises=NOISE)
        biased = Parameter("sensor/angle/bias", (0.0, 1.0))
        mujoco_task(WHEEL, [DAMPING, biased], log(angle=RECORDED["angle"] + 0.5), noises=NOISE)


def test_samples_that_repeat_the_one_before_are_said_and_not_compared():
    """One sensor is slower than the recording; the summary takes rows that have all signals."""
    slow = RECORDED["angle"][3 * (np.arange(150) // 3)]
    with pytest.warns(RecordingWarning, match="angle: 100 of 150 samples repeat the one before, .* about every 3 rows"):
        own = task(log(angle=slow))
    there = simulator_of(own).there
    np.testing.assert_array_equal(np.flatnonzero(there[:, 0]), 3 * np.arange(50))
    assert there[:, 1:].all()
    assert (np.asarray(own.summary(own.observation)).reshape(-1, 3) != 0).all()


def test_which_samples_repeat_the_one_before():
    count, noise = 300, np.random.default_rng(1).normal(size=300)
    motion = np.sin(0.05 * np.arange(count)) + 0.002 * noise
    stale, every = repeats(motion[4 * (np.arange(count) // 4)])
    assert every == 4 and stale.tolist() == [k for k in range(count) if k % 4]
    camera = np.floor(np.arange(count) * 0.3).astype(int)  # 30 Hz in a recording of 100 Hz
    stale, every = repeats(motion[np.searchsorted(camera, camera)])
    assert every == 3 and stale.tolist() == np.flatnonzero(np.diff(camera, prepend=-1) == 0).tolist()
    lost = motion.copy()
    lost[30:300:20] = lost[29:299:20]
    stale, every = repeats(lost)
    assert every == 1 and stale.tolist() == list(range(30, 300, 20))


@pytest.mark.parametrize(
    "values",
    [
        np.sin(0.05 * np.arange(300)) + 0.002 * np.random.default_rng(1).normal(size=300),
        np.round(40 * np.sin(0.05 * np.arange(300))) / 40,  # a coarse encoder
        np.round(1000 * np.sin(0.05 * np.minimum(np.arange(300), 31))) / 1000,  # which comes to rest
        np.maximum(np.sin(0.7 * np.arange(300)) + 0.01 * np.random.default_rng(2).normal(size=300), 0.0),  # of contact
        np.arange(300) // 50 % 2,
        np.zeros(300),
    ],
)
def test_what_rests_or_is_coarse_does_not_only_repeat(values):
    assert len(repeats(np.asarray(values, float))[0]) == 0


def test_a_warning_of_the_command_line_is_one_line(tmp_path, capsys):
    (tmp_path / "wheel.xml").write_text(WHEEL)
    (tmp_path / "wheel.toml").write_text(
        'model = "wheel.xml"\nlog = ["a.csv"]\n[initial]\nfrom = "model"\n'
        '[parameters."joint/axle/damping"]\nsupport = [0.001, 0.05]\n'
    )
    with (tmp_path / "a.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "motor", "servo", "angle [deg]", "rate_rpm [deg/s]", "place [cm]"])
        turned = {"angle": np.degrees(1 + RECORDED["angle"]), "rate_rpm": np.degrees(RECORDED["rate_rpm"])}
        columns = RECORDED | turned | {"place": 100 * RECORDED["place"]}
        writer.writerows(zip(TIMES, *columns.values(), strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["tasks", f"mujoco,config={tmp_path / 'wheel.toml'}"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "RecordingWarning" in line or "begins" in line]
    assert line.startswith(f"warning: {tmp_path / 'a.csv'}: angle: the recording begins at 1 rad, the model at 0 rad")
