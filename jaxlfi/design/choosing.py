"""Choosing designs: evenly spread starts, a search from the best, and batches whose designs complement each other."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Float

from jaxlfi.design import evolution
from jaxlfi.design.regions import Region
from jaxlfi.design.simulations import CHUNK, simulated
from jaxlfi.tasks.task import Task

RATED = 300
"""Default number of designs rated for each experiment."""
STARTS = 0.3
"""Fraction of them that is spread over all designs."""
TOLERANCE = 0.05
"""Default largest fraction of draws for which a chosen experiment may fail."""
SAFETY_DRAWS, SAFETY_DRAWS_ON_HOST = 64, 32
"""Number of draws of the inflated posterior that safety is judged by, in JAX and outside it."""
FIRST_ON_HOST = 8
"""Number of draws simulated first outside JAX: a design that already fails too often for these gets no others."""
REFUSED = -1e6
"""Value of a design that fails too often, times one plus the fraction of draws for which it fails."""
APART = 0.15
"""Smallest distance between listed designs on the unit cube, divided by the square root of its dimension."""
STEP = 0.2
"""Initial step size of a search, in widths of the bounds."""
FINER = 0.05
"""Initial step size for choosing a design of a batch again, given the others."""


class Rater(Protocol):
    """Rates designs: `jaxlfi.design.fisher.FisherRater`, `jaxlfi.design.contrastive.ContrastiveRater`."""

    @property
    def regions(self) -> tuple[Region, ...]:
        """The regions to average over, the posterior's first."""

    @property
    def task(self) -> Task:
        """The task of one experiment, with a design."""

    @property
    def key(self) -> jax.Array:
        """The random key of the simulations."""

    @property
    def ceiling(self) -> float:
        """Upper limit of the value, in bits."""

    def evidence(self, designs: np.ndarray, slot: int = 0) -> tuple[np.ndarray, ...]:
        """The evidence of experiments: arrays with a leading axis of designs, which add up over experiments."""

    def precision(self, designs: np.ndarray, slot: int = 0) -> np.ndarray:
        """Fisher information of designs in the posterior's region, shape [M, N, D, D]."""

    def terms(self, evidence: tuple[np.ndarray, ...]) -> list[np.ndarray]:
        """The value of each design at each parameter vector, region by region."""


