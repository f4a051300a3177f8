"""What a run found, stated: each parameter with its intervals, and in sentences what a user wants to know next.

Everything is counted from the run's own draws, in natural units; nothing is said that was not measured on this run.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.io.run_summary import ParameterSummary, RunSummary

INNER, OUTER = (0.25, 0.75), (0.05, 0.95)
"""Levels between which half and 90 % of the draws lie."""
IDENTIFIED, WEAKLY = 0.5, 0.85
"""Standard deviation, relative to a uniform distribution's over the last box, below which a parameter is identified,
and below which it is so weakly."""
ALONG, LEANING = 0.05, 0.15
"""Draws lean on a bound where more than the second share of them lies within the first fraction of the width of it."""
MOVED = 0.05
"""Fraction of the width by which a bound has moved to be spoken of."""
OUTSIDE = 0.5
"""Share of the draws outside the first guess above which it was wrong."""
TOGETHER = 0.9
"""Correlation above which two parameters are not separately identifiable."""


def summarised(
    draws: Float[np.ndarray, "n dim"],
    space: Space,
    units: Sequence[str] | None,
    boxes: tuple[Support, Support, Support],
    truth: np.ndarray | None,
    heuristic: str,
) -> RunSummary:
    """The summary of a run.

    Args:
        draws: of its posterior, in natural units.
        space: names of the parameters, and which are inferred as logarithms.
        units: of the parameters, or None where they are not known.
        boxes: the first guess, the last box and Phi, in inference space.
        truth: in natural units, or None.
        heuristic: the name of what moved the box.
    """
    draws = np.asarray(draws, np.float64)
    inner = np.asarray(space.to_inference(draws), np.float64)
    parameters = tuple(
        _parameter(space, d, draws[:, d], inner[:, d], (units or [""] * space.dim)[d], boxes, truth)
        for d in range(space.dim)
    )
    guess, last, feasible = (space.box_to_natural(box) for box in boxes)
    sentences = [
        text
        for d, one in enumerate(parameters)
        for text in (
            _of_the_guess(one, draws[:, d], _bounds(guess, d), _bounds(last, d), heuristic),
            _of_its_bounds(one, *(_bounds(box, d) for box in (last, feasible))),
            _unconstrained(one),
        )
        if text
    ]
    pairs = itertools.combinations(range(space.dim), 2)
    sentences += filter(None, (_not_separate(space, parameters, inner, *pair) for pair in pairs))
    return RunSummary(parameters, tuple(sentences))


def _parameter(space: Space, d: int, draws, inner, unit: str, boxes, truth) -> ParameterSummary:
    levels = (*INNER, *OUTER)
    first, third, low, high = map(float, np.quantile(draws, levels))
    known = np.quantile(inner, OUTER)
    guess, last = (np.asarray(box.width, np.float64)[d] for box in boxes[:2])
    ratio = inner.std() / (last / math.sqrt(12))
    verdict = "identified" if ratio < IDENTIFIED else "weakly" if ratio < WEAKLY else "not at all"
    place = (inner - np.float64(boxes[1].low[d])) / last
    share = {"lower": np.mean(place < ALONG), "upper": np.mean(place > 1 - ALONG)}
    return ParameterSummary(
        name=space.names[d],
        unit=unit,
        median=float(np.median(draws)),
        central_50=(first, third),
        central_90=(low, high),
        narrower=float((OUTER[1] - OUTER[0]) * guess / max(known[1] - known[0], 1e-30)),
        verdict=verdict,
        leans=tuple(side for side in share if share[side] > LEANING),
        truth=None if truth is None else float(truth[d]),
        decimals=_decimals(draws),
    )


def _decimals(draws: np.ndarray) -> int:
    """The place of the digit that is as large as the Monte Carlo error of 5 % quantiles, 2.1 sd / sqrt(n)."""
    error = max(2.1 * draws.std() / math.sqrt(len(draws)), 1e-7 * np.abs(draws).max())  # or that of float32
    return -round(math.log10(error)) if 0 < error < math.inf else 6


def _bounds(box: Support, d: int) -> tuple[float, float]:
    return float(box.low[d]), float(box.high[d])


def _value(value: float, one: ParameterSummary) -> str:
    return f"{value:.3g}" + (f" {one.unit}" if one.unit else "")


def _of_the_guess(one: ParameterSummary, draws: np.ndarray, guess, last, heuristic: str) -> str:
    """Whether the first guess was wrong, where the box has been moved."""
    ends = zip(("lower", "upper"), guess, last, strict=True)
    shifted = [(side, now) for side, was, now in ends if abs(now - was) > MOVED * (guess[1] - guess[0])]
    if not shifted:
        return ""
    outside = np.mean((draws < guess[0]) | (draws > guess[1]))
    if outside > OUTSIDE:
        moved = " and ".join(f"its {side} bound to {_value(now, one)}" for side, now in shifted)
        return (
            f"The first guess of {guess[0]:.3g} to {_value(guess[1], one)} for {one.name} was wrong: {heuristic} moved "
            f"{moved}, and {_share(outside)} of the posterior is outside the guess."
        )
    moved = " and ".join(f"the {side} bound of {one.name} to {_value(now, one)}" for side, now in shifted)
    return f"{heuristic} moved {moved}; {_share(1 - outside)} of the posterior is within the first guess."


def _share(share: float) -> str:
    return "all" if share > 0.9995 else f"{share:.1%}"


def _of_its_bounds(one: ParameterSummary, last, feasible) -> str:
    """Where the posterior leans on a bound of the last box."""
    if one.verdict == "not at all" or not one.leans:
        return ""
    texts = []
    for side in one.leans:
        place = int(side == "upper")
        at_phi = math.isclose(last[place], feasible[place], rel_tol=1e-5)
        of = "the feasible domain's" if at_phi else "the box's"
        texts.append(f"{of} {side} bound, {_value(last[place], one)}")
    advice = "values beyond it were never tried"
    return f"The posterior of {one.name} leans on {' and '.join(texts)}: {advice}."


def _unconstrained(one: ParameterSummary) -> str:
    if one.verdict != "not at all":
        return ""
    return f"The observation does not constrain {one.name}: its posterior is about as wide as its box."


def _not_separate(space: Space, parameters, inner: np.ndarray, i: int, j: int) -> str:
    """Two parameters of which only one combination is well determined."""
    scale = inner[:, [i, j]].std(axis=0)
    if not np.all(scale > 0):
        return ""
    correlation = float(np.corrcoef(inner[:, i], inner[:, j])[0, 1])
    if abs(correlation) < TOGETHER or "not at all" in (parameters[i].verdict, parameters[j].verdict):
        return ""
    # The combination of least spread: theta_i - slope theta_j, along the long axis of the two.
    slope = math.copysign(scale[0] / scale[1], correlation)
    first, second = parameters[i].name, parameters[j].name
    if space.log[i] and space.log[j]:
        power = "" if abs(abs(slope) - 1) < 0.1 else f"^{abs(slope):.2g}"
        combination = f"{first} {'/' if slope > 0 else '*'} {second}{power}"
    else:
        combination = f"{space.labels[i]} {'-' if slope > 0 else '+'} {abs(slope):.2g} * {space.labels[j]}"
    return (
        f"{first} and {second} are not separately identifiable (correlation {correlation:.2f}): "
        f"only {combination} is well determined."
    )
