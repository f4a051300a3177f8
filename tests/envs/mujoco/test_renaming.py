"""Names and units that a task's file gives to a recording's signals."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import log_files, logs, renaming
from jaxlfi.envs.mujoco.config import read
from jaxlfi.envs.mujoco.logs import RecordingWarning
from jaxlfi.io import files
from jaxlfi.robots import driver, recording

CONFIG = """
model = "arm.xml"
log = ["swing.csv"]
measured = ["angle", "joint/elbow/qpos"]

[parameters."joint/elbow/damping"]
support = [0.01, 0.2]

[noise]
"joint/elbow/qpos" = 0.01
angle = 0.01

[signals]
tau = "actuator/motor"
q1 = { name = "angle", unit = "deg" }
q2 = { name = "joint/elbow/qpos", unit = "mrad" }
time = { unit = "ms" }
spare = false
"""


@pytest.fixture
def folder(tmp_path):
    """A laboratory's recording, with names of its own and without units; its times are in ms, one heading is wrong."""
    (tmp_path / "arm.xml").write_text(ARM)
    log = recorded()
    rows = zip(1000 * log.times, log.signals["motor"], np.rad2deg(log.signals["angle"]), strict=True)
    lines = [f"{time:.17g},{tau:.17g},{q1:.17g},{250 + 10 * k},inf" for k, (time, tau, q1) in enumerate(rows)]
    (tmp_path / "swing.csv").write_text("\n".join(["time,tau,q1,q2 [rad],spare", *lines]))
    (tmp_path / "arm.toml").write_text(CONFIG)
    return tmp_path


def test_names_and_units_of_the_file_take_the_place_of_the_recordings(folder):
    task = read(folder / "arm.toml")
    simulator = task.simulate.function
    np.testing.assert_allclose(simulator.times[0], recorded().times, atol=1e-12)
    np.testing.assert_allclose(task.observation[:, 0], recorded().signals["angle"], atol=1e-6)
    np.testing.assert_allclose(task.observation[:3, 1], [0.25, 0.26, 0.27], atol=1e-6)
    np.testing.assert_allclose(simulator.logs[0].signals["motor"], recorded().signals["motor"])


def test_a_recording_in_the_models_own_names_is_left_as_it_is(folder):
    """As the controls that `jaxlfi design` writes, or another laboratory's."""
    log = recorded()
    rows = zip(log.times, log.signals["motor"], log.signals["angle"], strict=True)
    lines = [f"{time:.17g},{tau:.17g},{q1:.17g},0.5" for time, tau, q1 in rows]
    (folder / "own.csv").write_text("\n".join(["time [s],motor,angle [rad],joint/elbow/qpos [rad]", *lines]))
    task = read(folder / "arm.toml", [folder / "own.csv"])
    np.testing.assert_allclose(task.observation[:, 0], log.signals["angle"], atol=1e-6)


def test_signals_of_the_other_sign_are_the_same_recording_to_the_bit(folder):
    log = recorded()
    rows = zip(log.times, -log.signals["motor"], -log.signals["angle"], strict=True)
    lines = [f"{time:.17g},{tau:.17g},{q1:.17g},0.5" for time, tau, q1 in rows]
    (folder / "swing.csv").write_text("\n".join(["time [s],tau,q1 [rad],q2 [rad]", *lines]))
    text = CONFIG.replace('"actuator/motor"', '{ name = "actuator/motor", scale = -1.0 }')
    text = text.replace('{ name = "angle", unit = "deg" }', '{ name = "angle", scale = -1 }')
    (folder / "arm.toml").write_text(text.replace("spare = false", ""))
    task = read(folder / "arm.toml")
    np.testing.assert_array_equal(task.simulate.function.logs[0].signals["motor"], log.signals["motor"])
    np.testing.assert_array_equal(task.observation[:, 0], log.signals["angle"].astype(np.float32))


