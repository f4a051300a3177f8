"""Which parameters, and which combinations of them, an observation determines: from draws, or from derivatives.

From a posterior's draws, `trade_offs` finds the parameters that vary together, and the combination that hardly varies.
If derivatives of the measurements are known, so are the uninformed directions, in which nothing changes, or so little
that the box of the parameters says more (`sentences`): an interval along them would be arbitrary. Directions are
compared in widths of the box, where all parameters have the same scale. Both report their findings in the same words.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

LIKE_THE_BOX = 0.9
"""Width of a 90 % interval, as a fraction of the box's, above which it says no more than the box."""
PART = 0.1
"""Change of a parameter along an uninformed direction, relative to the largest, up to which it counts as informed."""
EXACT = 0.02
"""Exponents and weights this near to simple numbers are written as those."""
NORMAL = 1.6449
"""Half of a 90 % interval of a normal distribution, in standard deviations."""
NEARLY = 0.1
"""The same for exponents that are estimated from draws."""
TOGETHER = 0.9
"""Correlation above which two parameters count as indistinguishable; several, if the remaining variance is as small."""
MOST = 4
"""Largest number of parameters of a combination: with more, it says nothing to a reader."""
DIGITS = 2
"""Significant digits of exponents and weights; more if a combination from draws is known too well for that."""
BLURRED = 1.2
"""Factor by which rounding of exponents or weights may widen a combination."""
_SIMPLE = (0.0, 0.5, 1.0, 2.0, 3.0)


@dataclasses.dataclass(frozen=True)
class TradeOff:
    """Parameters of which a combination is known much better than they are.

    Attributes:
        places: of the parameters, from 0.
        known: combinations that hardly vary, in words.
        unknown: the combinations that vary instead.
        ranges: median and central 90 % interval of each known combination.
        correlation: of two parameters, or of their logarithms where the combination is a product; else NaN.
        factor: how many times less the known combinations vary than if the parameters were independent.
    """

    places: tuple[int, ...]
    known: tuple[str, ...]
    unknown: tuple[str, ...]
    ranges: tuple[tuple[float, float, float], ...]
    correlation: float
    factor: float


def trade_offs(names: Sequence[str], draws: Float[np.ndarray, "n dim"]) -> list[TradeOff]:
    """Groups of parameters that draws of a posterior do not tell apart, with their known combinations.

    A combination is known if its variance is less than 1 - `TOGETHER` of what it would be if the parameters were
    independent: for two, if their correlation exceeds `TOGETHER`. Products of powers are sought among positive
    parameters, and weighted sums among all; for the same parameters, what varies less is reported.

    Args:
        names: of the parameters.
        draws: in natural units, shape [n, D].

    Example:
        >>> rng = np.random.default_rng(0)
        >>> mass, ratio = np.exp(rng.normal(0.0, 0.5, 1000)), np.exp(rng.normal(0.0, 0.02, 1000))
        >>> [found] = trade_offs(["stiffness", "mass"], np.stack([mass * ratio, mass], axis=1))
        >>> found.known, found.unknown, f"{found.correlation:.2f}"
        (('stiffness / mass',), ('stiffness * mass',), '1.00')
        >>> [tuple(round(value, 2) for value in values) for values in found.ranges]
        [(1.0, 0.97, 1.03)]
    """
    draws = np.asarray(draws, np.float64)
    positive = np.flatnonzero((draws > 0).all(axis=0))
    products = _together(names, np.log(draws[:, positive]), positive, _product, NEARLY)
    sums = _together(names, draws, np.arange(draws.shape[1]), _sum, EXACT)
    better = {one.places: one for one in sums}
    found = [max(one, better.get(one.places, one), key=lambda either: either.factor) for one in products]
    taken = {d for one in found for d in one.places}
    return [*found, *(one for one in sums if not taken & set(one.places))]


