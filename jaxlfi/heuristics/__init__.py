"""Rules that adapt the support from the posterior: one file each, pure and branch-free."""

from jaxlfi.heuristics.base import Adaptation, Heuristic, adapted, stretch
from jaxlfi.heuristics.centre import Centre
from jaxlfi.heuristics.choice import Choice
from jaxlfi.heuristics.edge import Edge
from jaxlfi.heuristics.fixed import Fixed
from jaxlfi.heuristics.matching import Matched, paired
from jaxlfi.heuristics.mode import Mode
from jaxlfi.heuristics.truncate import Truncate

__all__ = [
    "Adaptation", "Centre", "Choice", "Edge", "Fixed", "Heuristic", "Matched", "Mode", "Truncate", "adapted",
    "paired", "stretch",
]  # fmt: skip
