"""How far the widths of a method's intervals can be trusted at one reference, in numbers and in words."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxlfi import diagnostics
from jaxlfi.diagnostics.intervals import (
    BIASED_HIGH,
    BIASED_LOW,
    CALIBRATED,
    LEVELS,
    NARROW,
    UNDECIDED,
    WIDE,
    Estimate,
    Intervals,
)
from jaxlfi.studies.calibration.plan import TIES, CalibrationPlan

_LEVEL = f"{100 * LEVELS[-1]:.0f} %"


@dataclasses.dataclass(frozen=True)
class Widths:
    """Verdicts on the intervals at one reference.

    Attributes:
        plan: the plan, which says where truths were drawn.
        names: names of the parameters in inference space.
        parameters: verdicts on the intervals of each parameter.
        regions: verdict on the highest-density regions of all parameters together.
    """

    plan: CalibrationPlan
    names: Sequence[str]
    parameters: Sequence[Intervals]
    regions: Intervals

    @property
    def rows(self) -> list[tuple[str, Intervals]]:
        """The verdicts by name."""
        return [*zip(self.names, self.parameters, strict=True), ("all together", self.regions)]

    @property
    def heading(self) -> str:
        """Where truths were drawn, as the heading of a list."""
        kind = "drawn from it" if self.plan.at_posterior else "drawn from the prior over it"
        where = self.plan.where[0].upper() + self.plan.where[1:]
        return f"{where} ({self.plan.truths} truths {kind})"

    @property
    def line(self) -> str:
        """The verdicts in one line."""
        found = "; ".join(f"{name} {_short(one)}" for name, one in self.rows)
        return f"{found} (measured {self.plan.where} with {self.plan.truths} truths by jaxlfi diagnose)"

    def as_json(self) -> dict[str, Any]:
        """The verdicts for diagnostics.json."""
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
    rank = np.asarray(diagnostics.density_ranks(plan.key(TIES), found["truth_log_prob"], found["log_prob"]))
    parameters = diagnostics.check_intervals(truths["theta"], found["draws"])
    return Widths(plan, names, parameters, diagnostics.check_regions(rank, plan.draws))


def sentence(name: str, found: Intervals) -> str:
    """The verdict on a parameter, as a sentence."""
    held, factor = found.held[-1], found.factor
    kind = "regions" if factor is None else "intervals"
    numbers = f"{_LEVEL} {kind} covered {_percent(held)} of {found.truths} truths"
    if BIASED_LOW in found.verdict or BIASED_HIGH in found.verdict:
        above = found.above
        below = Estimate(1 - above.value, 1 - above.high, 1 - above.low)
        side, fraction = ("above", above) if BIASED_LOW in found.verdict else ("below", below)
        rest = f"to cover {_LEVEL} they would have to be {_number(factor.value)} times as wide"
        return f"{name}: {found.verdict}, {_percent(fraction)} of the truths lie {side} its median ({numbers}; {rest})"
    if found.verdict in (CALIBRATED, UNDECIDED) and factor is not None:
        numbers = f"{numbers}; {_right(factor)}"
    if found.verdict == UNDECIDED:
        numbers = f"{numbers}; more truths would tell"
    return f"{name}: {found.verdict}{_by(found)} ({numbers})"


def arrays_of(widths: Sequence[Widths]) -> dict[str, np.ndarray]:
    """Arrays for the figure of the widths of R references and D parameters; an estimate is [value, low, high]."""
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
    undecided = found.verdict == UNDECIDED and found.factor is not None
    return f"{found.verdict}{f' ({_right(found.factor)})' if undecided else _by(found)}"


def _right(factor: Estimate) -> str:
    high = "any number of" if math.isinf(factor.high) else _number(factor.high)
    return f"the right width is {_number(factor.low)} to {high} times theirs"


def _by(found: Intervals) -> str:
    """The factor by which intervals are too narrow or too wide, if they are not biased."""
    factor = found.factor
    if factor is None or found.verdict not in (NARROW, WIDE):
        return ""
    if found.verdict == WIDE:
        factor = Estimate(*(math.inf if end == 0 else 1 / end for end in (factor.value, factor.high, factor.low)))
    return f", by {_number(factor.value)} [{_number(factor.low)}, {_number(factor.high)}]"


def _percent(fraction: Estimate) -> str:
    return f"{100 * fraction.value:.0f} % [{100 * fraction.low:.0f}, {100 * fraction.high:.0f}]"


def _number(factor: float) -> str:
    return f"{factor:.2f}" if factor < 0.995 else f"{factor:.1f}"
