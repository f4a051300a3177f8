"""The heat maps of a sensitivity grid: which number is in which cell, and what is marked."""

import itertools
import json

import numpy as np
import pytest

from jaxlfi import figures
from jaxlfi.figures import sensitivity, style

NAMES = ("zone_fraction", "mass_threshold", "expansion")
VALUES = ((0.05, 0.1), (0.001, 0.005, 0.05), (0.1, 0.2, 0.3, 0.4))
DEFAULTS = (0.1, 0.005, 0.2)
SHAPE = (2, 3, 4, 5)


def grid_of_noise(**arrays) -> sensitivity.Grid:
    """Every axis of another length, so that a swapped one shows; a few runs without a trajectory error."""
    rng = np.random.default_rng(0)
    made = {name: rng.gamma(2.0, 1.0, SHAPE) for name in ("theta_error", "trajectory_error", "success_rate")}
    made["trajectory_error"][0, 1, :2, 3] = np.nan
    return sensitivity.Grid(NAMES, VALUES, DEFAULTS, made | arrays)


def drawn(grid: sensitivity.Grid, draw, bars: int, laid_out: bool = False):
    """The panels by row and column."""
    with style.context():
        figure = style.new_figure(*sensitivity.size(grid, bars))
        draw(figure, grid)
        if laid_out:
            figure.draw_without_rendering()
    count = len(grid.names)
    return np.array(figure.axes[: count**2]).reshape(count, count)


def by_hand(array: np.ndarray, **fixed: int) -> np.ndarray:
    """The known values of the runs with the given indices, by looping over all of them."""
    found = [
        array[index]
        for index in itertools.product(*map(range, array.shape))
        if all(index[NAMES.index(name)] == value for name, value in fixed.items())
    ]
    return np.array([value for value in found if not np.isnan(value)])


def test_cells_are_means_over_seeds_and_the_other_hyperparameters():
    grid = grid_of_noise()
    panels = drawn(grid, sensitivity.draw, bars=2)
    for row, column in itertools.permutations(range(3), 2):
        (image,) = panels[row, column].images
        name = "trajectory_error" if row < column else "theta_error"
        assert image.get_gid() == name
        texts = [text.get_text() for text in panels[row, column].texts]
        cells = list(itertools.product(range(SHAPE[row]), range(SHAPE[column])))
        assert len(texts) == len(cells)
        for (i, j), text in zip(cells, texts, strict=True):
            own = by_hand(grid.arrays[name], **{NAMES[row]: i, NAMES[column]: j})
            assert image.get_array()[i, j] == pytest.approx(own.mean())
            mean, sd = text.split("\n±")
            assert float(mean) == pytest.approx(own.mean(), abs=0.051)
            assert float(sd) == pytest.approx(own.std(ddof=1), abs=0.051)


def test_the_diagonal_shows_each_hyperparameter_alone():
    grid = grid_of_noise()
    panels = drawn(grid, sensitivity.draw, bars=2)
    for place in range(3):
        upper, lower = panels[place, place].images
        for image, name in ((upper, "trajectory_error"), (lower, "theta_error")):
            expected = [by_hand(grid.arrays[name], **{NAMES[place]: i}).mean() for i in range(SHAPE[place])]
            np.testing.assert_allclose(image.get_array()[0], expected)
        # The axis runs downwards: the trajectory's band ends where the parameters' begins.
        assert upper.get_extent()[2] == lower.get_extent()[3]
        assert panels[place, place].get_ylim()[0] == lower.get_extent()[2]


def test_success_is_drawn_once_in_percent():
    grid = grid_of_noise()
    panels = drawn(grid, sensitivity.draw_success, bars=1)
    assert all(not panels[row, column].images for row, column in itertools.combinations(range(3), 2))
    (image,) = panels[2, 0].images
    own = by_hand(grid.arrays["success_rate"], expansion=3, zone_fraction=1)
    assert image.get_array()[3, 1] == pytest.approx(100 * own.mean())


def test_brighter_is_better_also_where_all_are_equal():
    def brightness(image, value):
        return np.dot(image.cmap(image.norm(value))[:3], [0.299, 0.587, 0.114])

    noise = grid_of_noise()
    equal = grid_of_noise(**{name: np.ones(SHAPE) for name in noise.arrays})
    for draw, bars, better in ((sensitivity.draw, 2, np.min), (sensitivity.draw_success, 1, np.max)):
        for place in ((0, 2), (2, 0)) if bars == 2 else ((2, 0),):
            (image,) = drawn(noise, draw, bars)[place].images
            shown = image.get_array()
            best, worst = better(shown), -better(-shown)
            assert brightness(image, best) > brightness(image, worst) + 0.1
            (image,) = drawn(equal, draw, bars)[place].images
            ends = [brightness(image, value) for value in (image.norm.vmin, image.norm.vmax)]
            assert brightness(image, image.get_array()[0, 0]) == max(ends)


