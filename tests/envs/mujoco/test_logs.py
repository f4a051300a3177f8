"""Recordings, from tables and arrays, against what was written into them."""

import numpy as np
import pytest

from jaxlfi.envs.mujoco.logs import Log, read

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
            "angle,time [s]\n0,1\n1,2\n",
            "expected times in the first column, headed 'time \\[s\\]', got 'angle'",
        ),
        ("a.csv", "time [s],angle,angle [rad]\n0,1,1\n1,2,2\n", "expected each heading once"),
        ("a.csv", "time [s],angle\n0,1\n1\n", "line 3: expected 2 cells, got 1"),
        ("a.csv", "time [s],angle\n0,1\n1,two\n", "line 3: expected numbers, got '1,two'"),
        ("a.csv", "time [s],angle\n1,1\n0,2\n", "expected at least two increasing times"),
        ("a.csv", "time [s],angle\n0,\n1,\n", "angle: expected finite samples, got infinite ones or none at all"),
        ("a.csv", "time [s],angle\n0,inf\n1,1\n", "angle: expected finite samples"),
        ("a.csv", "time [s],angle\n0,1\n", "expected a line of headings and two of numbers, got 2 lines"),
        ("a.npz", "not a zip", "expected a whole .npz file"),
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
        ({"times": [0, np.nan], "angle": [1, 2]}, "expected at least two increasing times"),
    ],
)
def test_arrays_that_are_no_recording(tmp_path, arrays, expected):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=expected):
        read(tmp_path / "a.npz")
