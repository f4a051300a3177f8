"""Misspecification: whether an observation resembles anything that was simulated.

A network that has never seen anything like an observation extrapolates, and its posterior looks like any other. So the
observation is compared with the simulations that a run has made anyway, in three ways: a summary that never varies must
be observed at its value; no summary may lie far outside the range of the simulations; and all together must be as close
to the nearest simulation as simulations are to one another.

Each is a test whose false alarms are bounded by symmetry: an observation from the model is one more simulation, and the
same number is computed for every simulation as if it were the observation. The simulations of later rounds lie about
the posterior, and so about the observation, which makes it a typical one among them.
"""

import dataclasses
import statistics
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

LEVEL = 0.001
"""p-value up to which a finding is reported, in the test of single summaries and in that of all together."""
MIN_SIMULATIONS = 20
"""Number of simulations below which nothing is reported but a constant that differs."""
EXTREMES = 5
"""Number of extreme simulations from which the decay of a tail is estimated."""
ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Relative difference of two numbers that single precision does not resolve."""
GRAIN = 0.05
"""Smallest spread assumed for a tail, in robust standard deviations: simulations that tie have none."""
JOINT_ROWS = 1000
"""Largest number of simulations compared jointly, evenly taken from all: the time grows with its square."""
NEIGHBOURS = 20
"""Number of most similar simulations that the joint finding is compared with."""
RECORDS = 8
"""Smallest number of consecutive records that are treated as a series."""
UNITS = "is it in the simulator's units, and could the box be wrong?"
ORDER = "does it begin as simulations do, with its records in the same order and at the same interval?"
NAMED = 3
"""Largest number of summaries or channels that are named."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One respect in which an observation is unlike the simulations.

    Attributes:
        name: of the summary or channel.
        kind: "constant" (it never varies in simulations), "range" (it lies far outside of all simulations) or "joint"
            (all numbers together do; this one differs most from those of the most similar simulations).
        observed: its value, twice; smallest and largest value of a channel.
        low: smallest value of these simulations.
        high: largest value.
        p_value: of the test; 0 for a constant.
        text: in words.
    """

    name: str
    kind: str
    observed: tuple[float, float]
    low: float
    high: float
    p_value: float
    text: str

    def __str__(self) -> str:
        return self.text


@dataclasses.dataclass(frozen=True)
class _Column:
    """A number that observation and simulations are compared by: a summary, a record, or a feature of a channel."""

    name: str  # its name in a sentence
    channel: int | None = None  # that it belongs to; None for a summary
    record: bool = False  # whether it is one record of that channel
    log: bool = False  # whether it is compared as its logarithm
    advice: str = UNITS  # a possible cause, as a question


def unlike(
    x: ArrayLike, simulations: ArrayLike, names: Sequence[str] | None = None, channels: Sequence[str] = ()
) -> list[Finding]:
    """Find how an observation is unlike all simulations; nothing if the model could have produced it.

    Each summary by itself is compared with the range of the simulations, and what lies beyond it with how fast the
    simulations thin out towards its end: with tails like those of a power or lighter, an observation from the model
    lies so far out in one of 1,000 cases (`LEVEL`), over all summaries together. All together are compared by the
    distance from the nearest simulation among the ranks of all summaries, whitened, so that a combination that never
    occurs is seen where each number does. Simulations in which a summary has one value only leave no room for another.

    For a series, `channels` names its columns. Then the standard deviation of each channel over time, and its steps
    from record to record in units of that, are also compared: a series in another unit or in another order has
    values that occur, in a combination that does not.

    Where simulations of several rounds are given, those about the posterior make an observation from the model a
    typical one among them. What a support that was wrong at first did not cover, but later rounds did, is not reported.

    Args:
        x: observed summary, shape [S].
        simulations: shape [N, S]; rows that are not finite are left out.
        names: of the summaries; by default x_1 to x_S.
        channels: of a series of T records, shape [T C] row by row, the names of its C channels; none for summaries.

    Returns:
        The findings, the clearest first: at most three of summaries by themselves, or one of all together.

    Raises:
        ValueError: for shapes that do not fit, or an observation that is not finite.

    Example:
        >>> simulated = np.random.default_rng(0).normal(size=(1000, 2)) * [1.0, 0.001]
        >>> [finding] = unlike([0.3, 1.2], simulated, ["position", "current"])
        >>> finding.name, finding.kind, str(finding)[:50]
        ('current', 'range', 'current is 1.2, all 1,000 simulations lie between ')
        >>> unlike([0.3, 0.0012], simulated)
        []
    """
    precision = np.finfo(np.promote_types(np.asarray(simulations).dtype, np.float32)).eps
    x, simulations = np.asarray(x, np.float64), np.asarray(simulations, np.float64)
    if simulations.ndim != 2 or x.shape != simulations.shape[1:] or not np.isfinite(x).all():
        raise ValueError(
            f"x, simulations: expected a finite observation [S] and simulations [N, S], got {list(x.shape)} and "
            f"{list(simulations.shape)}"
        )
    if channels and (x.size % len(channels)):
        raise ValueError(f"channels: expected their number to divide that of the {x.size} numbers, got {len(channels)}")
    if names is not None and len(names) != x.size:
        raise ValueError(f"names: expected one for each of the {x.size} summaries, got {len(names)}")
    simulations = simulations[np.isfinite(simulations).all(axis=1)]
    if len(simulations) < 2:
        return []
    columns = _columns(x.size, names, channels)
    low, high = simulations.min(axis=0), simulations.max(axis=0)
    largest = np.maximum(np.abs(low), np.abs(high))
    constant, reach = high - low <= 4 * precision * largest, ROUNDING * largest
    found = [
        _constant(columns[j], x[j], low[j], high[j], len(simulations))
        for j in np.flatnonzero(constant & ((x < low - reach) | (x > high + reach)))
    ]
    varying = np.flatnonzero(~constant)
    if len(simulations) < MIN_SIMULATIONS or not len(varying):
        return _shortened(found)
    both = np.concatenate([x[None], simulations])
    columns = [columns[j] for j in varying]
    if channels:
        features, more = _series(both.reshape(len(both), -1, len(channels)), channels)
        both, columns = np.concatenate([both[:, varying], features], axis=1), columns + more
    else:
        both = both[:, varying]
    found += _outside(both, columns)
    return _shortened(found) or _joint(both, columns)


def _columns(size: int, names: Sequence[str] | None, channels: Sequence[str]) -> list[_Column]:
    """What the numbers of a summary are called; those of a series by channel and record."""
    if channels:
        count = len(channels)
        name = lambda j: f"{channels[j % count]} at record {j // count + 1}"
        return [_Column(name(j), j % count, record=True, advice=ORDER) for j in range(size)]
    return [_Column(name) for name in names or [f"x_{j + 1}" for j in range(size)]]


def _series(records: np.ndarray, channels: Sequence[str]) -> tuple[np.ndarray, list[_Column]]:
    """Logarithms of each channel's standard deviation and of its mean square step over its variance, [N, 2 C].

    Channels that do not vary over time in all simulations and the observation are left out, and so are short series.
    """
    if records.shape[1] < RECORDS:
        return np.zeros((len(records), 0)), []
    # Divided by the largest value first, so that squares neither overflow nor vanish.
    centred = records - records.mean(axis=1, keepdims=True)
    largest = np.abs(centred).max(axis=1, keepdims=True)
    centred = centred / np.where(largest > 0, largest, 1.0)
    variance, step = np.mean(centred**2, axis=1), np.mean(np.diff(centred, axis=1) ** 2, axis=1)
    usable = np.flatnonzero((largest[:, 0] > ROUNDING * np.abs(records).max(axis=1)).all(axis=0))
    deviation = 0.5 * np.log(variance[:, usable]) + np.log(largest[:, 0, usable])
    steps = np.log(np.maximum(step[:, usable], ROUNDING**2) / variance[:, usable])
    named = [_Column(f"the standard deviation of {channels[c]} over time", c, log=True) for c in usable]
    named += [
        _Column(f"the mean square step of {channels[c]}, over its variance,", c, log=True, advice=ORDER) for c in usable
    ]
    return np.concatenate([deviation, steps], axis=1), named


def _constant(column: _Column, observed: float, low: float, high: float, count: int) -> Finding:
    text = (
        f"{column.name} is {observed:.6g}, all {count:,} simulations have {low:.6g}: no parameters give that; is it "
        "the same quantity?"
    )
    return Finding(column.name, "constant", (observed, observed), low, high, 0.0, text)


def _outside(both: np.ndarray, columns: Sequence[_Column]) -> list[Finding]:
    """Findings of columns whose observed value lies far outside the range of the simulations.

    Args:
        both: the observation, then the simulations, shape [1 + N, F].
        columns: F of them.
    """
    # Records and a channel's overall features are two families, so that many records do not drown the few features.
    whole = np.array([column.log for column in columns])
    sizes = np.where(whole, whole.sum(), (~whole).sum()) * len(set(whole))
    p_values = _tail_p_values(both, sizes)
    if not (reported := np.flatnonzero(p_values <= LEVEL)).size:
        return []
    count = len(both) - 1
    order = reported[np.argsort(p_values[reported], kind="stable")]
    found: list[Finding] = []
    seen: set[int] = set()
    for j in order:
        channel = columns[j].channel
        if channel is None:
            found.append(_beyond(columns[j], both[:, j], p_values[j], count))
        elif channel not in seen:
            seen.add(channel)
            own = [i for i, column in enumerate(columns) if column.channel == channel]
            found.append(_channel(both, columns, own, p_values, count))
    return found


def _beyond(column: _Column, values: np.ndarray, p_value: float, count: int, more: str = "") -> Finding:
    """The finding of one column, of which `values` are those of the observation and of the simulations."""
    seen, low, high = float(values[0]), float(values[1:].min()), float(values[1:].max())
    if column.log:
        seen, low, high = (float(np.exp(value)) for value in (seen, low, high))
    digits = 4 if len({f"{value:.4g}" for value in (seen, low, high)}) == 3 else 8
    text = (
        f"{column.name} is {seen:.{digits}g}{more}, all {count:,} simulations lie between {low:.{digits}g} and "
        f"{high:.{digits}g}: {column.advice}"
    )
    return Finding(column.name, "range", (seen, seen), low, high, float(p_value), text)


def _channel(both: np.ndarray, columns: Sequence[_Column], own: list[int], p_values: np.ndarray, count: int) -> Finding:
    """One finding of a channel: its range, else its spread or its steps, else a record."""
    records = [j for j in own if columns[j].record]
    reported = [j for j in own if p_values[j] <= LEVEL]
    clearest = min(reported, key=lambda j: (columns[j].record, p_values[j]))
    outside = [j for j in reported if columns[j].record]
    if outside:
        name = columns[outside[0]].name.partition(" at record ")[0]
        values = both[:, records]
        start, end, low, high = values[0].min(), values[0].max(), values[1:].min(), values[1:].max()
        if start < low or end > high:
            text = (
                f"{name} goes from {start:.4g} to {end:.4g}, in all {count:,} simulations from {low:.4g} to "
                f"{high:.4g}: {UNITS}"
            )
            return Finding(name, "range", (start, end), low, high, float(min(p_values[outside])), text)
    others = len(outside) - 1
    more = f" (and {others} more of {len(records)} records)" if columns[clearest].record and others else ""
    return _beyond(columns[clearest], both[:, clearest], p_values[clearest], count, more)


def _tail_p_values(both: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """How probable so far a value beyond all simulations is, for each column, over all columns together; 1 inside.

    The logarithm of what exceeds the k-th largest of a power's tail is exponential, so that the distance of a new
    largest from the last, over that of the last from the k-th before, has a known distribution. Logarithms are those of
    asinh. A value is reported only if few simulations lie as far beyond the others, in any column, so that false alarms
    are bounded also for tails that are not like that: else its p-value is 1.

    Args:
        both: the observation, then the simulations, shape [1 + N, F].
        sizes: how many columns each one's p-value is to stand for, shape [F]; the sum of their inverses is 1.

    Returns:
        Shape [F].
    """
    count = len(both) - 1
    centred = both - np.median(both[1:], axis=0)
    scale = 1.4826 * np.median(np.abs(centred[1:]), axis=0)
    largest = np.abs(centred[1:]).max(axis=0)
    largest = np.where(largest > 0, largest, 1.0)
    deviation = largest * np.sqrt(np.mean((centred[1:] / largest) ** 2, axis=0))
    z = np.arcsinh(centred / np.where(scale > 0, scale, np.where(deviation > 0, deviation, 1.0)))
    extremes = min(EXTREMES, count // 4)
    order = np.sort(z[1:].T, axis=1).T
    top = np.concatenate([order[: -extremes - 3 : -1], -order[: extremes + 2]], axis=1)  # both ends, as upper ones
    z = np.concatenate([z, -z], axis=1)
    observed = _extrapolated(z[0] - top[0], top[0] - top[extremes], extremes, count)
    simulated = _extrapolated(top[0] - top[1], top[1] - top[1 + extremes], extremes, count)
    rows = np.argmax(z[1:], axis=0)
    p_values = np.where(z[0] > top[0], np.minimum(1.0, 2 * np.tile(sizes, 2) * observed), 1.0)
    for j in np.flatnonzero(p_values <= LEVEL):
        as_far = len(set(rows[simulated <= observed[j]]))
        if 1 + as_far > max(1.0, LEVEL * (count + 1)):
            p_values[j] = 1.0
    return p_values.reshape(2, -1).min(axis=0)


def _extrapolated(gap: np.ndarray, spread: np.ndarray, extremes: int, count: int) -> np.ndarray:
    """Probability of a new largest value that exceeds the last by at least this gap, where tails are exponential.

    Args:
        gap: between the two, shape [F].
        spread: between the last largest and the one `extremes` places below, shape [F].
        extremes: k. The gap is an exponential variable of rate 1, the spread a sum of those with the rates 2 to k + 1.
        count: number of values without the new one.
    """
    ratio = np.maximum(gap, 0.0) / np.maximum(spread, GRAIN)
    return np.prod(1 / (1 + ratio[:, None] / np.arange(2, extremes + 2)), axis=1) / (count + 1)


def _joint(both: np.ndarray, columns: Sequence[_Column]) -> list[Finding]:
    """The finding that the columns together are unlike all simulations, if they are."""
    if len(columns) < 2:
        return []
    count = len(both) - 1
    rows = np.concatenate([[0], 1 + np.unique(np.linspace(0, count - 1, min(count, JOINT_ROWS)).astype(int))])
    both = both[rows]
    points = _whitened_ranks(both)
    squares = np.sum(points**2, axis=1)
    distances = squares[:, None] + squares - 2 * points @ points.T
    np.fill_diagonal(distances, np.inf)
    near = 0.5 * np.log(np.maximum(distances.min(axis=1), np.finfo(float).tiny))
    others = np.sort(near[1:])[::-1]
    extremes = min(EXTREMES, len(others) // 4)
    gap, spread = near[:1] - others[:1], others[:1] - others[extremes]
    (p_value,) = _extrapolated(gap, spread, extremes, len(others))
    if gap[0] <= 0 or p_value > LEVEL:
        return []
    similar = both[np.argsort(distances[0])[:NEIGHBOURS]]
    middle, width = np.median(similar, axis=0), np.ptp(similar, axis=0)
    away = np.abs(both[0] - middle) / np.where(width > 0, width, np.ptp(both, axis=0))
    j = int(np.argmax(away))
    seen, low, high = both[0, j], similar[:, j].min(), similar[:, j].max()
    if columns[j].log:
        seen, low, high = np.exp([seen, low, high])
    text = (
        f"unlike all {count:,} simulations taken together (p {_at_most(p_value)}), though no number is by itself; "
        f"{columns[j].name} is {seen:.4g}, in the {len(similar)} most similar simulations {low:.4g} to {high:.4g}: "
        "shuffled, misaligned, or from another experiment?"
    )
    return [Finding(columns[j].name, "joint", (seen, seen), low, high, float(p_value), text)]


def _whitened_ranks(both: np.ndarray) -> np.ndarray:
    """Normal scores of each column's ranks, whitened by their correlations, which are shrunk, shape [N, min(N, F)]."""
    count, size = both.shape
    table = np.array([statistics.NormalDist().inv_cdf(i / (2 * count)) for i in range(1, 2 * count)])
    ranks = np.empty((size, count), int)
    for j, values in enumerate(np.ascontiguousarray(both.T)):
        order = np.sort(values)
        ranks[j] = np.searchsorted(order, values, "left") + np.searchsorted(order, values, "right")
    z = table[ranks.T - 1]  # midranks
    z = z / np.sqrt(np.maximum(np.mean(z**2, axis=0), np.finfo(float).tiny))
    shrinkage = size / (size + count)
    if size <= count:
        variance, axes = np.linalg.eigh(z.T @ z / count)
        return z @ axes / np.sqrt((1 - shrinkage) * variance + shrinkage)
    variance, axes = np.linalg.eigh(z @ z.T / count)
    variance = np.maximum(variance, 0.0)
    return axes * np.sqrt(count * variance / ((1 - shrinkage) * variance + shrinkage))


def _at_most(p_value: float) -> str:
    """A p-value in words, without digits that mean nothing."""
    exponent = int(np.ceil(np.log10(max(p_value, 1e-6))))
    return f"< {10.0**exponent:g}"


def _shortened(found: list[Finding]) -> list[Finding]:
    """The clearest few; the last of them says how many more there are."""
    if len(found) <= NAMED:
        return found
    more = len(found) - NAMED
    last = found[NAMED - 1]
    what = "others lie" if more > 1 else "other lies"
    return [*found[: NAMED - 1], dataclasses.replace(last, text=f"{last.text} ({more} {what} outside, too)")]
