"""Angles of encoders that wrap after a turn, made continuous."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

TURN = 2 * np.pi
_NEIGHBOURS = 3
"""Steps on either side that say how fast an angle changes."""
_AGREES, _SLACK = 0.25, 0.15
"""By how much a step may differ from its neighbours where the encoder wraps: of the period, and in rad."""
_MOST = 0.75
"""Of the jumps: as many have to be such, as some readings may be lost."""
_JUMP, _STEADY = 0.8, 0.2
"""Of the readings' range: what is longer is a jump, where nearly all other steps are shorter than the second."""
_BEYOND = 0.06
"""Of the period: by how much noise may carry readings beyond it."""
_POSES = 8
"""Equal parts of the readings' range, all of which a rod goes through that is seen without its direction."""
_AMBIGUOUS = 0.4
"""Of the period: steps longer than this may have gone either way round."""


class Unwrapped(NamedTuple):
    """A continuous angle.

    Attributes:
        values: in rad, shape [T].
        period: after which the encoder wraps, in rad; 0 where it does not.
        count: how often it does.
        turns: how many periods were added besides, so that it begins where the model does.
        fastest: the longest step between two samples, as a fraction of the period.
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

    Its readings lie within one period and jump by that period, and without the jump the angle goes on as before and
    afterwards. An angle that is within the joint's limits is left as it is.

    Args:
        times: of the samples, in s.
        values: in rad.
        start: where the model begins, in rad, which says how many periods are to be added; None where it is not known.
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
    """How many turns a difference of angles is, where it is whole ones; otherwise 0."""
    turns = round(difference / TURN)
    return turns if abs(difference - turns * TURN) <= tolerance else 0


def _within(values: np.ndarray, limits: Sequence[float]) -> bool:
    margin = 0.05 * (limits[1] - limits[0]) + 0.05
    return bool((values >= limits[0] - margin).all() and (values <= limits[1] + margin).all())


def _period(times: np.ndarray, values: np.ndarray) -> tuple[float, int]:
    """The period after which an angle wraps, whole turns or a half, and how often it does; 0 where it does not."""
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
    """Whether an angle without a jump changes as it does before and after, and with the jump does not."""
    near = np.arange(max(jump - _NEIGHBOURS, 0), min(jump + _NEIGHBOURS + 1, len(speeds)))
    near = speeds[near[near != jump]]
    if not len(near):
        return False
    speed = float(np.median(near))
    spread = float(np.median(np.abs(near - speed)))
    off = abs(speeds[jump] - speed) * gaps[jump]
    tolerance = min(_AGREES * period, _SLACK + 4 * spread * gaps[jump])
    return off <= tolerance and off < 0.5 * abs(step - speed * gaps[jump])
