"""Policies on EDGE's posteriors against others, over objects, seeds and places at once, corrected for their number."""

from collections.abc import Callable, Sequence

import numpy as np

from experiments.policies import intervals
from experiments.policies.results import Results
from experiments.policies.study import FEM, SIMULATED
from experiments.policies.tables import RIVALS, Row, rival
from jaxlfi.diagnostics.contrasts import Arm, contrast, holm

SHARED = ("uniform", "feasible", "median", "constant")
"""Rivals that are the same policies on all objects."""


def arm(kind: str, objects: Sequence[str], returns: Callable[[str, str], np.ndarray]) -> Arm | None:
    """Returns [O, S, P] of EDGE's policies, each on its own object, or of a kind of `RIVALS`; None where some lack."""
    name = lambda dlo: f"{dlo}-edge" if kind == "edge" else rival(dlo, kind)
    try:
        return Arm(np.stack([returns(name(dlo), dlo) for dlo in objects]), kind in SHARED)
    except KeyError:
        return None


def text(p: float) -> str:
    """A p-value to three digits."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def table(results: Results) -> list[Row]:
    """All contrasts of a kind of objects are a family of Holm's."""
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
        found = {name: contrast(edge, other) for name, other in others.items() if other is not None}
        corrected = holm([one.p for one in found.values()])
        for (name, one), p in zip(found.items(), corrected, strict=True):
            rows.append(
                {
                    "where": where,
                    "EDGE −": name,
                    "difference": intervals.text((one.difference, one.low, one.high)),
                    "p": text(one.p),
                    "p, Holm": text(p),
                    "g": f"{one.standardised:.2f}",
                    "A": f"{one.superiority:.2f}",
                }
            )
    return rows
