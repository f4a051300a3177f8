"""Pair plots of anybody's arrays: what is drawn is what was given, and what cannot be drawn is refused in one line."""

import io
import subprocess
import sys
import types

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from PIL import Image

from jaxlfi import plot
from jaxlfi.figures import style

NAMES, UNITS = ("stiffness", "cost_$", "friction"), ("N/m", "", "1")
RNG = np.random.default_rng(7)
DRAWS = np.column_stack([RNG.lognormal(1.0, 0.3, 400), RNG.normal(0.4, 0.1, 400), RNG.uniform(0.2, 0.9, 400)])
TRUTH = (2.7, np.nan, 0.5)
BOX = (np.array([0.5, -1.0, 0.2]), np.array([9.0, 2.0, 0.9]))


def panels(figure) -> np.ndarray:
    """The axes of the lower triangle by row and column; None above it."""
    shown = iter([axes for axes in figure.axes if axes.axison])
    dim = int(np.sqrt(2 * sum(axes.axison for axes in figure.axes)))
    found = np.full((dim, dim), None)
    for row in range(dim):
        for column in range(row + 1):
            found[row, column] = next(shown)
    return found


def marked(axes, gid):
    """The artists drawn under a name."""
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def legend(figure) -> list[str]:
    """The legend's entries."""
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.fixture(scope="module")
def one():
    """One set of samples with all that can be marked."""
    before = dict(matplotlib.rcParams)
    figure = plot.pairs(
        DRAWS,
        names=NAMES,
        units=UNITS,
        truth=TRUTH,
        support=types.SimpleNamespace(low=BOX[0], high=BOX[1]),
        log=[True, False, False],
    )
    assert dict(matplotlib.rcParams) == before
    return panels(figure), figure


def test_axes_have_names_and_units_and_round_ticks(one):
    grid, _ = one
    assert [axes.get_xlabel() for axes in grid[-1]] == ["stiffness\n[N/m]", r"cost \$", "friction"]
    assert [axes.get_ylabel() for axes in grid[:, 0]] == ["", r"cost \$", "friction"]
    for axes in grid[-1]:
        low, high = axes.get_xlim()
        assert 2 <= sum(low <= tick <= high for tick in axes.get_xticks()) <= 6


def test_a_logarithm_is_taken_of_draws_truth_and_support(one):
    grid, _ = one
    (outline,) = marked(grid[0, 0], "marginal")
    ends = outline.get_xy()[:, 0].min(), outline.get_xy()[:, 0].max()
    np.testing.assert_allclose(ends, [np.log(DRAWS[:, 0].min()), np.log(DRAWS[:, 0].max())])
    assert marked(grid[0, 0], "truth")[0].get_xdata()[0] == pytest.approx(np.log(2.7))
    (point,) = marked(grid[2, 0], "truth")
    np.testing.assert_allclose(point.get_xydata(), [[np.log(2.7), 0.5]])
    (box,) = [patch for patch in grid[2, 0].patches if patch.get_zorder() == 2]
    np.testing.assert_allclose(box.get_xy(), [np.log(0.5), 0.2])
    np.testing.assert_allclose([box.get_width(), box.get_height()], [np.log(9.0 / 0.5), 0.9 - 0.2])
    # Nothing marks the parameter whose truth is unknown.
    assert not any(marked(axes, "truth") for axes in (grid[1, 0], grid[1, 1], grid[2, 1]))


def test_the_legend_names_what_is_drawn(one):
    _, figure = one
    assert legend(figure) == ["50 % of the draws", "80 % of the draws", "95 % of the draws", "support", "truth"]
    assert legend(plot.pairs(DRAWS[:, :2], log=[True, False])) == [f"{f} % of the draws" for f in (50, 80, 95)]
    wide = plot.pairs(DRAWS[:, 1:], support=([-1e6] * 2, [1e6] * 2))  # no bound is in view
    assert "support" not in legend(wide)


def test_names_choose_logarithms_as_booleans_do(one):
    figure = plot.pairs(DRAWS[:, :1], names=("stiffness",), units=("N/m",), log="stiffness")
    grid, _ = one
    (axes,) = figure.axes
    assert axes.get_xlabel() == grid[2, 0].get_xlabel()
    np.testing.assert_allclose(marked(axes, "marginal")[0].get_xy(), marked(grid[0, 0], "marginal")[0].get_xy())
    assert not figure.legends


