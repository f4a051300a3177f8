"""Training and validation losses: epoch by epoch within the rounds of one run, or round by round for several runs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from jaxlfi.figures import statistics
from jaxlfi.figures.bands import draw_band, over
from jaxlfi.figures.collection import Runs, all_of, seed_count
from jaxlfi.figures.extent import extent
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import of_configurations
from jaxlfi.figures.style import integer_ticks, iteration_bar, iteration_colours, iterations_axis, looks

PANELS = {"loss": "training loss", "validation_loss": "validation loss"}


def by_epoch(history: History, panel: str) -> np.ndarray | None:
    """Loss after each epoch, averaged over the ensemble's networks, shape [R, P]; NaN after early stopping."""
    values = getattr(history, panel)
    return None if values is None else statistics.mean(np.where(np.isfinite(values), values, np.nan), 1)


def by_round(history: History, panel: str) -> np.ndarray | None:
    """One loss per round, shape [R]: the training loss of the last epoch, the lowest validation loss."""
    values = by_epoch(history, panel)
    if values is None:
        return None
    if panel == "validation_loss":
        return np.where(np.isnan(values).all(1), np.nan, np.where(np.isnan(values), np.inf, values).min(1))
    last = values.shape[1] - 1 - np.argmax(~np.isnan(values[:, ::-1]), axis=1)
    return values[np.arange(len(values)), last]


def drawable(runs: Runs) -> bool:
    """Whether losses were saved."""
    return any(getattr(h, panel) is not None for h in all_of(runs) for panel in PANELS)


def draw(figure: Figure, runs: Runs) -> None:
    """Draw losses of one run epoch by epoch, or of several runs round by round."""
    every = all_of(runs)
    shown = [panel for panel in PANELS if any(getattr(h, panel) is not None for h in every)]
    axes = dict(zip(shown, figure.subplots(1, len(shown), squeeze=False, sharey=True)[0], strict=True))
    if len(every) == 1:
        for panel in shown:
            draw_epochs(axes[panel], every[0], panel)
        _limit(list(axes.values()), [by_epoch(every[0], panel) for panel in shown])
        iteration_bar(figure, np.array(list(axes.values())), every[0].rounds)
    else:
        look = looks(list(runs))
        for panel in shown:
            for name, histories in runs.items():
                values = [by_round(h, panel) for h in histories if getattr(h, panel) is not None]
                if values:
                    x = np.arange(1, every[0].rounds + 1)
                    draw_band(axes[panel], x, np.stack(values), look[name])
            iterations_axis(axes[panel], every[0].rounds)
        seeds = f"; {over(seed_count(runs))}" if seed_count(runs) > 1 else ""
        of_configurations(figure, look, f"last training loss, lowest validation loss{seeds}")
    for panel in shown:
        axes[panel].set_title(PANELS[panel])
        axes[panel].grid(True)
    axes[shown[0]].set_ylabel("negative log-density")


def draw_epochs(axes: Axes, history: History, panel: str) -> None:
    """Draw one line per round over the epochs of its training, coloured by iteration."""
    values = by_epoch(history, panel)
    colours, norm = iteration_colours(history.rounds)
    single = "o" if values.shape[1] == 1 else None
    for i, line in enumerate(values):
        axes.plot(np.arange(1, len(line) + 1), line, marker=single, color=colours(norm(i + 1)), linewidth=0.8)
    axes.set_xlabel("epoch")
    if values.shape[1] > 30:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        integer_ticks(axes.xaxis)
    if values.shape[1] > 1:
        axes.set_xlim(1, values.shape[1])


def _limit(panels: list[Axes], values: list[np.ndarray]) -> None:
    """Set limits that leave out a few losses far above the others, which would flatten all lines."""
    every = np.concatenate([v[np.isfinite(v)] for v in values])
    if not every.size:
        return
    low, high = min(every), extent(every)[1]
    margin = 0.06 * (high - low)
    for axes in panels:
        axes.set_ylim(low - margin, high + margin)
