"""Findings of section VII-C of the paper, each as a difference that should be positive, with its interval."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from experiments.policies import intervals
from experiments.policies.results import Results
from experiments.policies.study import FEM
from experiments.policies.tables import Row

Contrast = tuple[list[np.ndarray], list[np.ndarray]]
"""Values that should be larger, and those that should be smaller, each [S, P] (`intervals.contrast`)."""
GAINED = ("dlo-0", "dlo-2", "dlo-3")
"""Objects on which the paper reports a gain from an adapted support."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """A finding of the paper.

    Attributes:
        text: the finding in words.
        measure: the quantity that is compared here.
        contrast: function that gives the values that should be larger, and those that should be smaller.
        level: whether the finding is that there is no difference.
    """

    text: str
    measure: str
    contrast: Callable[[Results], Contrast]
    level: bool = False


def over(results: Results, policy: str, objects: Sequence[str]) -> np.ndarray:
    """Returns of policies at displaced places, averaged over FEM objects, shape [S, P]."""
    return np.mean([results.displaced(policy, dlo) for dlo in objects], axis=0)


def against(one: str, other: str, *objects: str) -> Callable[[Results], Contrast]:
    """Returns of one domain's policies compared with those of another's, on FEM objects."""
    return lambda results: ([over(results, one, objects)], [over(results, other, objects)])


def own(name: str = "value", of: Callable[[np.ndarray], np.ndarray] = lambda values: values, objects=GAINED):
    """Policies on EDGE's posteriors compared with those on fixed supports', each on its own object."""
    each = lambda results, how: [of(results.displaced(f"{dlo}-{how}", dlo, name)) for dlo in objects]
    return lambda results: (each(results, "edge"), each(results, "none"))


def spread(values: np.ndarray) -> np.ndarray:
    """Distance of each episode's return from its policy's mean."""
    return np.abs(values - values.mean(axis=1, keepdims=True))


def less(values: np.ndarray) -> np.ndarray:
    """Negative distance of each episode's return from its policy's mean, as less is better."""
    return -spread(values)


def everywhere(results: Results) -> Contrast:
    """Policies on EDGE's posteriors compared with those on fixed supports', on all objects."""
    each = lambda how: [over(results, f"{dlo}-{how}", FEM) for dlo in FEM]
    return each("edge"), each("none")


def on_median(results: Results) -> Contrast:
    """Policies on DLO-1's and DLO-2's posteriors compared with those on DLO-0's and DLO-3's, on the median DLO."""
    of = lambda *objects: [
        results.simulated(f"{dlo}-{how}", "median") for dlo in objects for how in ("none", "edge")
    ]  # fmt: skip
    return of("dlo-1", "dlo-2"), of("dlo-0", "dlo-3")


FINDINGS = (
    Finding("PPO-0' is better than PPO-0 on DLO-0", "return", against("dlo-0-edge", "dlo-0-none", "dlo-0")),
    Finding("PPO-2' is better than PPO-2 on DLO-2", "return", against("dlo-2-edge", "dlo-2-none", "dlo-2")),
    Finding("PPO-1 is more robust than PPO-1' on DLO-1", "return", against("dlo-1-none", "dlo-1-edge", "dlo-1")),
    Finding("PPO-3' is better than PPO-3 on DLO-2", "return", against("dlo-3-edge", "dlo-3-none", "dlo-2")),
    Finding("PPO-1' is better than PPO-3' on DLO-3", "return", against("dlo-1-edge", "dlo-3-edge", "dlo-3")),
    Finding("PPO-3 transfers to DLO-1, PPO-3' does not", "return", against("dlo-3-none", "dlo-3-edge", "dlo-1")),
    Finding(
        "policies of DLO-1 and DLO-2 are the most robust on μ",
        "return on the simulated μ, against policies of DLO-0 and DLO-3",
        on_median,
    ),
    Finding(
        "PPO-0', 2', 3' are more stable on their DLOs than PPO-0, 2, 3",
        "mean distance of a return from its policy's mean, less of it",
        own(of=less),
    ),
    Finding(
        "PPO-0' has shorter trajectories on DLO-0 than PPO-0",
        "length of the commanded path in m, less of it",
        own("path", np.negative, ("dlo-0",)),
    ),
    Finding(
        "PPO-1' varies more than PPO-1 on DLO-1",
        "mean distance of a return from its policy's mean",
        own(of=spread, objects=("dlo-1",)),
    ),
    Finding(
        "PPO-1' is level with PPO-2' on DLO-2 and DLO-3",
        "return",
        against("dlo-1-edge", "dlo-2-edge", "dlo-2", "dlo-3"),
        level=True,
    ),
    Finding(
        "PPO-0' to 3' keep farther from the table than PPO-0 to 3",
        "height of the DLO's lowest keypoint in m, on the policies' own DLOs",
        own("lowest", objects=FEM),
    ),
    Finding(
        "PPO-0' to 3' carry the gripper higher than PPO-0 to 3",
        "height of the gripper in m, on the policies' own DLOs",
        own("gripper", objects=FEM),
    ),
    Finding("adapted supports give higher returns", "return on all DLOs, PPO-0' to 3' against PPO-0 to 3", everywhere),
)


def verdict(found: tuple[float, float, float], level: bool) -> str:
    """The verdict of an interval on a finding: that it holds, that the reverse holds, or nothing."""
    _, low, high = found
    if low <= 0 <= high:
        return "no difference is shown, as found" if level else "not shown"
    return "no" if level or high < 0 else "yes"


def table(results: Results) -> list[Row]:
    """A row for each finding whose policies were evaluated."""
    rows = []
    for one in FINDINGS:
        try:
            found = intervals.contrast(*one.contrast(results))
        except KeyError:
            continue
        digits = 3 if " in m" in one.measure else 2
        rows.append(
            {
                "the paper finds": one.text,
                "compared here": one.measure,
                "difference": intervals.text(found, digits),
                "holds here?": verdict(found, one.level),
            }
        )
    return rows
