"""Finds the parameters, and combinations of them, that a recording informs, from derivatives of its signals.

Along a direction in which nothing that was measured changes, or so little that the box of the parameters says more,
an interval would be made up. Directions are compared in widths of the box, where all parameters have the same scale.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

LIKE_THE_BOX = 0.9
"""Width of a 90 % interval, as a fraction of the box's, from which on it says no more than the box does."""
PART = 0.1
"""How far a parameter may change in an uninformed direction, as a fraction of what changes most, and be informed."""
EXACT = 0.02
"""Exponents and weights this near to simple numbers are written as those."""
NORMAL = 1.6449
"""Half of a 90 % interval of a normal distribution, in standard deviations."""
_SIMPLE = (0.0, 0.5, 1.0, 2.0, 3.0)


def directions(
    jacobian: Float[np.ndarray, "rows dim"],
) -> tuple[Float[np.ndarray, " dim"], Float[np.ndarray, "dim dim"]]:
    """Orthogonal directions of the parameters, as rows, and by how much the residuals change along each.

    Args:
        jacobian: by parameters in widths of the box.
    """
    upper = np.linalg.qr(jacobian, mode="r")
    square = np.zeros((jacobian.shape[1], jacobian.shape[1]))
    square[: len(upper)] = upper
    _, sizes, rows = np.linalg.svd(square)
    return sizes, rows


def says_more(
    deviations: Float[np.ndarray, " directions"], rows: Float[np.ndarray, "directions dim"]
) -> Bool[np.ndarray, " directions"]:
    """Whether an interval along a direction is narrower than the box, of the parameter that changes most along it.

    Args:
        deviations: standard deviations along the directions, in widths of the box.
        rows: the directions.
    """
    return 2 * NORMAL * deviations * np.abs(rows).max(axis=1) < LIKE_THE_BOX


def untouched(uninformed: Float[np.ndarray, "directions dim"]) -> Bool[np.ndarray, " dim"]:
    """Which parameters next to nothing changes along any combination of some orthogonal directions."""
    onto = np.abs(uninformed.T @ uninformed)
    return np.diagonal(onto) < PART * np.maximum(onto.max(axis=1), 1e-12)


def sentences(
    names: Sequence[str],
    log: Sequence[bool],
    theta: Float[np.ndarray, " dim"],
    uninformed: Float[np.ndarray, "dim directions"],
    widths: Float[np.ndarray, " dim"],
) -> list[str]:
    """What a recording does not inform: single parameters, and what it does inform of several together.

    Args:
        names: of the parameters.
        log: which are inferred as logarithms.
        theta: the point, in natural units.
        uninformed: directions in inference space along which nothing changes.
        widths: of the box, in inference space.

    Example:
        >>> along = np.array([[1.0], [-1.0]])
        >>> sentences(["mass", "length"], [True, True], np.ones(2), along, np.ones(2))
        ['mass and length are not informed by this recording one by one, only mass * length.']
    """
    rows = uninformed.T / widths
    rows = _reduced(np.where(untouched(rows), 0.0, rows))
    found = []
    for group in _groups(rows):
        own = rows[np.ix_([row for row in range(len(rows)) if rows[row, group].any()], group)]
        several = [names[d] for d in group]
        if len(own) == len(group):
            found += [f"{name} is not informed by this recording." for name in several]
            continue
        logs = np.array([log[d] for d in group])
        combined = _combinations(several, logs, theta[group], own * widths[group])
        both = f"{', '.join(several[:-1])} and {several[-1]}"
        found.append(f"{both} are not informed by this recording one by one, only {' and '.join(combined)}.")
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
    """What does not change along any of some directions: products of powers, or sums, whichever is the simpler one.

    A single point does not tell a product from a sum of parameters that are equal there: a product is written then.
    """
    relative = uninformed / np.where(log, 1.0, np.where(theta != 0, theta, np.nan))
    powers = _complement(relative) if np.isfinite(relative).all() else None
    weights = _complement(uninformed * np.where(log, theta, 1.0))
    if powers is not None and (_simple(powers) or (log.any() and not _simple(weights))):
        return [_product(names, row) for row in powers]
    return [_sum(names, row) for row in weights]


def _simple(rows: np.ndarray) -> bool:
    return bool(np.isin(np.abs(rows), _SIMPLE).all())


def _complement(rows: np.ndarray) -> np.ndarray:
    """Simple vectors that are orthogonal to all rows, and span all that are."""
    scale = np.abs(rows).max(axis=0)
    _, sizes, right = np.linalg.svd(rows / scale)
    return _reduced(right[len(sizes) :] / scale)


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Rows of the same span, each with a 1 where all others are 0, and as many zeros as that gives."""
    taken: list[int] = []
    rows = np.array(rows, float)
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
        rows[np.abs(rows - sign * value) < EXACT] = sign * value
    return rows


def _product(names: Sequence[str], powers: np.ndarray) -> str:
    """As "a * b^2 / c"."""
    powers = 2 * powers if 0.5 in np.abs(powers) else powers
    powers = powers * (1.0 if powers[np.flatnonzero(powers)[0]] > 0 else -1.0)
    power = lambda name, value: name if value == 1 else f"{name}^{value:.2g}"
    above = " * ".join(power(name, value) for name, value in zip(names, powers, strict=True) if value > 0)
    below = "".join(f" / {power(name, -value)}" for name, value in zip(names, powers, strict=True) if value < 0)
    return above + below


def _sum(names: Sequence[str], weights: np.ndarray) -> str:
    """As "a + 2 * b - c"."""
    weights = weights * (1.0 if weights[np.flatnonzero(weights)[0]] > 0 else -1.0)
    text = ""
    for name, value in zip(names, weights, strict=True):
        if value:
            term = name if abs(value) == 1 else f"{abs(value):.3g} * {name}"
            text += f"{' + ' if value > 0 else ' - '}{term}" if text else term
    return text
