"""Long recordings in windows, against plain loops of steps."""

import time
import warnings

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import config, windows
from jaxlfi.envs.mujoco.logs import Log, RecordingWarning
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

PENDULUM = """
<mujoco><option timestep="0.002"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""
DAMPING = Parameter("joint/hinge/damping", (0.005, 0.2), log=True)
NOISE = {"angle": 0.001}


def driven(duration=6.0, delay=0.0, interval=0.004):
    """A recording without noise, of controls that act late."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data, every, late = mujoco.MjData(model), round(interval / 0.002), round(delay / 0.002)
    times = interval * np.arange(round(duration / interval))
    push = 0.5 * np.sin(2.3 * times) + 0.3 * np.sign(np.sin(5 * times + 0.7))
    rows = []
    for step in range(every * len(times)):
        if step % every == 0:
            rows.append(data.qpos[0])
        data.ctrl[0] = push[max(step - late, 0) // every]
        mujoco.mj_step(model, data)
    return Log(times, {"motor": push, "angle": np.array(rows)}, "long")


def task(log, parameters=(DAMPING,), noises=NOISE, **others):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        return mujoco_task(PENDULUM, list(parameters), log, noises=noises, **others)


def test_every_window_is_simulated_from_a_start_of_its_own_under_the_controls_before_it():
    log = driven(delay=0.06)
    own = simulator_of(task(log, [DAMPING, Parameter("control/delay", (0.0, 0.1))], windows=3, window=1.2))
    rows, _ = own.clean([[0.05, 0.06], [0.05, 0.0]])
    assert len(own.times) == 3 and [round(times[-1], 2) for times in own.times] == [1.2] * 3
    np.testing.assert_allclose(rows[0], own.observation, atol=4e-3)
    assert np.abs(rows[1] - own.observation).max() > 0.05
    assert all(0.0999 < start.time < 0.12 for start in own.starts[1:])


def test_controls_are_those_of_the_whole_recording_at_the_time_of_the_window():
    log = driven()
    own = simulator_of(task(log, windows=2, window=0.5))
    for episode, part in enumerate(own.logs):
        row = int(
            np.argmin(np.abs(log.signals["angle"] - part.signals["angle"][np.isfinite(part.signals["angle"])][0]))
        )
        when = np.array([0.1, 0.3])
        np.testing.assert_allclose(own.held(episode, when)[:, 0], log.held("motor", log.times[row] + when))


def test_of_each_part_it_is_the_window_in_which_most_moves():
    times = 0.01 * np.arange(3000)
    bursts = sum(np.exp(-(((times - middle) / 0.5) ** 2)) for middle in (4.0, 16.0, 22.0))
    log = Log(times, {"motor": np.zeros(3000), "angle": np.sin(7 * times) * bursts}, "bursts")
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    found = windows.windows_of(model, [log], ["angle"], NOISE, 3, 2.0)
    assert [one.begin <= middle <= one.end for one, middle in zip(found, (4, 16, 22), strict=True)] == [True] * 3
    assert all(10 * i - 0.02 < one.begin and one.end < 10 * (i + 1) + 1e-6 for i, one in enumerate(found))


def test_the_period_of_a_sine():
    times = 0.002 * np.arange(5000)
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    for noise in (0.0, 0.001, 0.02):  # whose own speed is larger than the sine's
        noisy = np.sin(2 * np.pi * times / 1.7) + noise * np.random.default_rng(0).standard_normal(5000)
        found = windows.period(model, Log(times, {"angle": noisy}), ["angle"], {"angle": noise})
        assert found == pytest.approx(1.7, rel=0.1)


def test_ten_minutes_at_a_kilohertz_are_cut_and_that_is_one_line():
    times = 0.001 * np.arange(600_000)
    angle = 0.4 * np.sin(4 * times) * (1 + np.sin(times / 30)) + 0.001 * np.random.default_rng(0).standard_normal(
        600_000
    )
    log = Log(times, {"motor": np.sin(4 * times), "angle": angle}, "lab")
    begun = time.process_time()
    with pytest.warns(RecordingWarning) as said:
        own = mujoco_task(PENDULUM, [DAMPING], log, noises=NOISE)
    assert time.process_time() - begun < 20
    (line,) = [str(one.message) for one in said]
    simulator = simulator_of(own)
    count = len(simulator.times)
    assert (
        f"lab: 599.999 s would be 3e+05 steps of the model in each simulation: cut into {count} windows of 3.1" in line
    )
    assert 2 <= count <= 16 and sum(times[-1] for times in simulator.times) / 0.002 <= 10_000
    assert 1000 < len(own.observation) <= 4100 and sum(len(log.times) for log in simulator.logs) < 30_000
    assert len(own.summary(own.observation)) <= 400
    rows, outcome = simulator(np.random.default_rng(0), np.full((2, 1), 0.05))
    assert rows.shape == (2, *own.observation.shape) and not outcome.any()


def test_recordings_that_are_no_longer_than_usual_are_left_whole():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = mujoco_task(PENDULUM, [DAMPING], driven(), noises=NOISE)
    assert len(simulator_of(own).times) == 1


def test_samples_of_sensors_that_are_late_begin_later():
    own = simulator_of(task(driven(), [DAMPING, Parameter("sensor/angle/delay", (0.0, 0.1))], windows=2, window=1.0))
    assert all(0.0999 < times[0] < 0.11 for times in own.times)
    rows, _ = own.clean([[0.05, 0.0]])
    np.testing.assert_allclose(rows[0], own.observation, atol=4e-3)


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ({"windows": 0}, "windows: expected a number of at least 1, got 0"),
        ({"windows": 1.5}, "windows: expected a number of at least 1, got 1.5"),
        ({"window": 0.001}, "window: expected at least two steps of the model, 0.004 s, got 0.001"),
        ({"window": 10.0}, "windows: expected 1 of 10 s within long, which lasts 5.996 s; got more"),
        ({"windows": 3, "window": 3.0}, "windows: expected 3 of 3 s within long"),
        (
            {"windows": 2, "initial": {"hinge/qpos": 0.1}},
            r"windows: expected starts that recordings say, got others in",
        ),
        ({"windows": 2, "begins": "model"}, "windows: expected starts that recordings say"),
    ],
)
def test_windows_that_cannot_be_are_one_line(others, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        task(driven(), **others)
    assert "\n" not in str(refusal.value)


def test_a_window_without_samples_is_refused():
    log = driven(3.0)
    rare = np.where(np.arange(len(log.times)) % 100 == 0, log.signals["angle"], np.nan)
    with pytest.raises(ValueError, match=r"window: expected samples in each of 0\.1 s of log, got none"):
        task(Log(log.times, dict(log.signals) | {"angle": rare}), windows=2, window=0.1)


def test_a_long_recording_of_some_joints_only_is_left_whole_and_that_is_said():
    log = driven(2.0, interval=0.002)
    times = 0.002 * np.arange(70_000)
    signals = {"motor": np.zeros(70_000), "joint/hinge/qvel": np.resize(log.signals["angle"], 70_000)}
    with pytest.warns(
        RecordingWarning, match="which expect recordings that measure all joints, got none of hinge: sim"
    ):
        own = mujoco_task(PENDULUM, [DAMPING], Log(times, signals), noises={"joint/hinge/qvel": 0.1})
    assert len(simulator_of(own).times) == 1
    with pytest.raises(ValueError, match="windows: expected recordings that measure all joints, got none of hinge"):
        mujoco_task(PENDULUM, [DAMPING], Log(times, signals), noises={"joint/hinge/qvel": 0.1}, windows=4)


def test_a_file_says_them(tmp_path):
    (tmp_path / "rod.xml").write_text(PENDULUM)
    log = driven()
    np.savez(tmp_path / "long.npz", times=log.times, **log.signals)
    (tmp_path / "rod.toml").write_text(
        'model = "rod.xml"\nlog = ["long.npz"]\nwindows = 4\nwindow = 0.75\n'
        '[parameters."joint/hinge/damping"]\nsupport = [0.01, 0.1]\n[noise]\nangle = 0.001\n'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = simulator_of(config.read(tmp_path / "rod.toml"))
    assert [round(times[-1], 2) for times in own.times] == [0.75] * 4