def test_own_values_are_bold_along_the_axes_and_in_the_cells():
    panels = drawn(grid_of_noise(), sensitivity.draw, bars=2)

    def bold(texts):
        return [text.get_text() for text in texts if text.get_weight() == "bold"]

    for place, default in enumerate(DEFAULTS):
        assert bold(panels[2, place].get_xticklabels()) == [f"{default:g}"]
        assert len(panels[2, place].get_xticklabels()) == len(VALUES[place])
    for place in (1, 2):  # the lower triangle's rows, at the left; the upper triangle's columns, at the top
        assert bold(panels[place, 0].get_yticklabels()) == [f"{DEFAULTS[place]:g}"]
        assert bold(panels[0, place].get_xticklabels()) == [f"{DEFAULTS[place]:g}"]
    texts = panels[1, 2].texts  # rows mass_threshold, columns expansion: own values at (1, 1)
    assert [text.get_weight() == "bold" for text in texts] == [i == 1 * SHAPE[2] + 1 for i in range(12)]


def test_unknown_errors_are_left_blank():
    grid = grid_of_noise(theta_error=np.full(SHAPE, np.nan))
    panels = drawn(grid, sensitivity.draw, bars=2)
    assert {text.get_text() for text in panels[2, 0].texts} == {"–"}
    assert "–" not in {text.get_text() for text in panels[0, 2].texts}


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 2, 5])
def test_any_number_of_hyperparameters_fits(axes):
    names = ("zone_fraction", "mass_threshold", "expansion", "tail", "zone_width")[:axes]
    shape = (3,) * axes + (2,)
    arrays = {
        name: np.random.default_rng(1).random(shape) for name in ("theta_error", "trajectory_error", "success_rate")
    }
    grid = sensitivity.Grid(names, ((0.1, 0.2, 0.3),) * axes, (0.2,) * axes, arrays)
    width, _ = sensitivity.size(grid, 2)
    assert width == (style.COLUMN_WIDTH if axes < 5 and 3 * axes <= 10 else style.TEXT_WIDTH)
    for text in (text for panel in drawn(grid, sensitivity.draw, 2, laid_out=True).ravel() for text in panel.texts):
        box, panel = text.get_window_extent(), text.axes.get_window_extent()
        assert box.width <= panel.width / 3 + 1, "a number is wider than its cell"


@pytest.fixture
def folder(tmp_path):
    """A grid's folder as `jaxlfi.studies.grid` leaves it."""
    grid = grid_of_noise()
    config = {
        "format": "jaxlfi-grid",
        "task": "gaussian_linear",
        "heuristic": {"name": "x:Wrapper", "hyperparameters": {"rule": {"name": "edge", "hyperparameters": {}}}},
        "support": {"name": "ok"},
        "settings": {"rounds": 2},
        "seeds": [0, 1, 2, 3, 4],
        "runs": 120,
        "axes": [{"name": n, "values": list(v), "default": d} for n, v, d in zip(NAMES, VALUES, DEFAULTS, strict=True)],
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    values = {f"values/{name}": np.array(v) for name, v in zip(NAMES, VALUES, strict=True)}
    np.savez(tmp_path / "grid.npz", axes=np.array(NAMES), **values, **grid.arrays)
    return tmp_path


def test_report_draws_a_grid(folder):
    paths = figures.report(folder, dpi=30)
    assert [path.relative_to(folder).as_posix() for path in paths] == [
        "report.html",
        "figures/sensitivity.png",
        "figures/feasibility.png",
    ]
    page = paths[0].read_text()
    assert "sensitivity of edge in 120 runs" in page and "mass_threshold: 0.001, 0.005, 0.05" in page
    assert page.count("data:image/png;base64,") == 2


def test_a_grid_whose_posteriors_were_not_simulated_has_parameter_errors_only(folder):
    with np.load(folder / "grid.npz") as stored:
        arrays = dict(stored)
    arrays["trajectory_error"].fill(np.nan)
    np.savez(folder / "grid.npz", **arrays)
    grid = sensitivity.load(folder)
    panels = drawn(grid, sensitivity.draw, bars=1)
    assert not any(panels[row, column].images for row, column in itertools.combinations(range(3), 2))
    assert [image.get_gid() for image in panels[1, 1].images] == ["theta_error"]
    assert "no trajectories were simulated" in figures.report(folder, dpi=30)[0].read_text()


def test_report_refuses_a_grid_that_is_not_finished_or_damaged(folder):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"axes": config["axes"][:2]}))
    with pytest.raises(ValueError, match="of one grid"):
        figures.report(folder)
    (folder / "grid.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"grid\.npz"):
        figures.report(folder)
    (folder / "grid.npz").unlink()
    with pytest.raises(ValueError, match="expected a finished grid"):
        figures.report(folder)
    assert not (folder / "report.html").exists()
