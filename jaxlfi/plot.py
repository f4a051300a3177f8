"""Plots of arrays from any source; matplotlib is imported when the first one is drawn."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxlfi.figures.style import Figure

__all__ = ["pairs"]

MIN_DRAWS = 20
"""Smallest number of draws for which contours are drawn."""
MAX_PARAMETERS = 12
"""Largest number of parameters that stay legible on the width of a page."""
MAX_SETS = 8
"""Largest number of sets of samples that can be distinguished when drawn over one another."""


def pairs(
    samples: Any,
    *,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    truth: Sequence[float] | None = None,
    support: Any = None,
    points: Mapping[str, tuple[Sequence[float], Any]] | None = None,
    log: Sequence[bool] | Sequence[str] = (),
    path: Path | str | None = None,
    dpi: float = 300.0,
) -> "Figure":
    r"""Draw the marginal of every parameter and contours of every pair of parameters.

    Several sets of samples are drawn over one another, in colours and line styles that colour-blind readers can also
    tell apart. If a support is given, the draws are assumed to lie in it, and densities do not fade towards its bounds.

    Args:
        samples: array of draws, shape [n, D], or a dictionary of up to eight such arrays by label.
        names: names of the D parameters; by default only their symbols are shown.
        units: units of the D parameters, such as "N/m"; "" for none.
        truth: true parameters, shape [D]; NaN if unknown.
        support: box to mark, an object with `low` and `high` or a pair of them, shape [D] each.
        points: estimates by label, each with an interval of every parameter, shapes [D] and [D, 2]; NaN for no
            interval. An estimate with the same label as a set of samples is drawn in its style.
        log: parameters to be drawn on logarithmic axes: their names, or D booleans.
        path: file to write the figure to as well, .png, .pdf or .svg.
        dpi: resolution of a .png.

    Returns:
        A matplotlib figure that is not registered with pyplot; a notebook shows it as the last value of a cell.

    Raises:
        ValueError: for samples that are not a finite [n, D] array or are too few, or for other arguments that do not
            fit them.
        ImportError: if matplotlib is not installed.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> stiffness, damping = rng.lognormal(1.0, 0.2, 500), rng.normal(0.4, 0.1, 500)
        >>> figure = pairs(
        ...     np.column_stack([stiffness, damping]), names=("stiffness", "damping"), units=("N/m", "N s/m"),
        ...     truth=(2.7, 0.4), log=("stiffness",),
        ... )
        >>> [axes.get_xlabel().replace("\n", " ") for axes in figure.axes if axes.get_xlabel()]
        ['stiffness [N/m]', 'damping [N s/m]']
    """
    sets = _sets(samples)
    dim = next(iter(sets.values())).shape[1]
    names_ = _texts("names", names, dim, "theta_{}")
    units_ = _texts("units", units, dim, "")
    is_log = _mask(log, names, dim)
    to_drawn = lambda what, values: _with_logarithms(what, values, is_log, names_)
    sets = {label: to_drawn(_called(label), draws) for label, draws in sets.items()}
    marked = np.full(dim, np.nan) if truth is None else to_drawn("truth", _vector("truth", truth, dim, unknown=True))
    low, high = (None, None) if support is None else _bounds(support, dim)
    box = None if low is None else (to_drawn("support", low), to_drawn("support", high))
    estimates = {
        label: [to_drawn(f"points[{label!r}]", part) for part in parts] for label, parts in _points(points, dim).items()
    }
    all_labels = list(dict.fromkeys([*sets, *estimates]))
    if len(all_labels) > MAX_SETS:
        raise ValueError(f"points: expected up to {MAX_SETS} labels in all, got {len(all_labels)}")

    # Imported here so that `import jaxlfi.plot` does not load matplotlib.
    from jaxlfi.figures import style
    from jaxlfi.figures.natural import Scale
    from jaxlfi.figures.pairs import Cloud, Point, draw_overlay

    looks = dict(zip(all_labels, style.set_looks(all_labels), strict=True))
    clouds = [Cloud(draws, looks[label], marked, box) for label, draws in sets.items()]
    marks = [Point(value, np.stack(ends, axis=1), looks[label]) for label, (value, *ends) in estimates.items()]
    texts = [style.symbol(d) if names is None else style.plain(name) for d, name in enumerate(names_)]
    scale = [
        Scale("\n".join(textwrap.wrap(text, 18)), style.plain_unit(unit), bool(logarithm))
        for text, unit, logarithm in zip(texts, units_, is_log, strict=True)
    ]
    width = style.TEXT_WIDTH if dim > 2 else style.COLUMN_WIDTH
    with style.context():
        figure = style.new_figure(width, 0.65 * width + 0.5 if dim == 1 else width + 0.3)
        draw_overlay(figure, clouds, scale, marks)
        if path is None:
            figure.draw_without_rendering()  # lays out in this style before the settings are restored
        else:
            style.save(figure, Path(path), dpi)
    return figure


def _sets(samples: Any) -> dict[str, np.ndarray]:
    """Checked draws by label; a single array has the label ""."""
    if not isinstance(samples, Mapping):
        return {"": _draws("samples", samples)}
    if not 1 <= len(samples) <= MAX_SETS:
        raise ValueError(f"samples: expected 1 to {MAX_SETS} labelled arrays, got {len(samples)}")
    sets = {str(label): _draws(_called(str(label)), values) for label, values in samples.items()}
    if len({draws.shape[1] for draws in sets.values()}) > 1:
        shapes = ", ".join(f"{label} {list(draws.shape)}" for label, draws in sets.items())
        raise ValueError(f"samples: expected arrays of equally many parameters, got {shapes}")
    return sets


def _called(label: str) -> str:
    return f"samples[{label!r}]" if label else "samples"


def _draws(what: str, values: Any) -> np.ndarray:
    draws = _numbers(what, values)
    if draws.ndim != 2 or not 1 <= draws.shape[1] <= MAX_PARAMETERS:
        hint = ": choose some of the columns" if draws.ndim == 2 and draws.shape[1] else ""
        raise ValueError(
            f"{what}: expected shape [n, D] with 1 <= D <= {MAX_PARAMETERS}, got {list(draws.shape)}{hint}"
        )
    if len(draws) < MIN_DRAWS:
        raise ValueError(f"{what}: expected at least {MIN_DRAWS} draws, got {len(draws)}")
    if unusable := int((~np.isfinite(draws)).any(1).sum()):
        raise ValueError(f"{what}: expected finite numbers, got {unusable} of {len(draws)} rows that are not finite")
    return draws


def _numbers(what: str, values: Any) -> np.ndarray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: expected an array of numbers, got {type(values).__name__}") from error


def _vector(what: str, values: Any, dim: int, unknown: bool = False) -> np.ndarray:
    vector = _numbers(what, values)
    if vector.shape != (dim,):
        raise ValueError(f"{what}: expected shape [{dim}], one number for each parameter, got {list(vector.shape)}")
    if not (np.isfinite(vector) | (unknown & np.isnan(vector))).all():
        raise ValueError(f"{what}: expected finite numbers{' or NaN' if unknown else ''}, got {vector.tolist()}")
    return vector


def _points(given: Any, dim: int) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Estimates, and the lower and upper ends of their intervals, checked."""
    if not isinstance(given, Mapping | None):
        raise ValueError(f"points: expected estimates by label, got {given!r}")
    found = {}
    for label, pair in (given or {}).items():
        what = f"points[{label!r}]"
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise ValueError(f"{what}: expected an estimate and its intervals, got {pair!r}")
        interval = _numbers(what, pair[1])
        if interval.shape != (dim, 2) or np.isinf(interval).any():
            raise ValueError(f"{what}: expected intervals of shape [{dim}, 2], finite or NaN, got {interval.tolist()}")
        found[str(label)] = _vector(what, pair[0], dim), *interval.T
    return found


