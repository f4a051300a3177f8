"""Diagnostics: all their pictures, among them the posterior predictive check, and a page that shows them."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import calibration, intervals, page, style
from jaxlfi.figures.calibration import BAND, COLOUR, COVERAGE, DISTANCE, Arrays
from jaxlfi.figures.extent import extent
from jaxlfi.figures.history import read_arrays, robust_sd
from jaxlfi.figures.predictive import QUANTILES
from jaxlfi.figures.style import COLUMN_WIDTH, TEXT_WIDTH
from jaxlfi.io import files

CURVE = ("level", "pointwise", "simultaneous")
"""Arrays of a curve's levels and bands."""
REACH = 8.0
"""Number of standard deviations beyond which a summary is drawn at the edge of the panel."""


def report(folder: Path | str, dpi: float = 300.0) -> list[Path]:
    """Draw all pictures for which diagnostics.npz has the arrays, and write a page with them and the verdicts.

    Args:
        folder: folder of the diagnostics.
        dpi: resolution of the pictures.

    Returns:
        FOLDER/report.html, then FOLDER/figures/*.png in the order of the page.

    Raises:
        ValueError: if diagnostics.npz or diagnostics.json is missing or damaged.
    """
    folder = Path(folder)
    path = folder / "diagnostics.npz"
    arrays = read_arrays(path, ("names", "units"), [name for needed, *_ in PICTURES.values() for name in needed])
    found = _read(folder / "diagnostics.json")
    drawable = {name: maker for name, maker in PICTURES.items() if maker[0][0] in arrays}
    for needed, *_ in drawable.values():
        if missing := [name for name in needed if name not in arrays]:
            raise ValueError(f"{path}: expected {', '.join(needed)}; missing {', '.join(missing)}")

    def drawings() -> Iterator[page.Drawing]:
        for name, (_, size, draw, title, caption) in drawable.items():
            figure = style.new_figure(*size(arrays))
            draw(figure, arrays)
            yield name, figure, title, caption

    return page.write(folder, drawings(), lambda pictures: page.render_diagnostics(found, pictures), dpi)


def _read(path: Path) -> Mapping[str, Any]:
    try:
        found = files.read_json(path)
        if "widths" not in found or "checks" not in found:
            raise ValueError("no verdicts")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: expected the results of diagnostics, but they cannot be read ({error})") from error
    return found


def standardised(arrays: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Simulated summaries [n, S] and observed ones [S], minus the simulated median, in robust standard deviations.

    A summary that does not vary is divided by the smallest positive float, so that any deviation is drawn.
    """
    simulated = arrays["predictive_x"][np.isfinite(arrays["predictive_x"]).all(axis=1)]
    middle = np.median(simulated, axis=0)
    scale = np.maximum(robust_sd(simulated), np.finfo(np.float32).tiny)
    return (simulated - middle) / scale, (arrays["observed_x"] - middle) / scale


def draw(figure: Figure, arrays: Arrays) -> None:
    """Draw each observed summary among simulated ones (left), and their joint distance from the centre (right)."""
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [2.2, 1.0]})
    simulated, observed = standardised(arrays)
    place = np.arange(1, len(observed) + 1)
    bands = np.clip(np.quantile(simulated, QUANTILES, axis=0), -REACH, REACH)
    for (low, high), opacity in zip(((0, 4), (1, 3)), (0.25, 0.5), strict=True):
        left.bar(place, bands[high] - bands[low], bottom=bands[low], width=0.7, color=BAND, alpha=opacity, linewidth=0)
    left.plot(place, np.clip(observed, -REACH, REACH), "o", color=COLOUR, gid="observed")
    left.set(xlabel="summary", ylabel="standard deviations from the median", xlim=(0.3, len(place) + 0.7))
    left.use_sticky_edges = False  # bars would end at the frame
    left.margins(y=0.05)
    left.autoscale_view(scalex=False)
    left.xaxis.get_major_locator().set_params(integer=True)
    left.set_title("each summary: observed (dots), 50 % and 90 % of simulations (bars)")
    left.grid(True, axis="y")
    distances = arrays["predictive_distances"]
    right.hist(distances, bins=20, range=extent(distances), color=BAND, alpha=0.6, gid="simulated")
    right.axvline(float(arrays["observed_distance"]), color=COLOUR, gid="observed")
    right.set(xlabel="Mahalanobis distance (line: observed)", ylabel="number of simulations")
    right.set_title(f"all summaries (p = {float(arrays['predictive_p_value']):.2g})")


def _ranks_size(arrays: Arrays) -> tuple[float, float]:
    wide = len(arrays["names"]) > 2
    return TEXT_WIDTH if wide else COLUMN_WIDTH, (0.6 if wide else 0.9) + 2.2 * calibration.rows(arrays)


COLUMN = lambda arrays: (COLUMN_WIDTH, 3.9)
"""Size of a square picture with its legend, regardless of its content."""

Maker = tuple[tuple[str, ...], Callable[[Arrays], tuple[float, float]], Callable[[Figure, Arrays], None], str, str]

PICTURES: dict[str, Maker] = {
    "widths": (
        ("widths_held", "widths_regions_held", "widths_level", "widths_factor"),
        lambda arrays: (TEXT_WIDTH, intervals.height(arrays)), intervals.draw, "Intervals",
        "Left: the fraction of truths that intervals of each parameter, and densest regions of all parameters together "
        "(last row), covered; it should be 50 % and 90 % (lines). Right: the factor by which the width of 90 % "
        "intervals would have to be multiplied to cover 90 %. Bars are confidence intervals, of 95 % for all "
        "parameters together.",
    ),
    "ranks": (
        ("bin_count", "bin_edges", "bin_band", "level", "ranks_fraction", "ranks_simultaneous"),
        _ranks_size, calibration.draw_ranks, "Ranks (simulation-based calibration)",
        "The rank of each truth among draws of its posterior, for truths over the support. U-shaped: too narrow; a "
        "hill: too wide; a slope: biased.",
    ),
    "coverage": (
        (COVERAGE, *CURVE), COLUMN, calibration.draw_coverage, "Coverage of densest regions",
        "For truths over the support. Below the diagonal: over-confident.",
    ),
    "tarp": (
        (DISTANCE, *CURVE), COLUMN, calibration.draw_tarp, "Coverage from random points (TARP)",
        "The same with regions around random points, which sees what densities do not.",
    ),
    "predictive": (
        ("predictive_x", "observed_x", "predictive_distances", "observed_distance", "predictive_p_value"),
        lambda arrays: (TEXT_WIDTH, 2.3), draw, "Posterior predictive",
        "The run's own observation among simulations of its own posterior.",
    ),
}  # fmt: skip
"""By file name: the numeric arrays that a picture needs (it is drawn if the first of them exists), its size in inches,
the function that draws it, its title and caption."""
