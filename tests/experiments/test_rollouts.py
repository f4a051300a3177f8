"""The study of several rollouts: its tables from arrays whose figures are known, and its truths."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from experiments.rollouts import found, line, truths
from jaxlfi.envs.whip.parameters import INITIAL
from jaxlfi.envs.whip.reference_objects.objects import TABLE


def test_errors_widths_and_intervals_against_numpy():
    grid = np.linspace(-1.0, 1.0, 501)
    spread = np.stack([10 * grid, grid], axis=-1)  # 90 % of them within 9 mm, and within 0.9 of ln E
    offset = np.array([[3.0, 0.1], [9.5, 0.3], [1.0, -2.0]])
    theta = np.full((3, 2), 5.0)
    row = line("4 mean", {"draws": theta[:, None] + offset[:, None] + spread, "theta": theta, "seconds": np.array(6.0)})
    assert row["rollouts"] == "4 mean" and row["truths"] == 3 and row["seconds"] == 2.0
    np.testing.assert_allclose([row["error of mm"], row["error of ln E"]], [4.5, 0.8])
    np.testing.assert_allclose([row["median error of mm"], row["median error of ln E"]], [3.0, 0.3])
    np.testing.assert_allclose([row["sd of mm"], row["sd of ln E"]], [10 * grid.std(), grid.std()])
    assert (row["length in 90 %"], row["ln E in 90 %"]) == (2, 2)


def test_lines_of_the_reference_objects():
    theta = np.tile([200.0, np.log(8e3)], (8, 1))
    draws = theta[:, None] + np.linspace(-1, 1, 501)[None, :, None] * np.array([10.0, np.log(2.0)])
    draws[1, :, 1] += 1.0
    box = np.tile([150.0, np.log(1e3)], (8, 1)), np.tile([300.0, np.log(5e4)], (8, 1))
    rows = found("mean", {"draws": draws, "theta": theta, "seeds": np.tile([0, 1], 4), "low": box[0], "high": box[1]})
    assert [row["object"] for row in rows] == [dlo.name for dlo in TABLE for _ in range(2)]
    assert [row["seed"] for row in rows] == [0, 1] * 4
    assert rows[0]["length [mm]"] == "200 [191, 209]" and rows[0]["support E [kPa]"] == "[1, 50]"
    low, high = 8 * np.exp(np.array([-0.9, 0.9]) * np.log(2.0))
    assert rows[0]["E [kPa]"] == f"8.0 [{low:.1f}, {high:.1f}]"
    assert rows[0]["holds E by sag"] and not rows[1]["holds E by sag"]


def test_truths_lie_in_the_initial_support_and_differ_by_seed():
    drawn = np.concatenate([truths(0, 200), truths(1000, 200)]) / [1e3, 1.0]
    assert np.all((drawn > np.asarray(INITIAL.low)) & (drawn < np.asarray(INITIAL.high)))
    assert len(np.unique(drawn[:, 0])) == 400
    np.testing.assert_array_equal(truths(3, 5), truths(3, 5))