def _bounds(support: Any, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of a box given as an object with `low` and `high` or as a pair."""
    if hasattr(support, "low") and hasattr(support, "high"):
        low, high = support.low, support.high
    elif isinstance(support, list | tuple | np.ndarray) and len(support) == 2:
        low, high = support
    else:
        raise ValueError(f"support: expected an object with low and high, or (low, high), got {support!r}")
    low, high = _vector("support low", low, dim), _vector("support high", high, dim)
    if not (low < high).all():
        raise ValueError(f"support: expected low < high, got {low.tolist()} and {high.tolist()}")
    return low, high


def _texts(what: str, given: Sequence[str] | None, dim: int, default: str) -> tuple[str, ...]:
    texts = tuple(default.format(d + 1) for d in range(dim)) if given is None else tuple(given)
    if isinstance(given, str) or len(texts) != dim or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{what}: expected {dim} strings, one for each parameter, got {given!r}")
    return texts


def _mask(log: Sequence[bool] | Sequence[str], names: Sequence[str] | None, dim: int) -> np.ndarray:
    """Which parameters are drawn on logarithmic axes, shape [D]."""
    given = [log] if isinstance(log, str) else list(log)
    if all(isinstance(name, str) for name in given) and (names is not None or not given):
        known = [None] * dim if names is None else list(names)
        if unknown := [name for name in given if name not in known]:
            raise ValueError(f"log: expected some of {', '.join(map(str, known))}, got {', '.join(map(str, unknown))}")
        return np.array([name in given for name in known])
    mask = np.asarray(given)
    if mask.shape != (dim,) or mask.dtype != bool:
        raise ValueError(f"log: expected names of parameters or {dim} booleans, got {log!r}")
    return mask


def _with_logarithms(what: str, values: np.ndarray, is_log: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Values [..., D] with some parameters replaced by their natural logarithms."""
    for name, column in zip(np.array(names)[is_log], values[..., is_log].T, strict=True):
        if np.min(column) <= 0:
            raise ValueError(f"{what}: expected positive values of {name}, which log names, got {np.min(column):g}")
    return np.where(is_log, np.log(np.where(is_log, values, 1.0)), values)
