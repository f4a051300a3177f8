"""Rules that adapt the support from the posterior: one file each, pure and branch-free."""

from jaxlfi.heuristics.base import Adaptation, Heuristic, stretch
from jaxlfi.heuristics.centre import Centre
from jaxlfi.heuristics.choice import Choice
from jaxlfi.heuristics.edge import Edge
from jaxlfi.heuristics.fixed import Fixed
from jaxlfi.heuristics.matching import Matched
from jaxlfi.heuristics.mode import Mode
from jaxlfi.heuristics.truncate import Truncate

HEURISTICS: dict[str, type] = {"none": Fixed, "edge": Edge, "mode": Mode, "centre": Centre, "truncate": Truncate}
"""Heuristics by the name the command line gives them; the paper's with the defaults of section V."""

__all__ = [
    "HEURISTICS",
    "Adaptation",
    "Centre",
    "Choice",
    "Edge",
    "Fixed",
    "Heuristic",
    "Matched",
    "Mode",
    "Truncate",
    "stretch",
]
