"""The adjustable settings of an experiment: the variables of its design, their bounds, and what else is known."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlfi.tasks.host import HostSimulator

LARGEST = 1e30
"""Bounds of a design must be smaller than this in magnitude, as they are in single precision."""
VARIABLES = 'a mapping from names to (low, high) or (low, high, "unit")'


@dataclasses.dataclass(frozen=True)
class Variable:
    """One number of a design.

    Attributes:
        name: its name.
        low: lower bound.
        high: upper bound.
        unit: "" for none.
    """

    name: str
    low: float
    high: float
    unit: str = ""

    @property
    def label(self) -> str:
        """The name with its unit, as a heading.

        Example:
            >>> Variable("amplitude", 0.1, 1.0, "N m").label
            'amplitude [N m]'
        """
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclasses.dataclass(frozen=True)
class Design:
    """The adjustable settings of an experiment, as `Task(design=...)` takes them; a mapping of the variables will do.

    Attributes:
        variables: K numbers to choose, as `{"amplitude": (0.1, 1.0, "N m"), "frequency": (0.2, 5.0)}`.
        nominal: the design that the task is simulated and inferred at, by name or in order; by default the middle.
        response: the trajectory without its noise, `response(theta[D], design[K]) -> trajectory`, in natural units
            and in JAX; with `jaxlfi.HostSimulator`, `response(theta[N, D], design[K]) -> trajectories [N, ...]`.
            Without one, a simulator in JAX is differentiated with its noise held fixed, which is equivalent if the
            noise is additive.
        noise: standard deviation of the measurement noise of each column of a trajectory, shape [C]; by default the
            task's `channel_noise`. Noise is independent from record to record.
        safe: `safe(trajectory) -> bool`: whether an experiment with this trajectory would have been harmless. A design
            is rejected if this check, or the simulation, fails for too many posterior draws.
        of: the task of an experiment with this design and the same parameters, if the task's own simulator takes no
            design because its recordings are of other experiments, such as those under recorded controls.
        controls: `controls(design[K]) -> (headings, rows)`: what to play on the real system, written as CSV, and as
            MCAP if the first column is "time [s]".

    Raises:
        ValueError: for variables without a name, reversed bounds, or a nominal design outside of them.

    Example:
        >>> chosen = Design({"amplitude": (0.1, 1.0, "N m"), "frequency": (0.2, 5.0, "Hz")}, nominal={"frequency": 1.0})
        >>> chosen.nominal, chosen.labels
        ((0.55, 1.0), ('amplitude [N m]', 'frequency [Hz]'))
    """

    variables: Any
    nominal: Any = None
    response: Callable[..., Any] | None = None
    noise: Any = None
    safe: Callable[..., Any] | None = None
    controls: Callable[..., Any] | None = None
    of: Any = None

    def __post_init__(self):
        store = lambda field, value: object.__setattr__(self, field, value)
        given = self.variables
        if isinstance(given, Mapping):
            given = tuple(_variable(name, bounds) for name, bounds in given.items())
        if not isinstance(given, tuple) or not given or not all(isinstance(one, Variable) for one in given):
            raise ValueError(f"design: expected {VARIABLES}, got {self.variables!r}")
        store("variables", given)
        store("nominal", self._nominal(self.nominal))
        if self.noise is not None:
            try:
                noise = tuple(float(one) for one in np.ravel(np.asarray(self.noise, float)))
            except (TypeError, ValueError) as error:
                raise ValueError(f"design: noise: expected standard deviations, got {self.noise!r}") from error
            if not noise or not all(0 < one < np.inf for one in noise):
                raise ValueError(f"design: noise: expected standard deviations above 0, got {self.noise!r}")
            store("noise", noise)
        for field in ("response", "safe", "controls"):
            if getattr(self, field) is not None and not callable(getattr(self, field)):
                raise ValueError(f"design: {field}: expected a function, got {getattr(self, field)!r}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables."""
        return tuple(one.name for one in self.variables)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the variables, with their units."""
        return tuple(one.label for one in self.variables)

    @property
    def low(self) -> np.ndarray:
        """Lower bounds, shape [K]."""
        return np.array([one.low for one in self.variables])

    @property
    def high(self) -> np.ndarray:
        """Upper bounds, shape [K]."""
        return np.array([one.high for one in self.variables])

    def values(self, chosen: Any) -> tuple[float, ...]:
        """A design as numbers in the order of the variables.

        Args:
            chosen: values by name, others being nominal, or all of them in order.

        Raises:
            ValueError: for unknown names, a wrong number of values, or one outside its bounds.
        """
        if isinstance(chosen, Mapping):
            if unknown := [name for name in chosen if name not in self.names]:
                raise ValueError(f"design: expected names among {list(self.names)}, got {unknown}")
            start = dict(zip(self.names, self.nominal or 0.5 * (self.low + self.high), strict=True))
            chosen = list((start | dict(chosen)).values())
        try:
            values = tuple(float(one) for one in np.asarray(chosen, float))
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"design: expected numbers for {list(self.names)}, got {chosen!r}") from error
        if len(values) != len(self.variables):
            raise ValueError(f"design: expected numbers for {list(self.names)}, got {len(values)} of them")
        for one, value in zip(self.variables, values, strict=True):
            slack = 1e-6 * (one.high - one.low)  # rounding of single precision
            if not one.low - slack <= value <= one.high + slack:
                raise ValueError(f"design: {one.name}: expected {one.low:g} to {one.high:g}, got {value:g}")
        return values

    def of_unit(self, unit: np.ndarray) -> np.ndarray:
        """Designs [..., K] of points of the unit cube."""
        return self.low + np.asarray(unit) * (self.high - self.low)

    def to_unit(self, design: Any) -> np.ndarray:
        """Points of the unit cube [..., K] of designs, the inverse of `of_unit`."""
        return (np.asarray(design, float) - self.low) / (self.high - self.low)

    def _nominal(self, given: Any) -> tuple[float, ...]:
        object.__setattr__(self, "nominal", None)
        return self.values({} if given is None else given)


def _is_bound(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(-LARGEST < value < LARGEST)


def _variable(name: Any, bounds: Any) -> Variable:
    wrong = ValueError(f"design: {name}: expected (low, high) or (low, high, unit), low below high, got {bounds!r}")
    if not isinstance(name, str) or not name or not isinstance(bounds, Sequence) or not 2 <= len(bounds) <= 3:
        raise wrong
    values: list[Any] = list(bounds)
    low, high, *unit = values
    if not (_is_bound(low) and _is_bound(high) and low < high and all(isinstance(one, str) for one in unit)):
        raise wrong
    return Variable(name, float(low), float(high), *unit)


class OfDesign:
    """A simulator that has been given its design, as in tasks with a design."""


@dataclasses.dataclass(frozen=True)
class Designed(OfDesign):
    """A simulator at one design.

    Attributes:
        function: `function(key, theta, design)`; outside JAX with a generator in place of the key.
        point: the design.
        numpy: whether the design is passed as a NumPy array, to a simulator outside JAX.
    """

    function: Callable[..., Any]
    point: tuple[float, ...]
    numpy: bool = False

    def __call__(self, source: Any, theta: Any) -> Any:
        """Simulate."""
        return self.function(source, theta, np.array(self.point) if self.numpy else jnp.asarray(self.point, float))


def declared(design: Any) -> Design:
    """A task's design, checked."""
    return design if isinstance(design, Design) else Design(design)


def at_nominal(simulate: Any, design: Design) -> Any:
    """A task's simulator at the nominal design; one that already has its design is unchanged.

    Raises:
        ValueError: for a simulator that takes no design.
    """
    outside = isinstance(simulate, HostSimulator)
    function = simulate.function if outside else simulate
    if isinstance(function, OfDesign):
        return simulate
    try:
        inspect.signature(function).bind(None, None, None)
    except TypeError as error:
        source = "rng" if outside else "key"
        raise ValueError(f"simulate: expected a function of ({source}, theta, design), as the task has one") from error
    except ValueError:
        pass  # some built-in functions have no signature
    designed = Designed(function, design.nominal, outside)
    return dataclasses.replace(simulate, function=designed) if outside else designed