def _together(names, values: np.ndarray, places: np.ndarray, write, within: float) -> list[TradeOff]:
    """Groups of columns with combinations that hardly vary."""
    scale = values.std(axis=0)
    usable = np.flatnonzero(scale > 1e-12 * np.abs(values).max(axis=0, initial=0.0))
    if len(usable) < 2:
        return []
    values, places, scale = values[:, usable], places[usable], scale[usable]
    z = (values - values.mean(axis=0)) / scale
    variance, axes = np.linalg.eigh(z.T @ z / len(z))
    rows = _reduced(axes.T[variance < 1 - TOGETHER], EXACT)
    rows = np.where(np.abs(rows) < PART * np.abs(rows).max(axis=1, keepdims=True, initial=0.0), 0.0, rows)
    found = []
    for group in _groups(rows):
        own = rows[np.ix_([row for row in range(len(rows)) if rows[row, group].any()], group)]
        several = [names[places[d]] for d in group]
        known = _as_written(_reduced(own / scale[group], within), z[:, group] * scale[group])
        left = np.var(z[:, group] @ (known * scale[group]).T, axis=0) / np.sum((known * scale[group]) ** 2, axis=1)
        idle = ~known.any(axis=0)
        if len(group) > MOST or idle.any() or (left >= 1 - TOGETHER).any():  # not so once it is put into words
            continue
        units = 1.0 if write is _product else scale[group]  # logarithms have none
        other = _reduced(_complement(known * units) / units, within)
        pair = len(group) == 2
        found.append(
            TradeOff(
                places=tuple(int(d) for d in places[group]),
                known=tuple(write(several, row) for row in known),
                unknown=tuple(write(several, row) for row in _rounded(other, DIGITS)),
                ranges=tuple(_range(values[:, group], row, product=write is _product) for row in known),
                correlation=float(np.mean(z[:, group[0]] * z[:, group[1]])) if pair else np.nan,
                factor=float(1 / np.sqrt(max(left.max(), 1e-12))),
            )
        )
    return found


