"""Natural units: axes of inferred logarithms, labelled with the original quantities."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axis import Axis
from matplotlib.ticker import Formatter, FuncFormatter, Locator, MaxNLocator, NullFormatter

from jaxlfi.figures.style import is_log, named_with_unit, parameter_name, plain_unit, round_ticks

WITHIN = ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,))
"""Choices of ticks within a decade; the one with the most ticks that fit is used."""
LINEAR = 8.0
"""Ratio of the ends of an axis below which its ticks may be evenly spaced numbers."""
LARGEST = 600.0
"""Magnitude of logarithms beyond which they are not exponentiated, to avoid overflow."""
PREFIXED = ("Pa", "N", "J", "W", "N/m", "N m", "Hz")
"""Units that take a prefix, so that numbers on the axis are short."""
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


class LogTicks(Locator):
    """Ticks of an axis of natural logarithms, at round numbers of the original quantity.

    Args:
        count: largest number of ticks, minus one.
        scale: size of the unit in which the numbers are written.

    Example:
        >>> np.exp(LogTicks(4).tick_values(np.log(0.8), np.log(60.0))).round(2).tolist()
        [1.0, 3.0, 10.0, 30.0]
        >>> np.exp(LogTicks(4).tick_values(np.log(0.8), np.log(2.0))).round(2).tolist()
        [0.8, 1.2, 1.6, 2.0]
    """

    def __init__(self, count: int, scale: float = 1.0) -> None:
        self.count, self.scale = count, scale

    def __call__(self) -> np.ndarray:
        """Ticks within the current view of the axis."""
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:
        """Ticks between two logarithms."""
        low, high = sorted((vmin, vmax))
        shift = math.log(self.scale)
        ticks = self._ticks(low - shift, high - shift) + shift
        return ticks[(ticks >= low - 1e-9) & (ticks <= high + 1e-9)]

    def _ticks(self, low: float, high: float) -> np.ndarray:
        decades = np.arange(math.floor(low / math.log(10)), math.ceil(high / math.log(10)) + 1)
        candidates = [(decades[:, None] * math.log(10) + np.log(within)).ravel() for within in WITHIN]
        if max(abs(low), abs(high)) < LARGEST and high - low < math.log(LINEAR):
            even = MaxNLocator(self.count, steps=[1, 2, 2.5, 4, 5, 10]).tick_values(math.exp(low), math.exp(high))
            candidates.append(np.log(even[even > 0]))
        inside = lambda ticks: int(np.sum((ticks >= low) & (ticks <= high)))
        fitting = [ticks for ticks in candidates if inside(ticks) <= self.count + 1]
        if fitting:
            return max(fitting, key=inside)
        return decades[:: math.ceil(len(decades) / (self.count + 1))] * math.log(10)


class LogNumbers(Formatter):
    """Tick labels of an axis of natural logarithms: the original quantity.

    Args:
        scale: size of the unit in which the numbers are written.
        before: text before the number, such as a multiplication sign.

    Example:
        >>> LogNumbers()(np.log(0.02)), LogNumbers(scale=1e3)(np.log(5e4)), LogNumbers()(np.log(1e7))
        ('0.02', '50', '$10^{7}$')
    """

    def __init__(self, scale: float = 1.0, before: str = "") -> None:
        self.scale, self.before = scale, before

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The label at a logarithm."""
        exponent = (x - math.log(self.scale)) / math.log(10)
        if -3.5 <= exponent < 5:
            return f"{self.before}{10**exponent:.6g}"
        power = math.floor(exponent + 1e-9)
        mantissa = f"{10 ** (exponent - power):.5g}"
        times = "" if mantissa == "1" else rf"{mantissa}\times"
        return rf"{self.before}${times}10^{{{power}}}$"


def logarithmic(axis: Axis, count: int, scale: float = 1.0, before: str = "") -> None:
    """Let an axis of natural logarithms show at most `count` + 1 round numbers of the original quantity."""
    axis.set_major_locator(LogTicks(count, scale))
    axis.set_major_formatter(LogNumbers(scale, before))
    axis.set_minor_formatter(NullFormatter())


class ScaleTicks(LogTicks):
    """Ticks of an axis on a logarithmic scale: as `LogTicks`, but for the numbers themselves.

    Example:
        >>> ScaleTicks(4).tick_values(0.012, 0.045).round(3).tolist()
        [0.02, 0.03, 0.04]
    """

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:
        """Ticks between two positive numbers."""
        return np.exp(super().tick_values(math.log(vmin), math.log(vmax)))


def scale_ticks(axis: Axis, count: int) -> None:
    """Let an axis on a logarithmic scale show at most `count` + 1 round numbers."""
    axis.set_major_locator(ScaleTicks(count))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def prefix(unit: str, magnitude: float) -> tuple[float, str]:
    """Size and name of the prefixed unit in which numbers of some magnitude are short.

    Example:
        >>> prefix("Pa", 3e5), prefix("Pa", 30.0), prefix("mm", 3e5)
        ((1000.0, 'kPa'), (1.0, 'Pa'), (1.0, 'mm'))
    """
    fitting = ((size, letter + unit) for size, letter in _PREFIXES if unit in PREFIXED and magnitude >= size)
    return next(fitting, (1.0, unit))


@dataclasses.dataclass(frozen=True)
class Scale:
    """How a parameter's axis is labelled: in its natural unit, and logarithmically if its logarithm is inferred."""

    label: str  # label of the axis, without unit
    unit: str = ""  # natural unit, "" for none
    log: bool = False  # whether the data are natural logarithms

    def show(self, axis: Axis, count: int) -> None:
        """Set at most `count` + 1 ticks and the label of an axis whose limits are already set."""
        low, high = sorted(axis.get_view_interval())
        if self.log:
            size, unit = prefix(self.unit, math.exp(max(-LARGEST, min((low + high) / 2, LARGEST))))
            logarithmic(axis, count, size)
        else:
            size, unit = prefix(self.unit, max(abs(low), abs(high)) / 2)
            round_ticks(axis, count)
            if size > 1:
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / size:.6g}"))
        axis.set_label_text(named_with_unit(self.label, unit))


def scales(names: Sequence[str], units: Sequence[str], width: int = 26) -> list[Scale]:
    """The scales of parameters in inference space, labelled with their symbols and names, wrapped to `width`."""
    each = zip(names, units, strict=True)
    return [Scale(parameter_name(names, d, width), plain_unit(u), is_log(n)) for d, (n, u) in enumerate(each)]
