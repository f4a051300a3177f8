"""Signals: what is held between their times, what is read off intervals, and what does not fit."""

import numpy as np
import pytest

from jaxlfi.io.rollout import Rollout, Signal, array, numbers

TIMES = 0.16 * np.arange(16)
STEPS = np.arange(32.0).reshape(16, 2) + 1


def test_actions_are_held_until_the_next_and_end():
    signal = Signal(TIMES, STEPS, ("dx", "dz"), "m", duration=0.16)
    frames = np.arange(-2, 100)  # thirtieths of a second; an interval has 4.8 of them
    expected = [STEPS[10 * frame // 48] if 0 <= 10 * frame < 16 * 48 else (0, 0) for frame in frames]
    np.testing.assert_array_equal(signal.held(frames / 30), expected)


def test_a_frame_at_the_beginning_of_an_interval_belongs_to_it():
    """7 times 0.16 is a little more than 1.12, and 2.56 the end."""
    signal = Signal(TIMES, STEPS, ("dx", "dz"), duration=0.16)
    for k in range(16):
        for near in (round(0.16 * k, 2), 0.16 * k, 0.16 * k - 1e-9):
            np.testing.assert_array_equal(signal.held([near]), STEPS[k : k + 1])
    np.testing.assert_array_equal(signal.held([2.56, 2.56 - 1e-9]), np.zeros((2, 2)))


def test_without_a_duration_the_last_value_stays():
    signal = Signal([1.0, 2.0], np.array([[True], [False]]), ("open",))
    held = signal.held([0.9, 1.5, 2.5, 99.0])
    assert held.dtype == bool and held.ravel().tolist() == [False, True, False, False]


@pytest.mark.parametrize("rate", [6.25, 10.0, 30.0, 62.5])
def test_what_is_held_at_frames_is_read_off_them(rate):
    frames = np.arange(-1, 2.6 * rate) / rate
    rows = Signal(TIMES, STEPS, ("dx", "dz"), duration=0.16).held(frames)
    np.testing.assert_array_equal(Signal(frames, rows, ("dx", "dz")).each(0.16, 16), STEPS)


def test_intervals_without_a_frame_or_of_two_minds_are_refused():
    frames = np.arange(80) / 30
    rows = Signal(TIMES, STEPS, ("dx", "dz"), duration=0.16).held(frames)
    lost = (frames < 0.32) | (frames >= 0.48)
    with pytest.raises(ValueError, match=r"expected one value from 0.32 to 0.48 s, .*, got none"):
        Signal(frames[lost], rows[lost], ("dx", "dz")).each(0.16, 16)
    rows[8, 1] += 1
    with pytest.raises(ValueError, match=r"from 0.16 to 0.32 s, .*, got several"):
        Signal(frames, rows, ("dx", "dz")).each(0.16, 16)
    with pytest.raises(ValueError, match="interval: expected a positive number"):
        Signal(frames, rows, ("dx", "dz")).each(0.0, 16)


@pytest.mark.parametrize(
    ("times", "values", "names", "message"),
    [
        ([0.0, 1.0], [[1.0]], ("a",), "values: expected a row of numbers for each"),
        ([], np.zeros((0, 1)), ("a",), "values: expected a row of numbers for each"),
        ([0.0], [["up"]], ("a",), "values: expected a row of numbers"),
        ([0.0], [1.0], ("a",), "values: expected a row of numbers"),
        ([1.0, 0.0], [[1.0], [2.0]], ("a",), "times: expected finite ones in order"),
        ([0.0, np.nan], [[1.0], [2.0]], ("a",), "times: expected finite ones in order"),
        ([0.0], [[1.0, 2.0]], ("a",), "names: expected 2, one for each number, got 1"),
    ],
)
def test_signals_that_do_not_fit_are_refused(times, values, names, message):
    with pytest.raises(ValueError, match=message):
        Signal(times, values, names)


def test_names_that_a_format_cannot_hold_are_refused():
    for name in ("", "a/b", "a b"):
        with pytest.raises(ValueError, match="signals: expected names without spaces and slashes"):
            Rollout({name: Signal([0.0], [[1.0]], ("a",))})


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int64", "float32", "float64"])
def test_arrays_come_back_from_json(dtype):
    values = (np.random.default_rng(0).uniform(0, 7, (5, 3))).astype(dtype)
    back = array(numbers(values), dtype)
    assert back.dtype == values.dtype
    np.testing.assert_array_equal(back, values)


def test_what_is_not_finite_becomes_nan():
    lists = numbers(np.array([[np.nan, 0.1, -np.inf]], np.float32))
    assert lists == [[None, float(np.float32(0.1)), None]]
    np.testing.assert_array_equal(array(lists, "float32"), np.array([[np.nan, 0.1, np.nan]], np.float32))


@pytest.mark.parametrize(
    ("lists", "dtype"),
    [([[1.5]], "bool"), ([["up"]], "float32"), ([[1.0]], "object"), ([[1], [1, 2]], "int64"), ([[256]], "uint8")],
)
def test_other_lists_are_refused(lists, dtype):
    with pytest.raises(ValueError, match="expected an array of"):
        array(lists, dtype)
