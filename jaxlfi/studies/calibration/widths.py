"""Widths: how far the intervals of a run's method can be trusted at one reference, in numbers and in plain words."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxlfi import diagnostics
from jaxlfi.diagnostics.intervals import HONEST, LEVELS, NARROW, TOO_FEW, WIDE, Estimate, Intervals
from jaxlfi.studies.calibration.plan import TIES, CalibrationPlan


@dataclasses.dataclass(frozen=True)
class Widths:
    """What the intervals are worth at one reference.

    Attributes:
        plan: where truths were drawn.
        names: of the parameters in inference space.
        parameters: one a parameter.
        regions: densest regions of all parameters together.
    """

    plan: CalibrationPlan
    names: Sequence[str]
    parameters: Sequence[Intervals]
    regions: Intervals

    @property
    def rows(self) -> list[tuple[str, Intervals]]:
        """What was judged, by name."""
        return [*zip(self.names, self.parameters, strict=True), ("all together", self.regions)]

    @property
    def heading(self) -> str:
        """Where truths were drawn, as the beginning of a list."""
        kind = "drawn from it" if self.plan.at_posterior else "drawn from the prior over it"
        where = self.plan.where[0].upper() + self.plan.where[1:]
        return f"{where} ({self.plan.truths} truths {kind})"

    @property
    def line(self) -> str:
        """The verdicts in one line."""
        found = "; ".join(f"{name} {_short(one)}" for name, one in self.rows[:-1])
        return f"{found} (measured {self.plan.where} with {self.plan.truths} truths by jaxlfi diagnose)"

    def as_json(self) -> dict[str, Any]:
        """For diagnostics.json."""
        return {
            "reference": self.plan.reference,
            "heading": self.heading,
            "levels": list(LEVELS),
            "found": [{"name": name, "sentence": sentence(name, one)} | dataclasses.asdict(one)
                      for name, one in self.rows],
        }  # fmt: skip


def measured(
    plan: CalibrationPlan, names: Sequence[str], truths: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]
) -> Widths:
    """Compare truths with the intervals of their posteriors."""
    rank = jax.device_get(_density_ranks(plan.key(TIES), found["truth_log_prob"], found["log_prob"]))
    parameters = diagnostics.check_intervals(truths["theta"], found["draws"])
    return Widths(plan, names, parameters, diagnostics.check_regions(rank, plan.draws))


_density_ranks = jax.jit(diagnostics.density_ranks)


def sentence(name: str, found: Intervals) -> str:
    """What was found of a parameter, as one says it."""
    held = found.held[-1]
    numbers = f"{100 * LEVELS[-1]:.0f} % {'regions' if found.factor is None else 'intervals'} held {_percent(held)}"
    if found.verdict == TOO_FEW:
        return (
            f"{name}: no verdict, as {found.truths} truths are too few and {found.needed} the least ({numbers} of them)"
        )
    if found.factor is not None and found.verdict != _width_word(found.verdict):
        side = "above" if found.above.value > 0.5 else "below"
        share = found.above if side == "above" else Estimate(
            1 - found.above.value, 1 - found.above.high, 1 - found.above.low
        )  # fmt: skip
        return (
            f"{name}: {found.verdict}, {_percent(share)} of {found.truths} truths lie {side} its median ({numbers}; to "
            f"hold {100 * LEVELS[-1]:.0f} % they would have to be {_number(found.factor.value)} times as wide)"
        )
    right = ""
    if found.factor is not None and found.verdict == HONEST:
        right = f"; the right width is {_number(found.factor.low)} to {_number(found.factor.high)} times theirs"
    return f"{name}: {found.verdict}{_by(found)} ({numbers} of {found.truths} truths{right})"


def arrays_of(widths: Sequence[Widths]) -> dict[str, np.ndarray]:
    """What the picture of the widths is drawn from: R references, D parameters; an estimate is [value, low, high]."""
    return {
        "widths_reference": np.asarray([one.plan.where for one in widths]),
        "widths_level": np.asarray(LEVELS),
        "widths_held": np.asarray([[_triples(found.held) for found in one.parameters] for one in widths]),
        "widths_factor": np.asarray([_triples([found.factor for found in one.parameters]) for one in widths]),
        "widths_regions_held": np.asarray([_triples(one.regions.held) for one in widths]),
    }


def _triples(estimates: Sequence[Estimate]) -> list[tuple[float, float, float]]:
    return [dataclasses.astuple(estimate) for estimate in estimates]


def _short(found: Intervals) -> str:
    return {TOO_FEW: "without a verdict (too few truths)"}.get(found.verdict, f"{found.verdict}{_by(found)}")


def _by(found: Intervals) -> str:
    """By how much intervals are too narrow, or too wide, where they are not biased."""
    factor = found.factor
    if factor is None or found.verdict not in (NARROW, WIDE):
        return ""
    if found.verdict == WIDE:
        factor = Estimate(*(math.inf if end == 0 else 1 / end for end in (factor.value, factor.high, factor.low)))
    return f", by {_number(factor.value)} [{_number(factor.low)}, {_number(factor.high)}]"


def _width_word(verdict: str) -> str:
    """What a verdict says of the width alone."""
    return next((word for word in (NARROW, WIDE) if verdict.startswith(word)), HONEST)


def _percent(share: Estimate) -> str:
    return f"{100 * share.value:.0f} % [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def _number(factor: float) -> str:
    return f"{factor:.2f}" if factor < 0.995 else f"{factor:.1f}"
