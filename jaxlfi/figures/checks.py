"""Checks: the observation among simulations from the posterior, and all pictures of a folder of diagnostics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import calibration, style
from jaxlfi.figures.calibration import BAND, COLOUR, COVERAGE, DISTANCE, Arrays
from jaxlfi.figures.history import read_arrays, robust_sd
from jaxlfi.figures.predictive import QUANTILES
from jaxlfi.figures.style import COLUMN_WIDTH, TEXT_WIDTH

REACH = 8.0
"""Standard deviations beyond which a summary is drawn at the edge of the panel."""


def report(folder: Path | str, dpi: float = 300.0) -> list[Path]:
    """Draw all pictures that diagnostics.npz has the arrays of.

    Args:
        folder: of the diagnostics.
        dpi: resolution.

    Returns:
        FOLDER/figures/*.png.

    Raises:
        ValueError: for a folder whose diagnostics.npz is missing or damaged.
    """
    folder = Path(folder)
    arrays = read_arrays(folder / "diagnostics.npz", ("names", "units"))
    paths = []
    with style.context():
        for name, (needed, size, draw) in PICTURES.items():
            if needed in arrays:
                figure = style.new_figure(*size(arrays))
                draw(figure, arrays)
                paths.append(style.save(figure, folder / "figures" / f"{name}.png", dpi))
    return paths


def standardised(arrays: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Simulated summaries [n, S] and observed ones [S], minus the simulated median, in robust standard deviations.

    A summary that does not vary is divided by the smallest positive float, so that any deviation is drawn.
    """
    simulated = arrays["predictive_x"][np.isfinite(arrays["predictive_x"]).all(axis=1)]
    middle = np.median(simulated, axis=0)
    scale = np.maximum(robust_sd(simulated), np.finfo(np.float32).tiny)
    return (simulated - middle) / scale, (arrays["observed_x"] - middle) / scale


def draw(figure: Figure, arrays: Arrays) -> None:
    """Left: each observed summary among the simulated ones. Right: their joint distance from the simulations' centre.

    Args:
        figure: empty.
        arrays: of diagnostics.npz.
    """
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
    right.hist(arrays["predictive_distances"], bins=20, color=BAND, alpha=0.6, gid="simulated")
    right.axvline(float(arrays["observed_distance"]), color=COLOUR, gid="observed")
    right.set(xlabel="Mahalanobis distance (line: observed)", ylabel="number of simulations")
    right.set_title(f"all summaries (p = {float(arrays['predictive_p_value']):.2g})")


def _ranks_size(arrays: Arrays) -> tuple[float, float]:
    wide = len(arrays["names"]) > 2
    return TEXT_WIDTH if wide else COLUMN_WIDTH, (0.6 if wide else 0.9) + 2.2 * calibration.rows(arrays)


def _square(arrays: Arrays) -> tuple[float, float]:
    return COLUMN_WIDTH, 3.9


def _predictive_size(arrays: Arrays) -> tuple[float, float]:
    return TEXT_WIDTH, 2.3


PICTURES: dict[str, tuple[str, Callable[[Arrays], tuple[float, float]], Callable[[Figure, Arrays], None]]] = {
    "ranks": ("bin_count", _ranks_size, calibration.draw_ranks),
    "coverage": (COVERAGE, _square, calibration.draw_coverage),
    "tarp": (DISTANCE, _square, calibration.draw_tarp),
    "predictive": ("predictive_x", _predictive_size, draw),
}
"""By file name: an array the picture needs, its size in inches, and the function that draws it."""
