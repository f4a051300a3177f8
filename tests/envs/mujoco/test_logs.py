"""Recordings from tables and arrays, compared with what was written into them."""

import warnings

import numpy as np
import pytest

from jaxlfi.envs.mujoco.logs import Log, RecordingWarning, read
from jaxlfi.io import lerobot, mcap
from jaxlfi.io.rollout import Rollout, Signal

TABLE = """\
time [ms],motor [mN m],angle [deg],rate
1000,500,90,0.1
1010,,180,0.2
1030,-250,,0.3
"""


def test_a_table_in_units_of_its_own_with_missing_samples(tmp_path):
    path = tmp_path / "swing.csv"
    path.write_text(TABLE)
    log = read(path)
    np.testing.assert_allclose(log.times, [0, 0.01, 0.03], atol=1e-12)
    assert list(log.signals) == ["motor", "angle", "rate"]
    np.testing.assert_allclose(log.signals["motor"], [0.5, np.nan, -0.25])
    np.testing.assert_allclose(log.signals["angle"], [np.pi / 2, np.pi, np.nan])
    np.testing.assert_allclose(log.signals["rate"], [0.1, 0.2, 0.3])


def test_arrays_of_one_and_of_several_numbers(tmp_path):
    path = tmp_path / "swing.npz"
    np.savez(path, times=[5.0, 5.5], angle=[1, 2], imu=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    log = read(path)
    assert log.times.tolist() == [0.0, 0.5] and list(log.signals) == ["angle", "imu[0]", "imu[1]", "imu[2]"]
    assert log.signals["imu[1]"].tolist() == [2.0, 5.0]


@pytest.mark.parametrize(
    ("heading", "unit"),
    [("time [ms]", 1e-3), ("Time (us)", 1e-6), ("t_ns", 1e-9), ("timestamp [min]", 60.0), ("time_s", 1.0)],
)
def test_times_are_in_the_unit_of_their_heading(tmp_path, heading, unit):
    """Times since the Unix epoch keep their digits."""
    seconds, begin = 0.01 * np.arange(5), 1_700_000_000
    per_second = round(1 / unit) if unit < 1 else 1 / unit
    ticks = [begin * per_second + (round(time / unit) if unit < 1 else float(time) / unit) for time in seconds]
    (tmp_path / "a.csv").write_text("\n".join([f"{heading},angle", *(f"{tick!r},0.5" for tick in ticks)]))
    np.savez(tmp_path / "a.npz", **{heading: ticks, "angle": np.full(5, 0.5)})
    for name in ("a.csv", "a.npz"):
        np.testing.assert_allclose(read(tmp_path / name).times, seconds, atol=3e-7 if unit >= 1 else 1e-12)


def test_integers_far_apart_are_nanoseconds_and_so_are_datetimes(tmp_path):
    seconds = 0.01 * np.arange(5)
    stamps = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(5)
    np.savez(tmp_path / "a.npz", times=stamps, angle=np.ones(5))
    (tmp_path / "a.csv").write_text("\n".join(["time,angle", *(f"{stamp},1" for stamp in stamps)]))
    for name in ("a.npz", "a.csv"):
        with pytest.warns(RecordingWarning, match=r"integers 1e\+07 apart without a unit: read as ns, 0.01 s apart"):
            log = read(tmp_path / name)
        np.testing.assert_allclose(log.times, seconds, atol=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for kind in ("datetime64[ns]", "datetime64[us]"):
            log = Log(stamps.astype("datetime64[ns]").astype(kind), {"angle": np.ones(5)})
            np.testing.assert_allclose(log.times, seconds, atol=1e-12)
            assert log.units == {"time": "s"}
        assert Log([0, 1, 2], {"angle": [0, 1, 2]}).times.tolist() == [0, 1, 2]


def test_signals_of_arrays_and_logs_are_in_units_of_their_own(tmp_path):
    values = {"angle [deg]": [90.0, 180.0], "imu [mm/s]": [[1.0, 2.0], [3.0, 4.0]], "oven (left)": [1.0, 2.0]}
    np.savez(tmp_path / "a.npz", times=[0.0, 1.0], **values)
    log = read(tmp_path / "a.npz")
    np.testing.assert_allclose(log.signals["angle"], [np.pi / 2, np.pi])
    np.testing.assert_allclose(log.signals["imu[1]"], [0.002, 0.004])
    assert log.units == {"angle": "rad", "imu[0]": "m/s", "imu[1]": "m/s"} and "oven (left)" in log.signals
    log = Log([0.0, 1.0], {"heat": [0.0, 100.0], "speed": [60.0, 30.0]}, units={"heat": "°C", "speed": "rpm"})
    np.testing.assert_allclose(log.signals["heat"], [273.15, 373.15])
    np.testing.assert_allclose(log.signals["speed"], [2 * np.pi, np.pi])
    with pytest.raises(ValueError, match=r"log: speed: expected a unit such as .* got 'furlong'"):
        Log([0.0, 1.0], {"speed": [60.0, 30.0]}, units={"speed": "furlong"})


def test_signals_of_robotics_formats_are_in_the_units_that_they_say(tmp_path):
    times = 0.02 * np.arange(6)
    state = Signal(times, np.full((6, 2), 90.0), ("shoulder", "lift [mm]"), "deg")
    force = Signal(times, np.full((6, 2), 3.0), ("pull", "twist"), ("kN", "mN m"))
    rollout = Rollout({"observation.state": state, "observation.force": force})
    mcap.write(tmp_path / "a.mcap", rollout)
    lerobot.write(tmp_path / "set", [rollout, rollout], "observation.state", 50)
    for name in ("a.mcap", "set#episode=1"):
        log = read(tmp_path / name)
        found = {name: float(values[0]) for name, values in log.signals.items()}
        assert found == pytest.approx({"shoulder": np.pi / 2, "lift": 0.09, "pull": 3e3, "twist": 3e-3})
        assert log.units.items() >= {"shoulder": "rad", "lift": "m", "pull": "N", "twist": "N m"}.items()
    with pytest.raises(ValueError, match="one of its 2 episodes, got none: name it as set#episode=0"):
        read(tmp_path / "set")
    with pytest.raises(ValueError, match=r"state: expected one sample at a time, got 0.02 in sample 3 after 0.02$"):
        twice = Signal(np.array([0.0, 0.02, 0.02]), np.ones((3, 1)), ("a",))
        mcap.write(tmp_path / "twice.mcap", Rollout({"state": twice}))
        read(tmp_path / "twice.mcap")
    mcap.write(tmp_path / "b.mcap", Rollout({"state": Signal(times, np.ones((6, 1)), ("a",), "furlong")}))
    with pytest.raises(ValueError, match=r"b\.mcap: a: expected a unit such as .* got 'furlong'"):
        read(tmp_path / "b.mcap")


def test_times_of_a_data_set_agree_with_its_frame_rate(tmp_path):
    """They are in the unit that the data set says, and refused where they cannot be seconds."""
    frames = Signal(20_000_000.0 * np.arange(6), np.ones((6, 1)), ("a",))
    lerobot.write(tmp_path / "set", [Rollout({"state": frames})], "state", 50)
    with pytest.raises(ValueError, match=r"time: expected seconds, 0\.02 apart at 50 frames .* they look like ns"):
        read(tmp_path / "set")
    info = tmp_path / "set/meta/info.json"
    info.write_text(info.read_text().replace('"time": {', '"time": {"info": {"unit": "ns"}, ', 1))
    np.testing.assert_allclose(read(tmp_path / "set").times, 0.02 * np.arange(6))


def test_a_control_holds_until_the_next():
    log = Log([0.0, 0.1, 0.2, 0.3], {"motor": [1.0, np.nan, 3.0, np.nan]})
    assert log.held("motor", np.array([-1.0, 0.0, 0.19, 0.2, 9.0])).tolist() == [1.0, 1.0, 1.0, 3.0, 3.0]
    assert log.held("motor", np.array([[0.0], [0.2]])).tolist() == [[1.0], [3.0]]


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.csv", "time [s],angle [furlong]\n0,1\n1,2\n", "expected a heading as 'NAME \\[unit\\]' with a unit of "),
        (
            "a.csv",
            "angle,rate\n0,1\n1,2\n",
            "expected times in the first column, headed 'time \\[s\\]', got 'angle'",
        ),
        ("a.csv", "time [s],angle,angle [rad]\n0,1,1\n1,2,2\n", "expected each heading once"),
        ("a.csv", "time [s],angle\n0,1\n1\n", "line 3: expected 2 cells, got 1"),
        ("a.csv", "time [s],angle\n0,1\n1,two\n", "line 3: expected numbers, got '1,two'"),
        ("a.csv", "time [s],angle\n1,1\n0,2\n", "expected at least two increasing times, got 0 in row 2 after 1"),
        (
            "a.csv",
            "time [s],a\n0,1\n1,2\n1,3\n0,4\n",
            "got 1 in row 3 after 1; row 3 repeats a time and row 4 goes back",
        ),
        ("a.csv", "time [deg],angle\n0,1\n1,2\n", "expected times in a unit of time, got rad"),
        ("a.csv", "time_mm,angle\n0,1\n1,2\n", "headed 'time \\[s\\]', got 'time_mm'"),
        ("a.csv", "time [s],angle\n0,\n1,\n", "angle: expected finite samples, got infinite ones or none at all"),
        ("a.csv", "time [s],angle\n0,inf\n1,1\n", "angle: expected finite samples"),
        ("a.csv", "time [s],angle\n0,1\n", "expected a line of headings and two of numbers, got 2 lines"),
        ("a.npz", "not a zip", "expected a complete .npz file"),
        ("a.txt", "", "log: expected NAME.npz, NAME.csv"),
    ],
)
def test_what_is_no_recording_is_one_line(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=expected) as caught:
        read(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"angle": [1, 2]}, "expected one array of times, called 'times'"),
        ({"times": [0, 1], "time": [0, 1]}, "expected one array of times"),
        ({"times": [0, 1], "angle": [1, 2, 3]}, "angle: expected a sample for each of 2 times"),
        ({"times": [0, 1], "angle": ["a", "b"]}, "angle: expected numbers"),
        ({"times": [0, np.nan], "angle": [1, 2]}, "expected at least two increasing times, got nan in row 2"),
        ({"times": [0, 1], "angle": [1, 2], "angle [deg]": [1, 2]}, "expected each signal once, got 'angle' twice"),
        ({"times": np.float32(1.7e9) + np.arange(9, dtype=np.float32), "a": np.ones(9)}, "float32 .* double precision"),
    ],
)
def test_arrays_that_are_no_recording(tmp_path, arrays, expected):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=expected):
        read(tmp_path / "a.npz")