def test_the_models_number_is_scale_times_the_recorded_one_in_the_models_unit_plus_offset(tmp_path):
    """As of a driver (`jaxlfi.robots.driver.Called`), with the same words."""
    (tmp_path / "swing.csv").write_text("time [s],q\n0,10\n1,30")
    words = {"name": "angle", "unit": "deg", "scale": -2.0, "offset": 0.25}
    (one,) = renaming.renamed(log_files.recorded(tmp_path / "swing.csv"), renaming.table_of({"signals": {"q": words}}))
    factor, offset = driver.Called(**words).factors("rad")
    expected = factor * np.array([10, 30]) + offset
    np.testing.assert_allclose(expected, -2 * np.radians([10, 30]) + 0.25)
    np.testing.assert_allclose(logs.log_of(one).signals["angle"], expected)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_what_jaxlfi_recorded_is_in_the_models_numbers_already(tmp_path, suffix):
    """The same entry is for another recording: the report beside this one says whose it is, and a line says so."""
    path = tmp_path / f"rollout{suffix}"
    columns = {"angle [rad]": np.array([1.0, 2.0, 3.0]), "motor": np.array([0.0, 0.1, 0.2])}
    times = np.array([0.0, 0.1, 0.2])
    if suffix == ".npz":
        np.savez(path, **{"time [s]": times}, **columns)
    else:
        rows = np.stack([times, *columns.values()], axis=1)
        np.savetxt(path, rows, delimiter=",", header=",".join(["time [s]", *columns]), comments="")
    called = renaming.table_of({"signals": {"angle": {"scale": -1}, "motor": {"scale": 2.0, "offset": 1.0}}})

    def angles():
        (one,) = renaming.renamed(log_files.recorded(path), called)
        return logs.log_of(one).signals["angle"].tolist()

    assert angles() == [-1.0, -2.0, -3.0]
    files.write_json(recording.beside(path)[0], {"recording": "another.csv"})
    assert angles() == [-1.0, -2.0, -3.0]
    files.write_json(recording.beside(path)[0], {"recording": path.name})
    with pytest.warns(RecordingWarning, match="angle, motor: scale and offset of .signals. are not applied"):
        assert angles() == [1.0, 2.0, 3.0]


def test_an_offset_needs_the_unit_that_only_a_name_states(tmp_path):
    """Else it would be added to degrees."""
    (tmp_path / "swing.csv").write_text("time [s],angle_deg\n0,1\n1,2")
    (one,) = log_files.recorded(tmp_path / "swing.csv")
    table = renaming.table_of({"signals": {"angle_deg": {"offset": 0.5}}})
    with pytest.raises(ValueError, match="'angle_deg': offset: expected an explicit name and unit"):
        renaming.renamed([one], table)
    table = renaming.table_of({"signals": {"angle_deg": {"name": "angle", "unit": "deg", "offset": 0.5}}})
    (one,) = renaming.renamed([one], table)
    np.testing.assert_allclose(logs.log_of(one).signals["angle"], np.radians([1, 2]) + 0.5)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            'tau = "actuator/motor"',
            'tua = "actuator/motor"',
            "signals: expected a signal of the recordings such as tau, got 'tua'",
        ),
        ('tau = "actuator/motor"', "tau = 3", r"signals: 'tau': expected a name, { name = NAME, .* or false, got 3"),
        ('tau = "actuator/motor"', "tau = { }", r"signals: 'tau': expected a name, { name = NAME"),
        ('tau = "actuator/motor"', "tau = { gain = 2 }", r"signals: 'tau': expected a name, .*got {'gain': 2}"),
        ('tau = "actuator/motor"', "tau = { scale = 0 }", "signals: 'tau': scale: expected another number than 0"),
        ('tau = "actuator/motor"', "tau = { offset = nan }", "signals: 'tau': offset: expected a number, got nan"),
        ('time = { unit = "ms" }', "time = { scale = 2 }", "signals: 'time': expected a unit only"),
        ('tau = "actuator/motor"', "tau = { unit = 2 }", "signals: 'tau': expected words in quotes, got 2"),
        ('unit = "deg"', 'unit = "furlong"', "signals: 'q1': unit: expected a unit such as .* got 'furlong'"),
        ('unit = "mrad"', 'unit = "mm"', "joint/elbow/qpos: expected rad as the sensor, got m"),
        ('tau = "actuator/motor"', 'tau = "angle"', "expected one signal called angle, got tau and q1"),
        ('time = { unit = "ms" }', 'time = { unit = "mm" }', "expected times in a unit of time, got m"),
        ("[signals]", "signals = 3\n[other]", "expected keys among"),
    ],
)
def test_what_does_not_fit_is_one_line(folder, old, new, expected):
    assert old in CONFIG
    (folder / "arm.toml").write_text(CONFIG.replace(old, new))
    with pytest.raises(ValueError, match=expected) as caught:
        read(folder / "arm.toml")
    assert "\n" not in str(caught.value)


def test_efforts_of_joints_are_what_their_actuators_apply(folder):
    """As ROS has them: the motor's gear of 1.5 times the control that is held."""
    (folder / "arm.toml").write_text("""
        model = "arm.xml"
        log = ["swing.csv"]
        measured = ["joint/shoulder/effort"]
        parameters."joint/elbow/damping".support = [0.01, 0.2]
        noise."joint/shoulder/effort" = 0.1
        signals.tau = "actuator/motor"
        signals.q1 = { name = "joint/shoulder/effort", unit = "mN m" }
        signals.time.unit = "ms"
        signals.spare = false
    """)
    task = read(folder / "arm.toml")
    assert task.channels == ("joint/shoulder/effort [N m]",)
    rows, _ = task.simulate.function.clean([[0.03]])
    np.testing.assert_allclose(rows[0, :, 0], 1.5 * recorded().signals["motor"], atol=1e-12)