def _as_written(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Combinations [R, D] of values [n, D], rounded to the fewest digits that leave them known nearly as well."""
    every = [_rounded(rows, digits) for digits in range(DIGITS, 7)]
    deviations = np.stack([np.std(values @ one.T, axis=0) for one in every])
    enough = deviations <= BLURRED * np.std(values @ rows.T, axis=0)
    enough[-1] = True
    return np.stack([every[place][row] for row, place in enumerate(enough.argmax(axis=0))])


def _rounded(rows: np.ndarray, digits: int) -> np.ndarray:
    """Numbers rounded to a number of significant digits."""
    return np.vectorize(lambda value: float(f"{value:.{digits}g}"), otypes=[float])(rows)


def _range(values: np.ndarray, row: np.ndarray, product: bool) -> tuple[float, float, float]:
    """Median and central 90 % interval of a combination as it is written; for a product, `values` are logarithms."""
    combined = values @ (_powers(row) if product else _weights(row))
    median, low, high = map(float, np.quantile(np.exp(combined) if product else combined, (0.5, 0.05, 0.95)))
    return median, low, high


def unconstrained(name: str, more: str = "") -> str:
    """A sentence that says that nothing is known of a parameter."""
    return f"The observation does not constrain {name}{more}."


def not_separate(names: Sequence[str], known: Sequence[str], unknown: Sequence[str] = (), note: str = "") -> str:
    """A sentence that says that some parameters are known only in combination.

    Example:
        >>> not_separate(["stiffness", "mass"], ["stiffness / mass"])
        'stiffness and mass are not separately identifiable: only stiffness / mass is well determined.'
    """
    verb = lambda texts: "is" if len(texts) == 1 else "are"
    but = f"; {listed(unknown)} {verb(unknown)} not" if unknown else ""
    return (
        f"{listed(names)} are not separately identifiable{note}: only {listed(known)} {verb(known)} well "
        f"determined{but}."
    )


def trade_off_sentence(names: Sequence[str], one: TradeOff, each_known: bool = True) -> str:
    """A sentence on a trade-off, whose parameters are each known by themselves as well, or are not."""
    several = [names[d] for d in one.places]
    known = [f"{text} = {_shown(*values)}" for text, values in zip(one.known, one.ranges, strict=True)]
    note = "" if np.isnan(one.correlation) else f" (correlation {one.correlation:.2f})"
    if not each_known:
        return not_separate(several, known, one.unknown, note)
    verb, they = ("varies", "it") if len(one.known) == 1 else ("vary", "they")
    return (
        f"{listed(several)} trade off against each other{note}: {listed(known)} {verb} {one.factor:.2g} times less "
        f"than {they} would if the parameters were independent."
    )


def _shown(median: float, low: float, high: float) -> str:
    """A median with its interval, with as many digits as the interval's width needs.

    Example:
        >>> _shown(0.7213, 0.6804, 0.7651), _shown(1234.0, 1100.0, 1371.0), _shown(5.0, 5.0, 5.0)
        ('0.72 [0.68, 0.77]', '1234 [1100, 1371]', '5 [5, 5]')
    """
    if not high > low or not 1e-4 < abs(median) < 1e6:
        return f"{median:.3g} [{low:.3g}, {high:.3g}]"
    decimals = max(math.ceil(-math.log10((high - low) / 3)), 0)
    return f"{median:.{decimals}f} [{low:.{decimals}f}, {high:.{decimals}f}]"


def listed(texts: Sequence[str]) -> str:
    """Texts as "a", "a and b" or "a, b and c"."""
    return " and ".join(filter(None, (", ".join(texts[:-1]), *texts[-1:])))


def directions(
    jacobian: Float[np.ndarray, "rows dim"],
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, "dim dim"]]:
    """How much the residuals change along orthogonal directions of the parameters, and these directions as rows.

    Args:
        jacobian: derivatives by parameters in widths of the box.
    """
    upper = np.linalg.qr(jacobian, mode="r")
    square = np.zeros((jacobian.shape[1], jacobian.shape[1]))
    square[: len(upper)] = upper
    _, sizes, rows = np.linalg.svd(square)
    return sizes, rows


def says_more(
    deviations: Float[np.ndarray, " directions"], rows: Float[np.ndarray, "directions dim"]
) -> Bool[np.ndarray, " directions"]:
    """Whether an interval along a direction is narrower than the box for the parameter that changes most along it.

    Args:
        deviations: standard deviations along the directions, in widths of the box.
        rows: the directions.
    """
    return 2 * NORMAL * deviations * np.abs(rows).max(axis=1) < LIKE_THE_BOX


def untouched(uninformed: Float[np.ndarray, "directions dim"]) -> Bool[np.ndarray, " dim"]:
    """Which parameters hardly change along any combination of some orthogonal directions."""
    onto = np.abs(uninformed.T @ uninformed)
    return np.diagonal(onto) < PART * np.maximum(onto.max(axis=1), 1e-12)


def sentences(
    names: Sequence[str],
    log: Sequence[bool],
    theta: Float[np.ndarray, " dim"],
    uninformed: Float[np.ndarray, "dim directions"],
    widths: Float[np.ndarray, " dim"],
) -> list[str]:
    """What an observation does not determine: single parameters, and several except for a combination of them.

    Args:
        names: of the parameters.
        log: which are inferred as logarithms.
        theta: the point, in natural units.
        uninformed: directions in inference space along which nothing changes.
        widths: of the box, in inference space.

    Example:
        >>> along = np.array([[1.0], [-1.0]])
        >>> sentences(["mass", "length"], [True, True], np.ones(2), along, np.ones(2))
        ['mass and length are not separately identifiable: only mass * length is well determined.']
    """
    rows = uninformed.T / widths
    rows = _reduced(np.where(untouched(rows), 0.0, rows))
    found = []
    for group in _groups(rows):
        own = rows[np.ix_([row for row in range(len(rows)) if rows[row, group].any()], group)]
        several = [names[d] for d in group]
        if len(own) == len(group):
            found += [unconstrained(name) for name in several]
            continue
        logs = np.array([log[d] for d in group])
        combined = _combinations(several, logs, theta[group], own * widths[group])
        found.append(not_separate(several, combined))
    return found


def _groups(rows: np.ndarray) -> list[list[int]]:
    """Parameters that change together in some direction."""
    groups: list[set[int]] = []
    for row in rows:
        own = set(np.flatnonzero(row).tolist())
        apart = [group for group in groups if not group & own]
        groups = [*apart, own.union(*(group for group in groups if group & own))]
    return sorted(sorted(group) for group in groups)


def _combinations(names: Sequence[str], log: np.ndarray, theta: np.ndarray, uninformed: np.ndarray) -> list[str]:
    """What does not change along any of some directions: products of powers, or sums, whichever are simpler.

    A single point cannot distinguish a product from a sum of parameters that are equal there: it is then a product.
    """
    relative = uninformed / np.where(log, 1.0, np.where(theta != 0, theta, np.nan))
    powers = _complement(relative) if np.isfinite(relative).all() else None
    weights = _complement(uninformed * np.where(log, theta, 1.0))
    if powers is not None and (_simple(powers) or (log.any() and not _simple(weights))):
        return [_product(names, row) for row in _rounded(powers, DIGITS)]
    return [_sum(names, row) for row in _rounded(weights, DIGITS)]


def _simple(rows: np.ndarray) -> bool:
    return bool(np.isin(np.abs(rows), _SIMPLE).all())


def _complement(rows: np.ndarray) -> np.ndarray:
    """Simple vectors that span the orthogonal complement of the rows."""
    scale = np.abs(rows).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, sizes, right = np.linalg.svd(rows / scale)
    return _reduced(right[len(sizes) :] / scale)


def _reduced(rows: np.ndarray, within: float = EXACT) -> np.ndarray:
    """Rows with the same span, each with a 1 where all others are 0 (reduced row echelon form, up to order)."""
    rows = np.array(rows, float)
    taken: list[int] = []
    scale = np.abs(rows).max(axis=0, initial=1e-300)
    for row in range(len(rows)):
        free = np.abs(rows[row]) / np.where(scale > 0, scale, 1.0)
        free[taken] = 0.0
        column = int(np.argmax(free))
        taken.append(column)
        rows[row] /= rows[row, column]
        for other in range(len(rows)):
            if other != row:
                rows[other] -= rows[other, column] * rows[row]
    for value, sign in itertools.product(_SIMPLE, (1.0, -1.0)):
        rows[np.abs(rows - sign * value) < within] = sign * value
    return rows


def _product(names: Sequence[str], powers: np.ndarray) -> str:
    """A product written as "a * b^2 / c"."""
    powers = _powers(powers)
    power = lambda name, value: name if value == 1 else f"{name}^{value:.6g}"
    above = " * ".join(power(name, value) for name, value in zip(names, powers, strict=True) if value > 0)
    below = "".join(f" / {power(name, -value)}" for name, value in zip(names, powers, strict=True) if value < 0)
    return above + below


def _powers(powers: np.ndarray) -> np.ndarray:
    """Powers as they are written: no square roots, and the first one positive."""
    return _weights(2 * powers if 0.5 in np.abs(powers) else powers)


def _weights(weights: np.ndarray) -> np.ndarray:
    """Weights with the first one positive."""
    return weights * (1.0 if weights[np.flatnonzero(weights)[0]] > 0 else -1.0)


def _sum(names: Sequence[str], weights: np.ndarray) -> str:
    """A sum written as "a + 2 * b - c"."""
    weights = _weights(weights)
    text = ""
    for name, value in zip(names, weights, strict=True):
        if value:
            term = name if abs(value) == 1 else f"{abs(value):.6g} * {name}"
            text += f"{' + ' if value > 0 else ' - '}{term}" if text else term
    return text
