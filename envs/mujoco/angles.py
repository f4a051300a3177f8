"""Angles of encoders that wrap after a turn, made continuous."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

TURN = 2 * np.pi
_NEIGHBOURS = 3
"""Steps on either side that say how fast an angle changes."""
_AGREES, _SLACK = 0.25, 0.15
"""How much a step may differ from its neighbours where the encoder wraps: fraction of the period, and rad."""
_MOST = 0.75
"""Fraction of the jumps that must be wraps; a few may be due to lost readings."""
_JUMP, _STEADY = 0.8, 0.2
"""A step above the first fraction of the readings' range is a jump if most steps are below the second fraction."""
_BEYOND = 0.06
"""How far noise may carry readings beyond the period, as a fraction of it."""
_POSES = 8
"""Equal parts of the readings' range; a rod seen without its direction, which wraps by half turns, visits them all."""
_AMBIGUOUS = 0.4
"""Fraction of the period above which a step may have gone either way round."""


class Unwrapped(NamedTuple):
    """A continuous angle.

    Attributes:
        values: in rad, shape [T].
        period: angle after which the encoder wraps, in rad; 0 if it does not.
        count: number of wraps.
        turns: number of periods added so that the angle begins where the model does.
        fastest: largest step between two samples, as a fraction of the period.
    """

    values: Float[np.ndarray, " time"]
    period: float = 0.0
    count: int = 0
    turns: int = 0
    fastest: float = 0.0

    @property
    def ambiguous(self) -> bool:
        """Whether steps may have gone the other way round."""
        return self.fastest > _AMBIGUOUS


def unwrapped(
    times: Float[np.ndarray, " time"],
    values: Float[np.ndarray, " time"],
    start: float | None = None,
    limits: Sequence[float] | None = None,
) -> Unwrapped:
    """An angle without the jumps of an encoder that wraps after one or several half turns.

    The readings lie within one period and jump by that period; without the jump, the angle changes as it does before
    and after. An angle that is within the joint's limits is left as it is.

    Args:
        times: of the samples, in s.
        values: in rad.
        start: the model's initial angle in rad, which determines how many periods are added; None if unknown.
        limits: of the joint, in rad; None where it has none.
    """
    period, jumps = _period(times, values)
    if not period:
        return Unwrapped(values)
    continuous = np.unwrap(values, period=period)
    if limits is not None and limits[1] - limits[0] < period:
        turns = round((float(np.mean(limits)) - float(np.ptp(continuous) / 2 + continuous.min())) / period)
        if _within(values, limits) or not _within(continuous + turns * period, limits):
            return Unwrapped(values)
    else:
        turns = 0 if start is None else round((start - continuous[0]) / period)
    fastest = float(np.abs(np.diff(continuous)).max() / period)
    return Unwrapped(continuous + turns * period, period, jumps, turns, fastest)


def jumps(values: Float[np.ndarray, " time"]) -> int:
    """How often readings jump from one end of their range to the other, while they change little otherwise."""
    steps = np.abs(np.diff(values)) / max(float(np.ptp(values)), 1e-300)
    count = int(np.sum(steps > _JUMP))
    return count if count > 1 and np.mean(steps < _STEADY) > _JUMP else 0


def whole_turns(difference: float, tolerance: float) -> int:
    """The number of turns in a difference of angles if it is close to whole turns; otherwise 0."""
    turns = round(difference / TURN)
    return turns if abs(difference - turns * TURN) <= tolerance else 0


def _within(values: np.ndarray, limits: Sequence[float]) -> bool:
    margin = 0.05 * (limits[1] - limits[0]) + 0.05
    return bool((values >= limits[0] - margin).all() and (values <= limits[1] + margin).all())


def _period(times: np.ndarray, values: np.ndarray) -> tuple[float, int]:
    """The period of an angle that wraps (whole turns or half a turn) and the number of wraps; 0 if it does not wrap."""
    steps, gaps = np.diff(values), np.diff(times)
    longest = float(np.abs(steps).max(initial=0.0))
    for period in (TURN * max(round(longest / TURN), 1), TURN / 2):
        jumps = np.flatnonzero(np.abs(steps) > period / 2)
        # An arm that goes from one pose to another may also make a half turn between two samples.
        visited = period >= TURN or np.histogram(values, _POSES)[0].all()
        if len(jumps) and visited and np.ptp(values) <= (1 + _BEYOND) * period:
            speeds = np.diff(np.unwrap(values, period=period)) / gaps
            if np.mean([_goes_on(speeds, gaps, jump, period, steps[jump]) for jump in jumps]) >= _MOST:
                return period, len(jumps)
    return 0.0, 0


def _goes_on(speeds: np.ndarray, gaps: np.ndarray, jump: int, period: float, step: float) -> bool:
    """Whether the angle changes as it does before and after once the jump is removed, and not with the jump."""
    near = np.arange(max(jump - _NEIGHBOURS, 0), min(jump + _NEIGHBOURS + 1, len(speeds)))
    near = speeds[near[near != jump]]
    if not len(near):
        return False
    speed = float(np.median(near))
    spread = float(np.median(np.abs(near - speed)))
    off = abs(speeds[jump] - speed) * gaps[jump]
    tolerance = min(_AGREES * period, _SLACK + 4 * spread * gaps[jump])
    return off <= tolerance and off < 0.5 * abs(step - speed * gaps[jump])
