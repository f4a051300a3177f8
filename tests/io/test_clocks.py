"""Which rows of time stamps repeat, go back or have none, against a plain loop."""

import re

import numpy as np
import pytest

from jaxlfi.io import clocks


@pytest.mark.parametrize("seed", range(5))
def test_rows_are_those_of_a_plain_loop(seed):
    random = np.random.default_rng(seed)
    times = np.arange(40.0) / 8
    for place in random.choice(39, 3, replace=False):
        times[place + 1] = times[place]
    times[20], times[21] = times[21], times[20] - 0.5
    same = [row + 1 for row in range(1, 40) if times[row] == times[row - 1]]
    back = [row + 1 for row in range(1, 40) if times[row] < times[row - 1]]
    rows, fault = clocks.order(times)
    assert times[rows].tolist() == sorted(times.tolist())
    said = [[int(number) for number in re.findall(r"\d+", part)] for part in fault.partition("; ")[2].split(" repeat")]
    assert said[0] == same and said[-1] == back
    assert clocks.order(times, repeated=True).fault.count("repeat") == 0


def test_times_in_order_have_no_fault():
    assert clocks.order(np.array([-1.0, 0.0, 5.0])).fault == ""
    assert clocks.order(np.array([0.0, 0.0, 5.0]), repeated=True).fault == ""


def test_all_digits_of_a_clock_in_nanoseconds_are_said():
    stamps = 1_700_000_000_000_000_000 + np.array([0, 5, 3, 9])
    fault = clocks.order(stamps, "message").fault
    assert fault == "1700000000000000003 in message 3 after 1700000000000000005"


def test_missing_times_are_left_out():
    rows, fault = clocks.order(np.array([2.0, np.nan, 1.0, np.inf]))
    assert rows.tolist() == [2, 0] and fault == "nan in row 2; rows 2 and 4 have none"
