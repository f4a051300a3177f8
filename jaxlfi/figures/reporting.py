"""Report: all pictures of a run folder, and a page with them."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import (
    curves,
    discrepancy,
    efficiency,
    losses,
    page,
    pairs,
    polars,
    predictive,
    samples,
    seeds,
    sensitivity,
    style,
    supports,
)
from jaxlfi.figures.collection import Collection, Runs, open_collection, representative
from jaxlfi.figures.history import History, read_config
from jaxlfi.figures.page import Picture
from jaxlfi.figures.style import COLUMN_WIDTH, TEXT_WIDTH

COLUMNS = ("ok", "misspecified", "broad", "misspecified+edge")
"""The configurations shown side by side where a picture has room for four."""


def report(folder: Path | str, dpi: float = 300.0) -> list[Path]:
    """Draw all pictures that apply to a run folder and write a page that shows them.

    Args:
        folder: of one run, of several seeds, of a comparison, or of a sensitivity grid.
        dpi: resolution of the pictures, which are as wide as a paper's column or text.

    Returns:
        The files written: FOLDER/report.html, then FOLDER/figures/*.png as they appear on it.

    Raises:
        ValueError: for a folder that is missing, of another kind or damaged; nothing is written then.
    """
    folder = Path(folder)
    if sensitivity.is_grid(folder):
        grid, config = sensitivity.load(folder), read_config(folder)
        return _written(folder, GRID_PICTURES, grid, lambda pictures: page.render_grid(config, pictures), dpi)
    collection = open_collection(folder)
    return _written(folder, PICTURES, collection, lambda pictures: page.render(collection, pictures), dpi)


def _written(folder: Path, makers: Mapping[str, Callable], loaded, render: Callable, dpi: float) -> list[Path]:
    """Draw what there is to draw of what was loaded, and write the page."""
    pictures: list[Picture] = []
    with style.context():
        for name, make in makers.items():
            made = make(loaded)
            if made is None:
                continue
            figure, title, caption = made
            path = style.save(figure, folder / "figures" / f"{name}.png", dpi)
            pictures.append(Picture(path, title, caption, float(figure.get_size_inches()[0])))
    text = render(pictures)
    index = folder / "report.html"
    index.write_text(text, encoding="utf-8")
    return [index, *(picture.path for picture in pictures)]


Made = tuple[Figure, str, str] | None
"""A figure with its title and caption, or None where there is nothing to draw."""


def columns(runs: Runs, most: int = 4) -> tuple[list[History], list[str]]:
    """One run for each of up to four configurations, the seed of median error, and the columns' titles."""
    preferred = [name for name in COLUMNS if name in runs]
    chosen = list(runs) if len(runs) <= most else [*preferred, *(n for n in runs if n not in preferred)][:most]
    histories = [representative(runs[name]) for name in chosen]
    look = style.looks(chosen)
    titles = []
    for name, history in zip(chosen, histories, strict=True):
        seed = f"\n(seed {history.seed})" if len(runs[name]) > 1 else ""
        titles.append(look[name].label + seed)
    return histories, titles


def _samples(collection: Collection) -> Made:
    histories, titles = columns(collection.runs)
    rows = len(samples.pairs(histories[0].dim))
    figure = style.new_figure(TEXT_WIDTH, 0.75 + (rows * 2.2 if len(histories) == 1 else 2 * rows * 1.72))
    samples.draw(figure, histories, titles)
    first, second = ("Left", "Right") if len(histories) == 1 else ("Above", "Below")
    caption = (
        f"{first}: the parameters drawn in each iteration with the support they were drawn from; the bigger "
        f"dots are the means of the data accumulated up to each iteration. {second}, closer: the last "
        "posterior, with the support it is kept in and arrows along the weighted means of the iterations."
        + _which_seed(collection.runs)
    )
    return figure, "Samples and posterior", caption


def _efficiency(collection: Collection) -> Made:
    figure = style.new_figure(TEXT_WIDTH, 2.1 + _legend_height(collection.runs))
    efficiency.draw(figure, collection.runs)
    caption = "Simulations attempted in each iteration, the share that succeeded, and the failures so far."
    return figure, "Data efficiency", caption


def _curves(collection: Collection) -> Made:
    if not curves.drawable(collection.runs):
        return None
    dim = next(iter(collection.runs.values()))[0].dim
    wide = dim > 4
    rows = -(-dim // (3 if wide else 2))
    known = any(h.theta_error is not None for histories in collection.runs.values() for h in histories)
    figure = style.new_figure(TEXT_WIDTH if wide and known else COLUMN_WIDTH, 2.3 + (1.2 * rows if known else 0.2))
    curves.draw(figure, collection.runs)
    caption = (
        "exp(-loss) of posterior samples in each iteration, 1 is perfect: Euclidean distance to the observed "
        "trajectory (per record, in its standard deviations; a failed simulation counts 0), and absolute "
        "difference from each true parameter where it is known. Bands are standard errors."
    )
    return figure, "Accuracy over iterations", caption


def _discrepancy(collection: Collection) -> Made:
    if not discrepancy.drawable(collection.runs):
        return None
    panels = discrepancy.panels(collection.runs)
    width = COLUMN_WIDTH if len(panels) <= 2 else TEXT_WIDTH
    figure = style.new_figure(width, 0.6 + 1.7 * -(-len(panels) // 5) + _legend_height(collection.runs))
    discrepancy.draw(figure, collection.runs)
    caption = (
        "Discrepancy of posterior samples after the last iteration from the true parameters and the observed "
        "trajectory. Error bars are standard deviations over samples and seeds; failed simulations are left "
        "out."
    )
    return figure, "Final discrepancy", caption


def _supports(collection: Collection) -> Made:
    dim = next(iter(collection.runs.values()))[0].dim
    width = COLUMN_WIDTH if dim == 1 else TEXT_WIDTH
    figure = style.new_figure(width, 0.6 + 1.6 * -(-dim // 4))
    supports.draw(figure, collection.runs)
    caption = "Bounds of the support from the first (iteration 0) to the last adaptation."
    return figure, "Supports", caption


def _losses(collection: Collection) -> Made:
    if not losses.drawable(collection.runs):
        return None
    figure = style.new_figure(TEXT_WIDTH, 2.3 + _legend_height(collection.runs))
    losses.draw(figure, collection.runs)
    caption = "Negative log-density of the parameters, scaled to [-1, 1], under the network."
    return figure, "Training", caption


def _predictive(collection: Collection) -> Made:
    runs = _those(collection.runs, predictive.drawable)
    if not runs:
        return None
    histories, titles = columns(runs)
    width = COLUMN_WIDTH if len(histories) == 1 else TEXT_WIDTH
    figure = style.new_figure(width, 0.8 + 1.35 * len(histories[0].channels))
    predictive.draw(figure, histories, titles)
    caption = "Simulations of samples of the last posterior, against the observed trajectory." + _which_seed(runs)
    return figure, "Posterior predictive", caption


def _pairs(collection: Collection) -> Made:
    runs = _those(collection.runs, pairs.drawable)
    if not runs:
        return None
    histories, titles = columns(runs)
    dim = histories[0].dim
    rows, across = pairs.arrangement(len(histories), dim)
    width = TEXT_WIDTH if across * dim > 4 else COLUMN_WIDTH
    figure = style.new_figure(width, 1.0 + rows * (0.3 + width * dim / (across * dim + 0.6)))
    pairs.draw(figure, histories, titles)
    caption = (
        "Draws of the last posterior, kept in its support: each parameter on the diagonal, each pair of parameters "
        "below it, with contours that enclose half, four fifths and 95 % of the draws." + _which_seed(runs)
    )
    return figure, "Posterior by pairs of parameters", caption


def _polars(collection: Collection) -> Made:
    histories, titles = columns(collection.runs)
    rows = polars.panels(histories)
    if not rows:
        return None
    width = TEXT_WIDTH if len(histories) > 1 else COLUMN_WIDTH
    figure = style.new_figure(width, 0.9 + min(1.9, 0.88 * width / len(histories)) * len(rows))
    polars.draw(figure, histories, titles)
    unit = style.configuration_label(polars.reference(histories).configuration)
    units = {
        "parameters": f"of the parameters from the true ones, in widths of the first support of {unit}",
        "summaries": "of their simulations' summaries from the observed ones, in standard deviations of the first "
        f"iteration's simulations of {unit} (half the distance of their 16th and 84th percentiles)",
    }
    caption = (
        "Absolute discrepancy of posterior samples after the last iteration: "
        + "; ".join(units[name] for name in rows)
        + ". A flow's samples are those of the mixture that is fitted to it."
        + _which_seed(collection.runs)
    )
    return figure, "Discrepancy by parameter and summary", caption


def _seeds(collection: Collection) -> Made:
    values = collection.values("theta_error")
    label = "parameter error (sum of |θ − θ$_{gt}$|)"
    if not _positive(values):
        values, label = collection.values("trajectory_error"), "trajectory error [observed sd]"
    if not _positive(values) or max(len(v) for v in values.values()) < 2:
        return None
    figure = style.new_figure(COLUMN_WIDTH if len(values) <= 3 else TEXT_WIDTH, 2.6)
    seeds.draw(figure, values, label)
    caption = "Error after the last iteration, a point for each seed, on a logarithmic scale."
    return figure, "Seeds", caption


PICTURES: dict[str, Callable[[Collection], Made]] = {
    "samples": _samples,
    "efficiency": _efficiency,
    "curves": _curves,
    "discrepancy": _discrepancy,
    "support": _supports,
    "losses": _losses,
    "predictive": _predictive,
    "pairs": _pairs,
    "polars": _polars,
    "seeds": _seeds,
}
"""What makes each picture, by the name of its file."""


_OVER = "Means over seeds and the other hyperparameters, ± their standard deviations."


def _sensitivity(grid: sensitivity.Grid) -> Made:
    figure = style.new_figure(*sensitivity.size(grid, bars=2))
    sensitivity.draw(figure, grid)
    caption = (
        "Discrepancy after the last iteration for every pair of hyperparameters: of simulated trajectories above "
        f"the diagonal, of parameters below it; on the diagonal, for each hyperparameter alone. {_OVER} "
        "The colours are reversed, as smaller is better. The heuristic's own values are bold."
    )
    return figure, "Sensitivity to hyperparameters", caption


def _feasibility(grid: sensitivity.Grid) -> Made:
    figure = style.new_figure(*sensitivity.size(grid, bars=1))
    sensitivity.draw_success(figure, grid)
    caption = (
        "Share of all attempted simulations that succeeded, for every pair of hyperparameters; on the diagonal, for "
        f"each alone. {_OVER}"
    )
    return figure, "Simulation success", caption


GRID_PICTURES: dict[str, Callable[[sensitivity.Grid], Made]] = {
    "sensitivity": _sensitivity,
    "feasibility": _feasibility,
}
"""The pictures of a sensitivity grid, by the name of the file."""


def _those(runs: Runs, drawable: Callable[[History], bool]) -> Runs:
    """The runs of which there is something to draw."""
    chosen = {name: [h for h in histories if drawable(h)] for name, histories in runs.items()}
    return {name: histories for name, histories in chosen.items() if histories}


def _which_seed(runs: Runs) -> str:
    return " Of several seeds, that of median parameter error is shown." if _several(runs.values()) else ""


def _several(groups: Sequence) -> bool:
    return any(len(histories) > 1 for histories in groups)


def _legend_height(runs: Runs) -> float:
    return 0.15 * (1 + (len(runs) > 4))


def _positive(values: dict[str, np.ndarray]) -> bool:
    return any(np.any(np.isfinite(v) & (v > 0)) for v in values.values())