@dataclasses.dataclass(frozen=True, eq=False)
class Rated:
    """Designs with their values.

    Attributes:
        designs: the designs' variables, shape [M, K].
        value: expected information in bits, given the experiments chosen already, shape [M].
        error: Monte Carlo standard error of the value, shape [M].
        failing: fraction of draws for which each design fails, shape [M].
    """

    designs: Float[np.ndarray, "designs k"]
    value: Float[np.ndarray, " designs"]
    error: Float[np.ndarray, " designs"]
    failing: Float[np.ndarray, " designs"]

    def __len__(self) -> int:
        return len(self.designs)

    def rows(self, places: Any) -> "Rated":
        """The designs at these places."""
        return Rated(*(getattr(self, field.name)[places] for field in dataclasses.fields(self)))

    def joined(self, other: "Rated") -> "Rated":
        """These designs, followed by the others."""
        names = [field.name for field in dataclasses.fields(self)]
        return Rated(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclasses.dataclass(frozen=True, eq=False)
class Chosen:
    """The result of a search.

    Attributes:
        batch: the experiments to make; `value` is what each adds to those before it.
        together: expected information of all of them, in bits, and its Monte Carlo error.
        rated: all designs rated for the first experiment, each by itself.
        spread: number of these, counted from the first, that were spread over all designs.
    """

    batch: Rated
    together: tuple[float, float]
    rated: Rated
    spread: int


def rate(
    rater: Rater,
    designs: Float[np.ndarray, "designs k"],
    slot: int = 0,
    given: tuple[np.ndarray, ...] | None = None,
    tolerance: float = TOLERANCE,
    failing: np.ndarray | None = None,
) -> Rated:
    """Rate designs; refused designs are not simulated any further.

    Args:
        rater: rater of the chosen method.
        designs: the designs' variables, shape [M, K].
        slot: place in a batch; each place has its own noise.
        given: evidence of the other experiments that will be made.
        tolerance: largest fraction of draws for which a design may fail; designs that fail more often are refused.
        failing: fraction of draws for which each design fails, if it is known.
    """
    designs = np.asarray(designs, float)
    failing = failures(rater, designs, tolerance) if failing is None else failing
    value, error = REFUSED * (1 + failing), np.zeros(len(designs))
    fine = failing <= tolerance
    if fine.any():
        value[fine], error[fine] = _averages(rater, _given(rater.evidence(designs[fine], slot), given))
        if given is not None:
            value[fine] -= _averages(rater, given)[0]
    return Rated(designs, value, error, failing)


def failures(rater: Rater, designs: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """Fraction of draws of the inflated posterior for which each design fails or is unsafe, shape [M].

    Args:
        rater: rater of the chosen method.
        designs: the designs' variables, shape [M, K].
        tolerance: fraction of all draws. Outside JAX, a design that fails for more than this among the first draws is
            not simulated for the rest, and its fraction is that of the first draws.
    """
    key = jax.random.fold_in(jax.random.clone(rater.key), 0x5AFE)
    if not rater.task.on_host:
        return 1 - simulated(key, rater.task, rater.regions[0].draws[:SAFETY_DRAWS], designs).fine.mean(axis=1)
    key_first, key_rest = jax.random.split(key)
    draws = rater.regions[0].draws[:SAFETY_DRAWS_ON_HOST]
    first = simulated(key_first, rater.task, draws[:FIRST_ON_HOST], designs).fine
    failing = 1 - first.mean(axis=1)
    places = np.flatnonzero((~first).sum(axis=1) <= tolerance * len(draws))
    if len(places):
        rest = simulated(key_rest, rater.task, draws[FIRST_ON_HOST:], designs[places]).fine
        failing[places] = 1 - np.concatenate([first[places], rest], axis=1).mean(axis=1)
    return failing


def choose(
    rater: Rater,
    rng: np.random.Generator,
    count: int = 1,
    rated: int = RATED,
    tolerance: float = TOLERANCE,
    advanced: Callable[[int], None] = lambda designs: None,
) -> Chosen:
    """The most valuable designs, for one experiment or a batch of them.

    The first is the best by itself, and each of the others is the best given those before it. This reaches at least
    63 % of the best batch's value if information has diminishing returns (Nemhauser, Wolsey and Fisher 1978). Then each
    is chosen again, given all others, and replaced if the new one is better.

    Args:
        rater: rater of the chosen method, for a task with a design.
        rng: random number generator of the search.
        count: number of experiments.
        rated: approximate number of designs rated for each experiment.
        tolerance: largest fraction of draws for which an experiment may fail.
        advanced: called with the number of designs rated since its last call.

    Raises:
        ValueError: if all designs fail too often.
    """
    task = rater.task
    starts = spread(task, int(np.ceil(STARTS * rated)), rng)
    failing = _remembered(rater, tolerance)
    tried: Rated | None = None
    batch: list[Rated] = []
    evidence: list[tuple[np.ndarray, ...]] = []
    for slot in range(count):
        total = _total(evidence)
        judge = _judge(rater, failing, slot, total, tolerance, advanced)
        first, others = _search(judge, task, starts, rng, rated)
        if tried is None:
            tried = first.joined(others)
        _require_some(first, others, tolerance)
        batch.append(_best(first.joined(others)))
        evidence.append(rater.evidence(batch[-1].designs, slot))
    for slot in range(count if count > 1 else 0):
        rest = _total(evidence[:slot] + evidence[slot + 1 :])
        judge = _judge(rater, failing, slot, rest, tolerance, advanced)
        found = _climb(judge, task, batch[slot].designs[0], FINER, rated // 3, rng)
        better = _best(found.joined(judge(batch[slot].designs)))
        if not np.array_equal(better.designs, batch[slot].designs):
            batch[slot], evidence[slot] = better, rater.evidence(better.designs, slot)
    assert tried is not None
    value, error = _averages(rater, _total(evidence) or evidence[0])
    return Chosen(_in_order(rater, batch, evidence, tolerance), (float(value[0]), float(error[0])), tried, len(starts))


def steps(count: int, rated: int) -> int:
    """The approximate number of designs that `choose` rates."""
    return count * rated + (count * (rated // 3) if count > 1 else 0)


def spread(task: Task, count: int, rng: np.random.Generator) -> Float[np.ndarray, "designs k"]:
    """Designs that fill the bounds evenly (a scrambled Sobol sequence), the nominal one first."""
    from scipy.stats import qmc  # imported here, as it would be a quarter of jaxlfi's import time

    size = len(task.design.variables)
    power = int(np.ceil(np.log2(max(count - 1, 1))))
    points = qmc.Sobol(size, rng=rng).random_base2(power)[: max(count - 1, 1)]
    return np.concatenate([np.array([task.design.nominal]), task.design.of_unit(points)])


def distinct(task: Task, rated: Rated, count: int) -> Iterator[int]:
    """Indices of the best designs, each at some distance from those before."""
    units = task.design.to_unit(rated.designs)
    kept: list[int] = []
    far = APART * np.sqrt(units.shape[1])
    for place in np.argsort(-rated.value, kind="stable"):
        if all(np.linalg.norm(units[place] - units[other]) > far for other in kept):
            kept.append(int(place))
            yield int(place)
        if len(kept) == count:
            return


def _remembered(rater: Rater, tolerance: float) -> Callable[[np.ndarray], np.ndarray]:
    """`failures`, but simulated only once for each design."""
    known: dict[bytes, float] = {}

    def failing(designs: np.ndarray) -> np.ndarray:
        if len(new := [one for one in designs if one.tobytes() not in known]):
            known.update(zip((one.tobytes() for one in new), failures(rater, np.stack(new), tolerance), strict=True))
        return np.array([known[one.tobytes()] for one in designs])

    return failing


def _judge(
    rater: Rater, failing: Callable, slot: int, given: Any, tolerance: float, advanced: Callable
) -> Callable[[np.ndarray], Rated]:
    def judge(designs: np.ndarray) -> Rated:
        parts = []
        for first in range(0, len(designs), CHUNK):
            part = np.asarray(designs[first : first + CHUNK], float)
            parts.append(rate(rater, part, slot, given, tolerance, failing(part)))
            advanced(len(part))
        result = parts[0]
        for other in parts[1:]:
            result = result.joined(other)
        return result

    return judge


def _search(judge: Callable, task: Task, starts: np.ndarray, rng: np.random.Generator, rated: int):
    """The rated starts, and all that two searches tried: from the best start, and from the best one apart from it."""
    first = judge(starts)
    left = max(rated - len(starts), 0) // 2
    others = [_climb(judge, task, first.designs[place], STEP, left, rng) for place in distinct(task, first, 2)]
    found = others[0]
    for other in others[1:]:
        found = found.joined(other)
    return first, found


def _climb(judge: Callable, task: Task, start: np.ndarray, step: float, rated: int, rng: np.random.Generator) -> Rated:
    tried: list[Rated] = []

    def objective(units: np.ndarray) -> np.ndarray:
        tried.append(judge(task.design.of_unit(units)))
        return tried[-1].value

    generations = max(rated // CHUNK, 1)
    evolution.maximise(rng, objective, task.design.to_unit(start), step, generations, CHUNK)
    found = tried[0]
    for other in tried[1:]:
        found = found.joined(other)
    return found


def _best(rated: Rated) -> Rated:
    return rated.rows([int(np.argmax(rated.value))])


def _in_order(rater: Rater, batch: list[Rated], evidence: list, tolerance: float) -> Rated:
    """A batch in greedy order: each design adds most to those before it, and its value is what it adds."""
    left = list(range(len(batch)))
    done: list[int] = []
    ordered: list[Rated] = []
    while left:
        given = _total([evidence[place] for place in done])
        values = [_averages(rater, _given(evidence[place], given)) for place in left]
        before = 0.0 if given is None else _averages(rater, given)[0]
        place = left.pop(int(np.argmax([value[0] for value, _ in values])))
        value, error = _averages(rater, _given(evidence[place], given))
        ordered.append(Rated(batch[place].designs, value - before, error, batch[place].failing))
        done.append(place)
    found = ordered[0]
    for other in ordered[1:]:
        found = found.joined(other)
    return found


def _require_some(first: Rated, others: Rated, tolerance: float) -> None:
    failing = np.concatenate([first.failing, others.failing])
    if failing.min() > tolerance:
        raise ValueError(
            f"design: expected experiments that fail for at most {tolerance:.0%} of the posterior, but the safest of "
            f"{len(failing)} fails for {failing.min():.0%}"
        )


def _total(evidence: list) -> tuple[np.ndarray, ...] | None:
    """The evidence of several experiments together; None for none."""
    return jax.tree.map(lambda *leaves: sum(leaves), *evidence) if evidence else None


def _given(evidence: tuple[np.ndarray, ...], given: tuple[np.ndarray, ...] | None) -> tuple[np.ndarray, ...]:
    return evidence if given is None else jax.tree.map(lambda own, other: own + other, evidence, given)


def _averages(rater: Rater, evidence: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean of the value over all regions, and its standard error, shape [M] each."""
    value, variance = 0.0, 0.0
    for region, terms in zip(rater.regions, rater.terms(evidence), strict=True):
        value = value + region.weight * terms.mean(axis=1)
        variance = variance + region.weight**2 * terms.var(axis=1, ddof=1) / terms.shape[1]
    return np.asarray(value), np.sqrt(np.asarray(variance))
