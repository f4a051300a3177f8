"""Summaries of recordings by name: what the network sees of a trajectory.

| name | numbers, for each episode and signal |
|---|---|
| `samples` | up to 30 rows at about equal intervals, as they are; fewer for more than four episodes |
| `cross-correlation` | correlations with the controls and with itself, at some lags; means and standard deviations |
| `spectrum` | the mean, and the logarithm of the power in bands of frequency |
| `learnt` | all rows, through convolutions that are trained with the density in every round |

Cross-correlations are those of BayesSim (Ramos et al. 2019), which sums products of states and controls; here they are
coefficients within [-1, 1], as a box's simulations may differ in scale by orders of magnitude. Correlations and spectra
are of signals at equal intervals, as many as there are rows: times and missing samples are the same in all simulations,
so what is between samples is interpolated linearly, by weights that are known beforehand.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.envs.mujoco.simulator import Simulator
from jaxlfi.tasks import summaries

SAMPLES = 30
"""Largest number of rows of an episode in `samples`."""
FEW, NUMBERS = 4, 360
"""Most episodes with that many rows; for more, the network sees about so many numbers, at least three rows each."""
LAGS = (0.0, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Lags of correlations, as fractions of an episode's duration."""
BANDS = 12
"""Largest number of frequency bands, whose bounds are in geometric progression."""
LEAST = 8
"""Rows that a spectrum needs."""
_FLOOR = 1e-8
"""Power, as a fraction of the recorded signal's variance, that is added to that of each band: constants have none."""

Summary = Callable[[jax.Array], jax.Array]


class Regular(NamedTuple):
    """The values of an episode at equal intervals, each between two samples of a signal in a trajectory.

    Attributes:
        before: row of the sample before, or at, each moment.
        after: row of the one after.
        fraction: of the way between the two.
    """

    before: Int[np.ndarray, "moments signals"]
    after: Int[np.ndarray, "moments signals"]
    fraction: Float[np.ndarray, "moments signals"]

    def of(self, trajectory: Float[Array | np.ndarray, "rows signals"]) -> Float[Array | np.ndarray, "moments signals"]:
        """The signals at equal intervals; those without a sample in this episode are 0."""
        signals = np.arange(self.fraction.shape[1])
        before, after = trajectory[self.before, signals], trajectory[self.after, signals]
        return before + self.fraction * (after - before)  # keeps a constant exactly constant


def samples(trajectory: Float[Array, "rows signals"], rows: tuple[int, ...]) -> Float[Array, " obs"]:
    """Some rows of a trajectory, as they are."""
    return jnp.ravel(trajectory[np.asarray(rows)])


samples.of_rows = True  # for `jaxlfi.tasks.summaries.layout`


def cross_correlation(
    trajectory: Float[Array, "rows signals"],
    episodes: Sequence[Regular],
    controls: Sequence[Float[np.ndarray, "moments controls"]],
) -> Float[Array, " obs"]:
    """Correlations of signals with controls and with themselves, and moments.

    Of each episode, in this order: for each lag the mean products of each control with each signal that follows it by
    the lag; for each lag but 0 those of each signal with itself; the means of the signals; their standard deviations.
    Products are of standardised values, and sums are divided by the number of all moments. They are 0 for constant
    signals.

    Args:
        trajectory: episodes one after another.
        episodes: at equal intervals.
        controls: of each episode at these moments, standardised; none where the model has no actuators.
    """
    found = []
    for regular, applied in zip(episodes, controls, strict=True):
        values = regular.of(trajectory)
        standard, count = _standardised(values), len(applied)
        for lag in lags(count):
            found.append(applied[: count - lag].T @ standard[lag:] / count)
        for lag in lags(count)[1:]:
            found.append(jnp.sum(standard[: count - lag] * standard[lag:], axis=0) / count)
        found += [jnp.mean(values, axis=0), jnp.std(values, axis=0)]
    return jnp.concatenate([jnp.ravel(part) for part in found])