def test_several_sets_share_the_axes_in_looks_of_their_own(tmp_path):
    sets = {"run_1": DRAWS[:, :2], "MCMC": DRAWS[:, :2] + [4.0, 0.0]}
    path = tmp_path / "new" / "pairs.png"
    figure = plot.pairs(sets, truth=TRUTH[:2], path=path, dpi=40)
    grid = panels(figure)
    assert [axes.get_xlabel() for axes in grid[-1]] == [r"$\theta_{1}$", r"$\theta_{2}$"]
    assert legend(figure) == ["run 1", "MCMC", "contours: 50, 80, 95 % of the draws", "truth"]
    lines = figure.legends[0].get_lines()[:2]
    assert lines[0].get_color() != lines[1].get_color() and lines[0].get_linestyle() != lines[1].get_linestyle()
    outlines = marked(grid[0, 0], "marginal")
    starts = [outline.get_xy()[:, 0].min() for outline in outlines]
    np.testing.assert_allclose(starts, [draws[:, 0].min() for draws in sets.values()])
    assert len(marked(grid[0, 0], "truth")) == 1  # not once for each set
    low, high = grid[1, 0].get_xlim()
    assert all(((draws[:, 0] > low) & (draws[:, 0] < high)).mean() > 0.99 for draws in sets.values())
    assert imread(path).shape[1] == round(40 * figure.get_size_inches()[0])


def test_points_have_their_intervals():
    """A point that is called as a set looks like it; one interval reaches far beyond the draws, another is unknown."""
    sets = {"posterior": DRAWS, "run": DRAWS + 0.1}
    far = (np.array([9.0, 0.9, 0.8]), np.array([[8.0, 40.0], [np.nan, np.nan], [0.7, 0.85]]))
    points = {"run": ((2.0, 0.5, 0.6), [[1.5, 3.0], [0.4, 0.55], [0.3, 0.65]]), "other": far}
    figure = plot.pairs(sets, names=NAMES, log=[True, False, False], points=points)
    grid = panels(figure)
    near, other = marked(grid[2, 0], "point")
    np.testing.assert_allclose(near.get_xydata(), [[np.log(2.0), 0.6]])
    np.testing.assert_allclose(other.get_xydata(), [[np.log(9.0), 0.8]])
    ends = [line.get_xydata() for line in marked(grid[2, 0], "interval")]
    np.testing.assert_allclose(ends[0], [[np.log(1.5), 0.6], [np.log(3.0), 0.6]])
    np.testing.assert_allclose(ends[1], [[np.log(2.0), 0.3], [np.log(2.0), 0.65]])
    np.testing.assert_allclose(ends[2], [[np.log(8.0), 0.8], [np.log(40.0), 0.8]])
    assert np.log(40.0) < grid[2, 0].get_xlim()[1]
    assert np.isnan(marked(grid[2, 1], "interval")[2].get_xdata()).all()
    heights = [line.get_ydata()[0] for line in marked(grid[0, 0], "point")]
    assert len(set(heights)) == 2 and max(heights) < grid[0, 0].get_ylim()[1]
    assert legend(figure) == ["posterior", "run", "contours: 50, 80, 95 % of the draws", "other"]
    posterior, run, _, last = figure.legends[0].get_lines()
    assert [posterior.get_marker(), run.get_marker(), last.get_marker()] == ["None", "D", "s"]
    assert run.get_color() == near.get_color() != other.get_color() == last.get_color()


@pytest.mark.parametrize("place", [0.0, 3.0, -1e-6])
def test_draws_that_do_not_vary_are_in_sight(place):
    axes = panels(plot.pairs(np.full((30, 2), place)))[1, 0]
    low, high = axes.get_xlim()
    outline = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    assert low < outline[:, 0].min() < place < outline[:, 0].max() < high


def shown(value, type_printers) -> list[bytes]:
    """What IPython's display formatter makes a png of: by a printer for a type, else by the value's own method.

    As `IPython.core.formatters.BaseFormatter.__call__` looks it up.
    """
    printers = [type_printers[kind] for kind in type(value).__mro__ if kind in type_printers]
    own = getattr(type(value), "_repr_png_", None)
    return [(printers or [own])[0](value)] if printers or own else []


@pytest.mark.parametrize("inline", [False, True])
def test_a_notebook_shows_a_figure_once(inline):
    """This also holds if `%matplotlib inline` has registered a printer, which shows every figure that pyplot holds."""
    before = dict(matplotlib.rcParams)
    figure = plot.pairs(DRAWS)
    (content,) = shown(figure, {Figure: lambda figure: style.png(figure, 72)} if inline else {})
    with Image.open(io.BytesIO(content)) as image:
        assert image.format == "PNG"
        assert image.width == pytest.approx((72 if inline else style.NOTEBOOK_DPI) * style.TEXT_WIDTH, abs=1)
    assert figure._repr_html_() is None and dict(matplotlib.rcParams) == before


def test_ipython_shows_a_figure():
    formatters = pytest.importorskip("IPython.core.formatters")
    data, _ = formatters.DisplayFormatter().format(plot.pairs(DRAWS[:, :1]))
    assert data["image/png"] and "text/html" not in data


