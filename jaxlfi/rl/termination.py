"""Conditions that end an episode early: a signal, a comparison and a number, such as "body/torso/pos[2] < 0.2".

condition  = signal comparison number | "abs(" signal ")" comparison number
comparison = "<" | "<=" | ">" | ">="

A policy's preparation contains them (`jaxlfi.rl.preparation`), so that they also end its episodes on a robot.
"""

import dataclasses
import math
import operator
import re
from typing import Any

_FORM = re.compile(
    r"\s*(?:abs\((?P<inside>[^<>=]+)\)|(?P<plain>[^<>=]+?))\s*(?P<comparison><=|>=|<|>)\s*(?P<number>[^\s<>=]+)\s*"
)
_COMPARISONS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


@dataclasses.dataclass(frozen=True)
class Termination:
    """A condition that ends an episode with the control interval at whose end it holds.

    Attributes:
        signal: signal that is compared: in training the model's value without noise, on a robot the measured one.
        comparison: "<", "<=", ">" or ">=".
        number: number that it is compared with.
        magnitude: whether the signal's absolute value is compared.
        cost: cost of such an end; negative if the end is desirable.
        unit: unit of the signal; "" if there is none, or it is not known.

    Raises:
        ValueError: for numbers that are not finite.
    """

    signal: str
    comparison: str
    number: float
    magnitude: bool = False
    cost: float = 0.0
    unit: str = ""

    def __post_init__(self):
        if not (math.isfinite(self.number) and math.isfinite(self.cost)):
            raise ValueError(f"expected finite numbers, got {self.number:g} and a cost of {self.cost:g}")
        if self.comparison not in _COMPARISONS:
            raise ValueError(f"expected a comparison among {', '.join(_COMPARISONS)}, got {self.comparison!r}")

    def holds(self, value: Any) -> Any:
        """Whether the condition holds at this value of the signal; it never does at NaN."""
        return _COMPARISONS[self.comparison](abs(value) if self.magnitude else value, self.number)

    def __str__(self) -> str:
        """The condition as it is written in a file."""
        what = f"abs({self.signal})" if self.magnitude else self.signal
        return f"{what} {self.comparison} {self.number:g}"


def parsed(text: str, cost: float = 0.0) -> Termination:
    """The condition that a text states.

    Raises:
        ValueError: for a text that is not a condition.

    Example:
        >>> parsed("abs(pole angle) >= 1.5")
        Termination(signal='pole angle', comparison='>=', number=1.5, magnitude=True, cost=0.0, unit='')
    """
    match = _FORM.fullmatch(text)
    try:
        if match is None:
            raise ValueError
        number = float(match["number"])
    except ValueError:
        raise ValueError(
            f'expected SIGNAL < NUMBER, or with <=, > or >=, as "body/torso/pos[2] < 0.2", got {text!r}'
        ) from None
    inside = match["inside"]
    signal = (match["plain"] if inside is None else inside).strip()
    return Termination(signal, match["comparison"], number, inside is not None, cost)
