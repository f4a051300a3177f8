"""Contrasts of EDGE's policies with others, over objects, seeds and places jointly, with Holm's correction."""

from collections.abc import Callable, Sequence

import numpy as np

from experiments.arms import contrast_rows
from experiments.policies.results import Results
from experiments.policies.study import FEM, SIMULATED
from experiments.policies.tables import RIVALS, Row, rival
from jaxlfi.diagnostics.contrasts import Arm

SHARED = ("uniform", "feasible", "median", "constant")
"""Rivals that have the same policies on all objects."""


def arm(kind: str, objects: Sequence[str], returns: Callable[[str, str], np.ndarray]) -> Arm | None:
    """Returns [O, S, P] of EDGE's policies, each on its own object, or of a kind of `RIVALS`; None if any is absent."""
    name = lambda dlo: f"{dlo}-edge" if kind == "edge" else rival(dlo, kind)
    try:
        return Arm(np.stack([returns(name(dlo), dlo) for dlo in objects]), kind in SHARED)
    except KeyError:
        return None


def table(results: Results) -> list[Row]:
    """All contrasts, with one family of Holm's correction for each kind of objects."""
    kinds = {
        "FEM objects": (FEM, results.displaced),
        "simulated objects": (tuple(SIMULATED), lambda policy, dlo: results.simulated(policy, f"{dlo}-true")),
    }
    rows = []
    for where, (objects, returns) in kinds.items():
        edge = arm("edge", objects, returns)
        others = {name: arm(kind, objects, returns) for kind, name in RIVALS.items()}
        if edge is None:
            continue
        there = {name: other for name, other in others.items() if other is not None}
        rows += [{"where": where} | row for row in contrast_rows(edge, there, against="EDGE −")]
    return rows
