"""Tests of axes in natural units."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxlfi.figures import natural, style


@pytest.mark.parametrize("low", [-900.0, -12.0, 0.0, 3.0, 650.0])
@pytest.mark.parametrize("width", [1e-3, 0.3, 1.9, 7.0, 40.0])
@pytest.mark.parametrize("count", [3, 5])
def test_ticks_lie_within_an_axis_and_there_are_few(low, width, count):
    ticks = natural.LogTicks(count).tick_values(low, low + width)
    assert len(ticks) <= count + 1 and np.all((ticks >= low - 1e-6) & (ticks <= low + width + 1e-6))
    if abs(low) < 20:
        assert len(ticks) >= 2
        texts = [natural.LogNumbers()(tick) for tick in ticks]
        assert len(set(texts)) == len(texts)


def axis_of(scale: natural.Scale, low: float, high: float):
    """The x-axis of a panel that shows a parameter between two limits."""
    axes = style.new_figure(3, 3).subplots()
    axes.set_xlim(low, high)
    scale.show(axes.xaxis, 4)
    return axes.xaxis


def test_a_logarithm_is_read_in_its_natural_unit_with_a_prefix():
    (scale,) = natural.scales(["ln young"], ["Pa"])
    axis = axis_of(scale, np.log(4e4), np.log(6e6))
    assert axis.get_label_text() == "$\\theta_{1}$ young\n[kPa]"
    numbers = [axis.get_major_formatter()(tick) for tick in axis.get_majorticklocs()]
    np.testing.assert_allclose(np.exp(axis.get_majorticklocs()) / 1e3, [float(number) for number in numbers])
    assert "100" in numbers and "1000" in numbers


def test_a_linear_axis_has_the_prefix_too():
    axis = axis_of(natural.Scale("load", "N"), 2e3, 9e3)
    assert axis.get_label_text() == "load\n[kN]" and axis.get_major_formatter()(4000.0) == "4"
    assert axis_of(natural.Scale("load", "N"), 0.0, 900.0).get_label_text() == "load\n[N]"


@pytest.mark.parametrize("ratio", [1.05, 1.3, 3.5, 4.6, 9.0, 30.0, 3e3, 1e7])
@pytest.mark.parametrize("low", [1.0, 0.0123, 0.77])
def test_numbers_on_a_logarithmic_scale_do_not_overlap(low, ratio):
    """Matplotlib's own locator writes a number at every tick of a linear axis where the ends differ by little."""
    with style.context():
        figure = Figure(figsize=(3.5, 1.5), layout="constrained")
        axes = figure.subplots()
        axes.set(xscale="log", xlim=(low, ratio * low))
        natural.scale_ticks(axes.xaxis, 5)
        FigureCanvasAgg(figure).draw()
    inside = [text for text in axes.get_xticklabels() if low <= text.get_position()[0] <= ratio * low]
    boxes = [text.get_window_extent() for text in inside]
    assert 2 <= len(boxes) <= 6 and all(text.get_text() for text in inside)
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))