def marginal_of(axes) -> tuple[np.ndarray, np.ndarray]:
    """Edges and heights of the bins of a marginal that are in view."""
    corners = next(patch for patch in axes.patches if patch.get_gid() == "marginal").get_xy()
    edges = np.unique(corners[:, 0])
    heights = [corners[(corners[:, 0] == left), 1].max() for left in edges]
    low, high = axes.get_xlim()
    assert np.all((edges >= low) & (edges <= high))
    return edges, np.array(heights)


NORMAL = np.random.default_rng(3).normal(size=(2000, 2))
FAR = {
    "one": [[1e6, -1e6]],
    "one as far as numbers reach": [[1e300, -1e300]],
    "one in one parameter": [[1e6, 0.0]],
    "half a percent over a wide box": np.random.default_rng(4).uniform(-1000, 1000, (10, 2)),
    "a percent and a half on one side": np.random.default_rng(5).uniform(100, 1e5, (20, 2)),
}


@pytest.mark.parametrize("far", FAR)
@pytest.mark.parametrize("support", [None, ([-1e6, -1e6], [1e6, 1e6])], ids=["", "with a box"])
def test_a_bell_stays_a_bell_where_a_few_draws_are_far_away(far, support):
    support = None if far == "one as far as numbers reach" else support
    draws = np.vstack([NORMAL, FAR[far]])
    grid = panels(plot.pairs(draws, support=support))
    near = panels(plot.pairs(NORMAL))
    for d in range(2):
        edges, heights = marginal_of(grid[d, d])
        low, high = grid[d, d].get_xlim()
        assert -6 < low < -2 and 2 < high < 6
        middle = (edges[1:] + edges[:-1]) / 2
        bell = np.exp(-(middle**2) / 2)
        np.testing.assert_allclose(heights[1:], bell, atol=0.25)  # scaled to the highest bin
        assert np.count_nonzero(heights > 0.5) > 5
    # Contours enclose what they enclose without the far ones.
    areas = [contour_areas(own[1, 0]) for own in (grid, near)]
    np.testing.assert_allclose(*areas, rtol=0.12)


def contour_areas(axes) -> list[float]:
    """Areas that the filled contours enclose, the outermost first."""
    (filled,) = axes.collections
    extents = [path.get_extents() for path in filled.get_paths()]
    return [extent.width * extent.height for extent in extents]


def test_two_narrow_modes_and_a_tail_are_all_in_view():
    """What many draws agree on is never left out, however far from the densest half."""
    rng = np.random.default_rng(0)
    modes = np.where(rng.random((1000, 1)) < 0.5, -300.0, 300.0) + 0.01 * rng.normal(size=(1000, 1))
    rare = np.where(rng.random((2000, 1)) < 0.03, 30.0, 0.0) + 0.1 * rng.normal(size=(2000, 1))
    for draws, tops in ((modes, (-300.0, 300.0)), (rare, (0.0, 30.0)), (rng.exponential(size=(2000, 1)), (0.1, 5.0))):
        low, high = plot.pairs(draws).axes[0].get_xlim()
        assert low < tops[0] and tops[1] < high


def test_draws_of_widths_and_offsets_of_all_kinds_have_bins_that_resolve_them():
    rng = np.random.default_rng(1)
    narrow = rng.normal(size=(2000, 1))
    figure = plot.pairs({"narrow": narrow, "wide": 1000 * narrow})
    assert all(len(np.unique(patch.get_xy()[:, 0])) > 24 for patch in marked(figure.axes[0], "marginal"))
    offset = plot.pairs(1e6 + 1e-3 * narrow).axes[0]
    edges, heights = marginal_of(offset)
    assert np.ptp(offset.get_xlim()) < 0.02 and np.count_nonzero(heights > 0.5) > 5
    for place in (0.0, 3.0, -1e-6, 1e6):  # all in one place: one bin
        edges, heights = marginal_of(plot.pairs(np.full((30, 1), place)).axes[0])
        assert np.count_nonzero(heights) <= 2 and edges[0] < place < edges[-1]
    neighbours = np.where(rng.random((50, 2)) < 0.5, 1e6, np.nextafter(1e6, np.inf))
    assert plot.pairs(neighbours).axes[0].get_xlim()[0] < 1e6
    bound = np.where(rng.random((1000, 2)) < 0.7, 1.0, rng.random((1000, 2)))
    edges, heights = marginal_of(panels(plot.pairs(bound, support=([0, 0], [1, 1])))[0, 0])
    assert edges[-1] == 1.0 and heights[-2] == pytest.approx(1.0)  # most of them lie on the bound


