"""Learning curves: the running mean, and lines that show what was saved."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from jaxlfi.figures import learning


@given(st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_running_means_are_of_the_last_known_values(window, seed):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(8, 2))
    values[rng.random((8, 2)) < 0.3] = np.nan
    got = learning.running_mean(values, window)
    for i in range(8):
        for column in range(2):
            last = values[max(0, i - window + 1) : i + 1, column]
            known = last[np.isfinite(last)]
            expected = known.mean() if known.size else np.nan
            np.testing.assert_allclose(got[i, column], expected, atol=1e-12)


def test_a_line_is_the_median_of_a_domains_seeds_and_a_band_their_quartiles():
    names = [("uniform", 0), ("uniform", 1), ("uniform", 2), ("median", 0)]
    returns = np.stack([np.arange(30.0), np.arange(30.0) + 2, np.arange(30.0) + 9, -np.arange(30.0)], axis=1)
    figure = Figure()
    learning.draw(figure, names, returns, steps_per_update=192)
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.get_lines() if not line.get_label().startswith("_")}
    assert set(lines) == {"uniform", "median"} and len(axes.get_lines()) == 2
    np.testing.assert_array_equal(lines["median"].get_xdata(), 192 * np.arange(1, 31))
    middle = learning.running_mean(returns[:, 1:2], learning.WINDOW)[:, 0]
    np.testing.assert_allclose(lines["uniform"].get_ydata(), middle)
    (band,) = axes.collections
    ends = band.get_paths()[0].vertices[:, 1]
    assert ends.max() == middle[-1] + 3.5 and ends.min() == middle[0] - 1.0
    np.testing.assert_allclose(lines["median"].get_ydata()[-1], -23.5)
