"""Summaries of each parameter from posterior draws: credible intervals, and conclusions in sentences.

Everything is computed from the run's own draws, in natural units; only what was measured on this run is stated.
Conclusions on the fit and on failures are in `jaxlfi.runs.account`.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxlfi.diagnostics.identifiability import listed, trade_off_sentence, trade_offs, unconstrained
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.io.run_summary import ParameterSummary, RunSummary, with_unit

INNER, OUTER = (0.25, 0.75), (0.05, 0.95)
"""Levels of the bounds of the central 50 % and 90 % intervals."""
IDENTIFIED, WEAKLY = 0.5, 0.85
"""Standard deviations below which a parameter is identified, and weakly identified, relative to that of a uniform
distribution over the first guess or the last box, whichever is wider."""
ALONG, LEANING = 0.05, 0.15
"""Fraction of the width next to a bound, and share of draws in there above which they lean on the bound."""
MOVED = 0.05
"""Smallest shift of a bound that is mentioned, as a fraction of the first guess's width."""
OUTSIDE = 0.5
"""Share of the draws outside the first guess above which it counts as wrong."""
ANOTHER = "Another experiment, in which {}: let the simulator return both, these measurements and the new ones."


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
        draws: posterior draws in natural units.
        space: names of the parameters, and which are inferred as logarithms.
        units: units of the parameters, or None if they are not known.
        boxes: the first guess, the last box and Phi, in inference space.
        truth: true parameters in natural units, or None.
        heuristic: name of the heuristic that moved the box.
    """
    draws = np.asarray(draws, np.float64)
    inner = np.asarray(space.to_inference(draws), np.float64)
    spans = [_span(space, box) for box in (boxes[0], boxes[2])]
    parameters = tuple(
        _parameter(space, d, draws[:, d], inner[:, d], (units or [""] * space.dim)[d], boxes, spans, truth)
        for d in range(space.dim)
    )
    together = trade_offs(space.names, draws)
    shared = {d for one in together for d in one.places}
    guess, last, feasible = (space.box_to_natural(box) for box in boxes)
    sentences, steps = [], []
    for d, one in enumerate(parameters):
        first, now, limits = ((float(box.low[d]), float(box.high[d])) for box in (guess, last, feasible))
        sentences += [
            _of_the_guess(one, draws[:, d], first, now, heuristic),
            _of_its_bounds(one, now, limits),
            _unconstrained(one, first, now, limits, heuristic, d in shared),
        ]
        steps += _wider(one, now, limits)
    known = [one.verdict == "identified" for one in parameters]
    for trade_off in together:
        sentences.append(trade_off_sentence(space.names, trade_off, all(known[d] for d in trade_off.places)))
    unclear = [one.name for d, one in enumerate(parameters) if one.verdict == "not at all" and d not in shared]
    matter = "matters" if len(unclear) == 1 else "matter"
    steps += [ANOTHER.format(f"{listed(unclear)} {matter}")] * bool(unclear)
    for trade_off in together:
        if not all(known[d] for d in trade_off.places):
            several = listed([space.names[d] for d in trade_off.places])
            steps.append(ANOTHER.format(f"{several} act in different ways"))
    return RunSummary(parameters, tuple(filter(None, sentences)), tuple(steps))


def _wider(one: ParameterSummary, last, feasible) -> list[str]:
    """Next steps for bounds of Phi that the posterior leans on."""
    if one.verdict == "not at all":
        return []
    sides = [side for side in one.leans if _at_phi(side, last, feasible)]
    word = {"lower": "below", "upper": "above"}
    places = [f"{word[side]} {_value(feasible[side == 'upper'], one)}" for side in sides]
    return [f"A wider Phi, if {one.name} can be {' or '.join(places)}: the task's `feasible`."] if sides else []


def _at_phi(side: str, last, feasible) -> bool:
    place = int(side == "upper")
    return math.isclose(last[place], feasible[place], rel_tol=1e-5)


def _span(space: Space, box: Support) -> np.ndarray:
    """Widths of the central 90 % of a uniform distribution over a box of inference space, in natural units."""
    low, high = (np.asarray(space.to_natural(box.low + level * box.width), np.float64) for level in OUTER)
    return high - low


def _parameter(space: Space, d: int, draws, inner, unit: str, boxes, spans, truth) -> ParameterSummary:
    levels = (*INNER, *OUTER)
    first, third, low, high = map(float, np.quantile(draws, levels))
    guess, last = (np.float64(box.width[d]) for box in boxes[:2])
    ratio = inner.std() / (max(guess, last) / math.sqrt(12))  # a box shrunk to the posterior says nothing
    narrower = [span[d] / max(high - low, 1e-30) for span in spans]
    verdict = "identified" if ratio < IDENTIFIED else "weakly" if ratio < WEAKLY else "not at all"
    place = (inner - np.float64(boxes[1].low[d])) / last
    share = {"lower": np.mean(place < ALONG), "upper": np.mean(place > 1 - ALONG)}
    return ParameterSummary(
        name=space.names[d],
        unit=unit,
        median=float(np.median(draws)),
        central_50=(first, third),
        central_90=(low, high),
        narrower=float(narrower[0]),
        narrower_than_phi=float(narrower[1]),
        verdict=verdict,
        leans=tuple(side for side in share if share[side] > LEANING),
        truth=None if truth is None else float(truth[d]),
        decimals=_decimals(draws),
    )


def _decimals(draws: np.ndarray) -> int:
    """Number of decimals whose last is as large as the Monte Carlo error of 5 % quantiles, 2.1 sd / sqrt(n)."""
    error = max(2.1 * draws.std() / math.sqrt(len(draws)), 1e-7 * np.abs(draws).max())  # or float32's rounding
    return -round(math.log10(error)) if 0 < error < math.inf else 6


def _value(value: float, one: ParameterSummary) -> str:
    return f"{value:.3g}{with_unit(one.unit)}"


def _of_the_guess(one: ParameterSummary, draws: np.ndarray, guess, last, heuristic: str) -> str:
    """A sentence on whether the first guess was wrong, if the box has been moved."""
    ends = zip(("lower", "upper"), guess, last, strict=True)
    shifted = [(side, now) for side, was, now in ends if abs(now - was) > MOVED * (guess[1] - guess[0])]
    if not shifted or one.verdict == "not at all":  # a box may widen merely because the data say nothing
        return ""
    outside = np.mean((draws < guess[0]) | (draws > guess[1]))
    if outside > OUTSIDE:
        moved = " and ".join(f"its {side} bound to {_value(now, one)}" for side, now in shifted)
        return (
            f"The first guess of {guess[0]:.3g} to {_value(guess[1], one)} for {one.name} was wrong: {heuristic} moved "
            f"{moved}, and {_share(outside)} of the posterior is outside the guess."
        )
    (side, now), *others = shifted
    moved = f"the {side} bound of {one.name} to {_value(now, one)}"
    moved += "".join(f" and its {side} bound to {_value(now, one)}" for side, now in others)
    return f"{heuristic} moved {moved}; {_share(1 - outside)} of the posterior is within the first guess."


def _share(share: float) -> str:
    return "all" if share > 0.9995 else f"{100 * share:.3g} %"


def _of_its_bounds(one: ParameterSummary, last, feasible) -> str:
    """A sentence on the bounds of the last box that the posterior leans on."""
    if one.verdict == "not at all" or not one.leans:
        return ""
    texts = []
    for side in one.leans:
        place = int(side == "upper")
        of = "the feasible domain's" if _at_phi(side, last, feasible) else "the box's"
        texts.append(f"{of} {side} bound, {_value(last[place], one)}")
    advice = "values beyond it were never tried"
    return f"The posterior of {one.name} leans on {' and '.join(texts)}: {advice}."


def _unconstrained(one: ParameterSummary, guess, last, feasible, heuristic: str, shared: bool) -> str:
    """A sentence on a parameter about which nothing is known, and on how the heuristic moved its box."""
    if one.verdict != "not at all":
        return ""
    if last[0] >= guess[0] and last[1] <= guess[1]:
        # If a parameter is known only in combination with others, say so.
        return "" if shared else unconstrained(one.name, ": its posterior is about as wide as its box")
    all_of_it = ", all of the feasible domain" * all(_at_phi(side, last, feasible) for side in ("lower", "upper"))
    was, now = (f"{box[0]:.3g} to {_value(box[1], one)}" for box in (guess, last))
    return unconstrained(
        one.name,
        f"{' by itself' * shared}: {heuristic} moved its box from {was} out to {now}{all_of_it}, which says nothing "
        "against the first guess",
    )