def test_draws_beyond_the_support_are_drawn_where_they_are():
    grid = panels(plot.pairs(NORMAL + 10.0, support=([-1.0, -1.0], [1.0, 1.0])))
    (low, bottom), (high, top) = grid[1, 0].collections[0].get_paths()[0].get_extents().get_points()
    assert 6 < low < 9 < 11 < high < 14 and 6 < bottom < top < 14


def samples_with(value) -> np.ndarray:
    """The draws with one value changed."""
    changed = DRAWS.copy()
    changed[5, 1] = value
    return changed


WRONG = {
    "vector": ({"samples": DRAWS[:, 0]}, r"samples: expected shape \[n, D\] with 1 <= D <= 12, got \[400\]"),
    "transposed": ({"samples": DRAWS.T}, r"got \[3, 400\]: choose some of the columns"),
    "empty": ({"samples": np.zeros((30, 0))}, r"got \[30, 0\]$"),
    "words": ({"samples": "draws"}, "samples: expected an array of numbers, got str"),
    "few": ({"samples": DRAWS[:19]}, "samples: expected at least 20 draws, got 19"),
    "nan": ({"samples": samples_with(np.nan)}, "samples: expected finite numbers, got 1 of 400 rows"),
    "no sets": ({"samples": {}}, "samples: expected 1 to 8 labelled arrays, got 0"),
    "unlike": ({"samples": {"a": DRAWS, "b": DRAWS[:, :2]}}, r"got a \[400, 3\], b \[400, 2\]"),
    "one of several": ({"samples": {"a": DRAWS, "b": DRAWS[:2]}}, r"samples\['b'\]: expected at least 20 draws"),
    "names": ({"names": ("a", "b")}, r"names: expected 3 strings, one for each parameter, got \('a', 'b'\)"),
    "a name": ({"names": "abc"}, "names: expected 3 strings"),
    "units": ({"units": (1, 2, 3)}, r"units: expected 3 strings, one for each parameter, got \(1, 2, 3\)"),
    "truth": ({"truth": [1.0]}, r"truth: expected shape \[3\], one number for each parameter, got \[1\]"),
    "infinite truth": ({"truth": [1, np.inf, 0]}, "truth: expected finite numbers or NaN, got"),
    "support": ({"support": 3}, "support: expected an object with low and high, or .low, high., got 3"),
    "bounds": ({"support": ([0, 0], [1, 1])}, r"support low: expected shape \[3\]"),
    "unknown bound": ({"support": ([0, 0, np.nan], [1, 1, 1])}, "support low: expected finite numbers, got"),
    "reversed": ({"support": (BOX[1], BOX[0])}, "support: expected low < high, got"),
    "points": ({"points": TRUTH}, "points: expected estimates by label, got"),
    "a point": ({"points": {"a": np.zeros(3)}}, r"points\['a'\]: expected an estimate and its intervals, got"),
    "intervals": ({"points": {"a": (np.ones(3), np.ones(3))}}, r"points\['a'\]: expected intervals of shape \[3, 2\]"),
    "infinite": ({"points": {"a": (np.ones(3), np.full((3, 2), np.inf))}}, "finite or NaN, got"),
    "many points": (
        {"points": {str(i): (np.ones(3), np.ones((3, 2))) for i in range(8)}},
        "points: expected up to 8 labels in all, got 9",
    ),
    "log": ({"log": (True,)}, r"log: expected names of parameters or 3 booleans, got \(True,\)"),
    "log of none": ({"log": ("mass",)}, r"log: expected names of parameters or 3 booleans, got \('mass',\)"),
    "unknown log": ({"names": NAMES, "log": ("mass",)}, "log: expected some of stiffness, .*, got mass"),
    "negative": (
        {"samples": samples_with(-2.0), "log": (False, True, False)},
        "samples: expected positive values of theta_2",
    ),
    "negative truth": (
        {"truth": (-1, 0, 0), "log": (True, False, False)},
        "truth: expected positive values of theta_1",
    ),
    "negative box": (
        {"support": BOX, "log": (False, True, False)},
        "support: expected positive values of theta_2, .* got -1",
    ),
}


@pytest.mark.parametrize(("arguments", "message"), WRONG.values(), ids=WRONG)
def test_what_cannot_be_drawn_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        plot.pairs(**{"samples": DRAWS} | arguments)
    assert "\n" not in str(caught.value)


def test_matplotlib_is_imported_when_something_is_drawn():
    """Neither JAX nor pyplot is imported then."""
    script = (
        "import sys, jaxlfi; pairs = jaxlfi.plot.pairs; assert 'matplotlib' not in sys.modules\n"
        "import numpy as np; pairs(np.random.default_rng(0).normal(size=(50, 1)))\n"
        "assert 'matplotlib' in sys.modules and not {'jax', 'matplotlib.pyplot'} & sys.modules.keys()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