def spectrum(
    trajectory: Float[Array, "rows signals"],
    episodes: Sequence[Regular],
    floors: Sequence[Float[np.ndarray, " signals"]],
) -> Float[Array, " obs"]:
    """Means of signals, and logarithms of their power in bands of frequency.

    Of each episode: the means of the signals; then for each band the sum over its frequencies of the periodogram, with
    a Hann window and without the mean; all bands together are about the variance.

    Args:
        trajectory: episodes one after another.
        episodes: at equal intervals.
        floors: power of each episode and signal that is added to that of a band.
    """
    found = []
    for regular, floor in zip(episodes, floors, strict=True):
        values = regular.of(trajectory)
        count, mean = len(values), jnp.mean(values, axis=0)
        centred = jnp.where(_constant(values), 0.0, values - mean)
        window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)
        sides = np.full(count // 2 + 1, 2.0)  # positive frequencies count for the negative ones, too
        sides[0], sides[-1] = 1.0, 1.0 if count % 2 == 0 else 2.0
        weights = (sides / (count * np.sum(window**2)))[:, None]
        power = weights * jnp.abs(jnp.fft.rfft(window[:, None] * centred, axis=0)) ** 2
        edges = bands(count)
        sums = [jnp.sum(power[low:high], axis=0) for low, high in itertools.pairwise(edges)]
        found += [mean, *(jnp.log(one + floor) for one in sums)]
    return jnp.concatenate(found)


def lags(count: int) -> list[int]:
    """Lags of correlations, in moments of an episode that has `count` of them; the first is 0.

    Example:
        >>> lags(400), lags(8)
        ([0, 6, 13, 25, 50, 100], [0, 1, 2])
    """
    return sorted({int(np.floor(fraction * count + 0.5)) for fraction in LAGS} & set(range(count)))


def bands(count: int) -> list[int]:
    """Where frequency bands begin in the spectrum of `count` moments, and where the last one ends.

    Example:
        >>> bands(64)
        [1, 2, 3, 4, 6, 8, 10, 14, 18, 25, 33]
    """
    last = count // 2 + 1
    return np.unique(np.round(np.geomspace(1, last, BANDS + 1))).astype(int).tolist()


def regular(times: Sequence[np.ndarray], there: np.ndarray) -> tuple[Regular, ...]:
    """Episodes at equal intervals.

    Args:
        times: of the rows of each episode.
        there: whether there is a sample, shape [sum T, C].
    """
    found, begin = [], 0
    for own in times:
        moments = np.linspace(own[0], own[-1], len(own))
        columns = []
        for present in there[begin : begin + len(own)].T:
            rows = np.flatnonzero(present) if present.any() else np.zeros(1, int)
            place = np.interp(moments, own[rows], np.arange(len(rows)))
            before = np.minimum(np.floor(place).astype(int), len(rows) - 1)
            after = np.minimum(before + 1, len(rows) - 1)
            columns.append((begin + rows[before], begin + rows[after], place - before))
        before, after, fraction = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
        found.append(Regular(before, after, fraction.astype(np.float32)))
        begin += len(own)
    return tuple(found)


def _samples(simulator: Simulator) -> dict[str, Any]:
    lengths = [len(times) for times in simulator.times]
    return {"summary": functools.partial(samples, rows=_rows(np.split(simulator.there, np.cumsum(lengths)[:-1])))}


def _cross_correlation(simulator: Simulator) -> dict[str, Any]:
    controls = []
    for episode, times in enumerate(simulator.times):
        applied = simulator.held(episode, np.linspace(times[0], times[-1], len(times)))
        deviation = applied.std(axis=0)
        controls.append(((applied - applied.mean(axis=0)) / np.where(deviation > 0, deviation, 1)).astype(np.float32))
    episodes = regular(simulator.times, simulator.there)
    return {"summary": functools.partial(cross_correlation, episodes=episodes, controls=tuple(controls))}


def _spectrum(simulator: Simulator) -> dict[str, Any]:
    if (least := min(len(times) for times in simulator.times)) < LEAST:
        raise ValueError(f"summary: spectrum: expected at least {LEAST} rows in each episode, got {least}")
    episodes = regular(simulator.times, simulator.there)
    variances = [np.var(own.of(np.asarray(simulator.observation, float)), axis=0) for own in episodes]
    floors = tuple((_FLOOR * np.where(own > 0, own, 1)).astype(np.float32) for own in variances)
    return {"summary": functools.partial(spectrum, episodes=episodes, floors=floors)}


OWN: Mapping[str, Callable[[Simulator], dict[str, Any]]] = {
    "samples": _samples,
    "cross-correlation": _cross_correlation,
    "spectrum": _spectrum,
    # All rows, and the setting that has an embedding see them, which `--embedding` may still change.
    "learnt": lambda simulator: {"summary": "identity", "settings": {"embedding": "series"}},
}
"""Functions that make a task's fields, by name."""


def fields(summary: str | Summary, simulator: Simulator) -> dict[str, Any]:
    """The fields `summary`, and perhaps `settings`, of a simulator's task.

    Args:
        summary: a name of `OWN` or of `jaxlfi.tasks.summaries.SUMMARIES`, or a function of a trajectory.
        simulator: of the recordings.

    Raises:
        ValueError: for an unknown name, and recordings that are too short, in one line.
    """
    if not isinstance(summary, str):
        return {"summary": summary}
    known = sorted({*OWN, *summaries.SUMMARIES})
    if summary not in known:
        raise ValueError(f"summary: expected one of {', '.join(known)}, got {summary!r}")
    return OWN[summary](simulator) if summary in OWN else {"summary": summary}


def _rows(there: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Rows at about equal intervals of consecutive episodes, including the first and the last.

    If signals have clocks of their own, only rows with samples of all signals are taken, if there are enough.

    Args:
        there: whether there is a sample, shape [T, C] for each episode.
    """
    rows, begin = [], 0
    of_many = int(np.clip(NUMBERS // (len(there) * there[0].shape[1]), 3, SAMPLES))
    most = SAMPLES if len(there) <= FEW else of_many
    for own in there:
        known = np.flatnonzero(own.all(axis=1))
        if len(known) < min(most, len(own)):
            known = np.arange(len(own))
        wanted = np.linspace(known[0], known[-1], min(most, len(own)))
        nearest = known[np.argmin(np.abs(known[:, None] - wanted.round()), axis=0)]
        rows += [begin + int(row) for row in np.unique(nearest)]
        begin += len(own)
    return tuple(rows)


def _constant(values: Float[Array, "moments signals"]) -> Array:
    return jnp.all(values == values[0], axis=0)


def _standardised(values: Float[Array, "moments signals"]) -> Float[Array, "moments signals"]:
    """Of mean 0 and variance 1; 0 where a signal is constant."""
    constant = _constant(values)
    deviation = jnp.where(constant, 1.0, jnp.std(values, axis=0))
    return jnp.where(constant, 0.0, (values - jnp.mean(values, axis=0)) / deviation)
