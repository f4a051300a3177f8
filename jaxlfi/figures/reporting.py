"""Report: all pictures of a run folder, and a page with them."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import (
    channels,
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
from jaxlfi.figures.collection import Collection, Runs, all_of, first_of, open_collection, representative, seed_count
from jaxlfi.figures.history import History, read_config
from jaxlfi.figures.style import COLUMN_WIDTH, TEXT_WIDTH

COLUMNS = ("ok", "misspecified", "broad", "misspecified+edge")
"""Configurations preferred side by side if there are more than `MAX_COLUMNS`."""
MAX_COLUMNS = 4
"""Largest number of configurations side by side in one picture."""


def report(folder: Path | str, dpi: float = 300.0) -> list[Path]:
    """Draw all pictures that apply to a run folder and write a page that shows them.

    Args:
        folder: folder of one run, of several seeds, of a comparison, or of a sensitivity grid.
        dpi: resolution of the pictures, which are one or two columns of a paper wide.

    Returns:
        The files written: FOLDER/report.html, then FOLDER/figures/*.png in the order of the page.

    Raises:
        ValueError: for a folder that is missing, damaged or of another kind; nothing is written then.
    """
    folder = Path(folder)
    if sensitivity.is_grid(folder):
        grid, config = sensitivity.load(folder), read_config(folder)
        return page.write(folder, _drawings(GRID_PICTURES, grid), lambda drawn: page.render_grid(config, drawn), dpi)
    collection = open_collection(folder)
    return page.write(folder, _drawings(PICTURES, collection), lambda drawn: page.render(collection, drawn), dpi)


def _drawings(makers: Mapping[str, Callable], loaded) -> Iterator[page.Drawing]:
    """The pictures that apply to a collection or grid."""
    return ((name, *made) for name, make in makers.items() if (made := make(loaded)) is not None)


Made = tuple[Figure, str, str] | None
"""A figure with its title and caption, or None if there is nothing to draw."""


def columns(runs: Runs) -> tuple[list[History], list[str]]:
    """One run, the seed of median error, for each of up to four configurations, and the columns' titles."""
    preferred = [name for name in COLUMNS if name in runs]
    every = list(runs) if len(runs) <= MAX_COLUMNS else [*preferred, *(n for n in runs if n not in preferred)]
    chosen = every[:MAX_COLUMNS]
    histories = [representative(runs[name]) for name in chosen]
    look = style.looks(chosen)
    titles = []
    for name, history in zip(chosen, histories, strict=True):
        seed = f"\n(seed {history.seed})" if len(runs[name]) > 1 else ""
        titles.append(look[name].label + seed)
    return histories, titles


def _samples(collection: Collection) -> Made:
    histories, titles = columns(collection.runs)
    failed = any((history.failed > 0).any() for history in histories)
    rows = len(samples.pairs(histories[0].dim))
    figure = style.new_figure(TEXT_WIDTH, 0.75 + (rows * 2.2 if len(histories) == 1 else 2 * rows * 1.72))
    samples.draw(figure, histories, titles)
    first, second = ("Left", "Right") if len(histories) == 1 else ("Above", "Below")
    caption = (
        f"{first}: the parameters simulated in each iteration and the supports they were drawn from (boxes), coloured "
        f"by iteration; {'crosses are failed simulations, ' * failed}large dots the means of all simulations up to "
        "each iteration. "
        f"{second}, enlarged: the density of the last posterior's mixture and its support (box); arrows join the "
        "weighted means of the posteriors of successive iterations." + _which_seed(collection.runs)
    )
    return figure, "Samples and posterior", caption


def _efficiency(collection: Collection) -> Made:
    every = all_of(collection.runs)
    if not any(history.failed.any() for history in every) or (len(every) == 1 and every[0].rounds == 1):
        return None  # a constant line or a single point adds nothing to the summary
    figure = style.new_figure(TEXT_WIDTH, 2.1 + _legend_height(collection.runs))
    efficiency.draw(figure, collection.runs)
    caption = (
        "Percentage of the simulations of each iteration that succeeded, and the numbers of all simulations and of "
        "failed ones in the end." + _bands(collection.runs) + " Dots are seeds." * (seed_count(collection.runs) > 1)
    )
    return figure, "Data efficiency", caption


def _curves(collection: Collection) -> Made:
    if not curves.drawable(collection.runs) or first_of(collection.runs).rounds == 1:
        return None
    known, simulated = _measured(collection.runs)
    rows, across = style.grid_shape(simulated + known * first_of(collection.runs).dim, curves.COLUMNS)
    width = TEXT_WIDTH if across > 2 else COLUMN_WIDTH
    figure = style.new_figure(width, 0.7 + 1.6 * rows + _legend_height(collection.runs))
    curves.draw(figure, collection.runs)
    caption = (
        "Accuracy exp(-error) of posterior samples after each iteration; 1 is perfect."
        + simulated
        * " Trajectory: the error is the Euclidean distance to the observed trajectory, per record and in "
        "standard deviations of the observed one (of its noise where that is larger); a failed simulation has accuracy "
        "0."
        + known * " Parameters: the error is the absolute difference from the true value."
        + (_bands(collection.runs) or " Lines are medians of the posterior samples, bands their quartiles.")
    )
    return figure, "Accuracy over iterations", caption


def _discrepancy(collection: Collection) -> Made:
    if not discrepancy.drawable(collection.runs) or sum(map(len, collection.runs.values())) == 1:
        return None
    panels = discrepancy.panels(collection.runs)
    width = COLUMN_WIDTH if len(panels) <= 2 else TEXT_WIDTH
    figure = style.new_figure(width, 0.6 + 1.7 * -(-len(panels) // 5) + _legend_height(collection.runs))
    discrepancy.draw(figure, collection.runs)
    known, simulated = _measured(collection.runs)
    references = known * ["the true parameters"] + simulated * ["the observed trajectory"]
    caption = (
        f"Mean discrepancy of each seed's posterior samples after the last iteration from {' and '.join(references)}: "
        "one dot for each seed, a line at their median" + simulated * "; failed simulations are left out" + "."
        " Of a parameter whose logarithm is inferred it is the factor between sample and truth."
    )
    return figure, "Final discrepancy", caption


def _supports(collection: Collection) -> Made:
    if len(collection.runs) == 1 and not any(history.adapts for history in next(iter(collection.runs.values()))):
        return None
    width = COLUMN_WIDTH if first_of(collection.runs).dim == 1 else TEXT_WIDTH
    figure = style.new_figure(width, 0.6 + 1.6 * -(-first_of(collection.runs).dim // 4))
    supports.draw(figure, collection.runs)
    left_out = len(supports.adapting(collection.runs)) < len(collection.runs)
    caption = (
        "Lower and upper bounds of the support of each parameter, from the initial support (iteration 0) to the last "
        "adaptation." + left_out * " Configurations of a fixed support are left out."
    )
    return figure, "Supports", caption


def _losses(collection: Collection) -> Made:
    if not losses.drawable(collection.runs):
        return None
    figure = style.new_figure(TEXT_WIDTH, 2.3 + _legend_height(collection.runs))
    losses.draw(figure, collection.runs)
    one = sum(len(histories) for histories in collection.runs.values()) == 1
    caption = (
        "Negative log-density of the parameters, scaled to [-1, 1], under the network, mean over the ensemble's "
        "networks: " + ("after each epoch of training." if one else "after the training of each iteration.")
    ) + _bands(collection.runs)
    return figure, "Training", caption


def _predictive(collection: Collection) -> Made:
    runs = _those(collection.runs, predictive.drawable)
    if not runs:
        return None
    histories, titles = columns(runs)
    rows, across = predictive.grid(histories)
    figure = style.new_figure(COLUMN_WIDTH if across == 1 else TEXT_WIDTH, 0.8 + 1.35 * rows)
    predictive.draw(figure, histories, titles)
    caption = (
        "Trajectories simulated with samples of the last posterior, and the observed trajectory. The bands hold the "
        "central 50 % and 90 % of the simulations of each record." + _which_seed(runs)
    )
    drawn, every = len(predictive.shown(histories)), len(histories[0].channels)
    if drawn < every:
        caption += f" Of {every} channels, the {drawn} that vary most are shown."
    return figure, "Posterior predictive", caption


def _channels(collection: Collection) -> Made:
    runs = _those(collection.runs, channels.drawable)
    if not runs:
        return None
    rows = len(channels.shown(runs))
    width = TEXT_WIDTH if rows > 6 or len(runs) > 2 else COLUMN_WIDTH
    figure = style.new_figure(width, 0.8 + min(0.12 + 0.06 * len(runs), 8.0 / rows) * rows + _legend_height(runs))
    channels.draw(figure, runs)
    dot = "seed" if seed_count(runs) > 1 else "simulation"
    caption = (
        "Root mean square difference between the observation and simulations of the last posterior in each channel, in "
        f"its observed standard deviation, or its measurement noise where that is larger: one dot for each {dot}, a "
        "stroke at the median. The trajectory error is the root mean square over channels."
    )
    return figure, "Trajectory error by channel", caption


def _pairs(collection: Collection) -> Made:
    runs = _those(collection.runs, pairs.drawable)
    if not runs:
        return None
    histories, titles = columns(runs)
    dim = histories[0].dim
    rows, across = pairs.arrangement(len(histories), dim)
    width = TEXT_WIDTH if across * dim > 4 or len(histories) == 1 < dim else COLUMN_WIDTH
    figure = style.new_figure(width, 1.0 + rows * (0.3 + width * dim / (across * dim + 0.6)))
    pairs.draw(figure, histories, titles)
    caption = (
        "Draws of the last posterior, restricted to its support: the marginal of each parameter on the diagonal, each "
        "pair of parameters below it, with contours that enclose 50 %, 80 % and 95 % of the draws." + _which_seed(runs)
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
        "parameters": f"of parameters from the true ones, in widths of the first support of {unit}",
        "summaries": "of the summaries of their simulations from the observed ones, in standard deviations of the "
        f"first iteration's simulations of {unit} (half the distance between the 16th and 84th percentiles)",
    }
    caption = (
        "Absolute discrepancy of posterior samples after the last iteration: "
        + "; ".join(units[name] for name in rows)
        + ". Where the posterior is a flow, the samples are drawn from a mixture fitted to it."
        + _which_seed(collection.runs)
    )
    return figure, "Discrepancy by parameter and summary", caption


def _seeds(collection: Collection) -> Made:
    values, what = collection.values("theta_error"), "Parameter"
    label = "parameter error (sum of |θ − θ$_{gt}$|)"
    if not _positive(values):
        values, what = collection.values("trajectory_error"), "Trajectory"
        label = "trajectory error [observed sd]"
    if not _positive(values) or max(len(v) for v in values.values()) < 2:
        return None
    figure = style.new_figure(COLUMN_WIDTH if len(values) <= 3 else TEXT_WIDTH, 2.6)
    seeds.draw(figure, values, label)
    caption = f"{what} error after the last iteration, one point for each seed, on a logarithmic scale."
    return figure, "Seeds", caption


PICTURES: dict[str, Callable[[Collection], Made]] = {
    "pairs": _pairs,
    "samples": _samples,
    "efficiency": _efficiency,
    "curves": _curves,
    "discrepancy": _discrepancy,
    "support": _supports,
    "losses": _losses,
    "predictive": _predictive,
    "channels": _channels,
    "polars": _polars,
    "seeds": _seeds,
}
"""The function that draws each picture, by file name."""


_OVER = "Cells are means ± standard deviations over seeds and all other hyperparameters."


def _sensitivity(grid: sensitivity.Grid) -> Made:
    measures = sensitivity.errors(grid)
    figure = style.new_figure(*sensitivity.size(grid, len(measures)))
    sensitivity.draw(figure, grid)
    places = (
        "of simulated trajectories above the diagonal, of parameters below it"
        if len(measures) > 1
        else "of parameters; no trajectories were simulated from the posteriors"
    )
    caption = (
        f"Discrepancy after the last iteration for every pair of hyperparameters: {places}. On the diagonal: for each "
        f"hyperparameter alone. {_OVER} Brighter colours are smaller errors. The heuristic's default values are bold."
    )
    return figure, "Sensitivity to hyperparameters", caption


def _feasibility(grid: sensitivity.Grid) -> Made:
    figure = style.new_figure(*sensitivity.size(grid, bars=1))
    sensitivity.draw_success(figure, grid)
    caption = (
        "Percentage of all simulations that succeeded, for every pair of hyperparameters; on the diagonal, for each "
        f"hyperparameter alone. {_OVER} The heuristic's default values are bold."
    )
    return figure, "Simulation success", caption


GRID_PICTURES: dict[str, Callable[[sensitivity.Grid], Made]] = {
    "sensitivity": _sensitivity,
    "feasibility": _feasibility,
}
"""The function that draws each picture of a sensitivity grid, by file name."""


def _measured(runs: Runs) -> tuple[bool, bool]:
    """Whether any run has parameter errors, and whether any has trajectory errors."""
    every = all_of(runs)
    return any(h.theta_error is not None for h in every), any(h.trajectory_error is not None for h in every)


def _those(runs: Runs, drawable: Callable[[History], bool]) -> Runs:
    """The runs that can be drawn."""
    chosen = {name: [h for h in histories if drawable(h)] for name, histories in runs.items()}
    return {name: histories for name, histories in chosen.items() if histories}


def _which_seed(runs: Runs) -> str:
    return " Of several seeds, the one of median parameter error is shown." if seed_count(runs) > 1 else ""


def _bands(runs: Runs) -> str:
    return " Lines are medians of seeds, bands their quartiles." if seed_count(runs) > 1 else ""


def _legend_height(runs: Runs) -> float:
    return 0.15 * (1 + (len(runs) > 4))


def _positive(values: dict[str, np.ndarray]) -> bool:
    return any(np.any(np.isfinite(v) & (v > 0)) for v in values.values())
