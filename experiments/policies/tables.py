"""Tables of a study, as rows of text that are written as csv and as Markdown."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from experiments.policies import intervals
from experiments.policies.results import Results, label
from experiments.policies.study import FEM, PAPER, SIMULATED

Row = dict[str, str]
NONE = "–"
RIVALS = {"uniform": "U", "fixed": "fixed support", "mean": "posterior mean", "sysid": "least squares", "true": "truth",
          "feasible": "Φ", "median": "μ", "constant": "constant", "plan": "plan"}  # fmt: skip
"""Kinds of policies that one on EDGE's posterior is compared with, and their names in columns."""
SETS = {"fixed support": "none", "EDGE": "edge"}


def markdown(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def rival(dlo: str, kind: str) -> str:
    """The name of the policy, of a kind of `RIVALS`, that an object's policy is compared with."""
    own = {"fixed": f"{dlo}-none", "plan": f"plan-{dlo}"}
    return own.get(kind, kind if kind in ("uniform", "feasible", "median", "constant") else f"{dlo}-{kind}")


Values = Callable[[str], np.ndarray]
"""Function that gives the returns of a policy, [S, P], with KeyError if it was not evaluated."""


@dataclasses.dataclass(frozen=True)
class Place:
    """A place where an object's policies are compared.

    Attributes:
        dlo: the object.
        what: the FEM object, or a domain in simulation.
        values: function that gives the returns of policies.
    """

    dlo: str
    what: str
    values: Values


def places(results: Results) -> list[Place]:
    """FEM objects, their posteriors in simulation, and simulated objects whose truth is known."""
    on_object = lambda dlo: lambda policy: results.displaced(policy, dlo)
    on_domain = lambda name: lambda policy: results.simulated(policy, name)
    return [
        *(Place(dlo, f"{dlo}, FEM object", on_object(dlo)) for dlo in FEM),
        *(Place(dlo, f"{dlo}, its posterior simulated", on_domain(f"{dlo}-edge")) for dlo in FEM),
        *(Place(dlo, f"{dlo}, its truth simulated", on_domain(f"{dlo}-true")) for dlo in SIMULATED),
    ]


def question(results: Results) -> list[Row]:
    """The return of each policy on EDGE's posterior on its own object, and its difference from other policies there."""
    rows = []
    for place in places(results):
        own = found(place.values, f"{place.dlo}-edge")
        if own is None:
            continue
        row = {"where": place.what, "on EDGE's posterior": intervals.text(intervals.mean(own))}
        for kind, name in RIVALS.items():
            other = found(place.values, rival(place.dlo, kind))
            row[f"− {name}"] = NONE if other is None else intervals.text(intervals.difference(own, other))
        rows.append(row)
    return rows


def found(values: Values, policy: str) -> np.ndarray | None:
    """Returns of a policy, or None if it was not evaluated."""
    try:
        return values(policy)
    except KeyError:
        return None


def objects(results: Results) -> list[Row]:
    """Every policy on every FEM object: return, rate of clean hits, worst place, rate of exits, at displaced places."""

    def cell(policy: str, dlo: str) -> str:
        value, clean, outside = (results.displaced(policy, dlo, name) for name in ("value", "clean", "outside"))
        numbers = (clean.mean(), value.min(axis=1).mean(), outside.mean())
        return "; ".join([intervals.text(intervals.mean(value)), *(f"{number:.2f}" for number in numbers)])

    return _on_objects(results, cell)


def nominal(results: Results) -> list[Row]:
    """Every policy on every FEM object at the nominal place, the paper's four repetitions: return and clean hits."""
    numbers = lambda policy, dlo: (results.nominal(policy, dlo, name).mean() for name in ("value", "clean"))
    return _on_objects(results, lambda *pair: "; ".join(f"{number:.2f}" for number in numbers(*pair)))


def _on_objects(results: Results, cell: Callable[[str, str], str]) -> list[Row]:
    """A row for each policy and a column for each object, filled where the policy was deployed on the object."""
    filled = lambda policy, dlo: cell(policy, dlo) if (policy, dlo) in results.objects else NONE
    return [{"policy": label(policy)} | {dlo: filled(policy, dlo) for dlo in FEM} for policy in results.policies]


def motion(results: Results) -> list[Row]:
    """Mean motion of policies on each FEM object, at displaced places: steps, commanded path, heights."""
    columns = {
        "steps": "steps",
        "path": "path [m]",
        "gripper": "gripper's height [m]",
        "lowest": "distance to table [m]",
    }
    return [
        {"policy": label(policy), "object": dlo}
        | {text: f"{results.displaced(policy, dlo, name).mean():.3g}" for name, text in columns.items()}
        for policy, dlo in results.objects
    ]


def simulation(results: Results) -> list[Row]:
    """Every policy on every domain in simulation: return and rate of clean hits."""
    domains = list(dict.fromkeys(domain for _, domain in results.simulation))
    rows = []
    for policy in dict.fromkeys(policy for policy, _ in results.simulation):
        row = {"policy": label(policy)}
        for domain in domains:
            pair = policy, domain
            row[domain] = NONE
            if pair in results.simulation:
                value, clean = results.simulated(*pair), results.simulated(*pair, "clean")
                row[domain] = f"{intervals.text(intervals.mean(value))}; {clean.mean():.2f}"
        rows.append(row)
    return rows


def difficulty(results: Results) -> list[Row]:
    """The paper's measures of each DLO, for both sets of six agents: average, consistency (median), difficulty.

    They are given at the nominal place, as in the paper, and at displaced ones; the median DLO is simulated.
    """
    views = {"nominal": results.nominal, "displaced": results.displaced}
    rows = []
    for name, how in SETS.items():
        agents = [*(f"{dlo}-{how}" for dlo in FEM), "uniform", "median"]
        for dlo in (*FEM, "median"):
            row = {"policies": name, "DLO": "μ, simulated" if dlo == "median" else dlo}
            for view, values in views.items():
                own = [
                    (results.simulated(agent, dlo) if dlo == "median" else values(agent, dlo)).mean()
                    for agent in agents
                    if has(results, agent, dlo)
                ]
                if own:
                    numbers = of_agents(own, *extremes(results, values))
                    for measure, number in zip(("average", "consistency", "difficulty"), numbers, strict=True):
                        row[f"{measure}, {view}"] = NONE if np.isnan(number) else f"{number:.2f}"
            if own:
                rows.append(row | {"agents": str(len(own))})
    return rows


def extremes(results: Results, values: Callable[[str, str], np.ndarray]) -> tuple[float, float]:
    """Lowest and highest return of any episode of the paper's ten policies, on objects and on the simulated median."""
    of_pair = lambda policy, on: results.simulated(policy, on) if on == "median" else values(policy, on)
    pairs = [(policy, on) for policy in PAPER for on in (*FEM, "median") if has(results, policy, on)]
    every = [of_pair(*pair) for pair in pairs] or [np.full(1, np.nan)]
    return float(min(map(np.min, every))), float(max(map(np.max, every)))


def has(results: Results, policy: str, on: str) -> bool:
    """Whether a policy was evaluated on an object, or in simulation on the median DLO."""
    return (policy, on) in (results.simulation if on == "median" else results.objects)


def of_agents(returns: Sequence[float], low: float, high: float) -> tuple[float, float, float]:
    """The average over agents, their median (consistency), and 1 - (median - low) / (high - low), the difficulty.

    Args:
        returns: mean return of each agent on a DLO.
        low: lowest return of any episode, over all agents and DLOs.
        high: highest return, likewise.
    """
    middle = float(np.median(returns))
    return float(np.mean(returns)), middle, 1 - (middle - low) / (high - low) if high > low else np.nan


def posteriors(results: Results) -> list[Row]:
    """Medians and 90 % intervals of each object's posteriors, and least-squares points with theirs."""
    names = {"edge": "EDGE", "none": "fixed support", "sysid": "least squares (mujoco.sysid)", "true": "true"}
    rows: dict[str, Row] = {}
    for one in results.posteriors:
        row = rows.setdefault(one["object"], {"object": one["object"], **dict.fromkeys(names.values(), NONE)})
        length, young = (_interval(one, name, scale) for name, scale in (("length", 1.0), ("young", 1e3)))
        row[names[one["how"]]] = f"{length} mm, {young} kPa"
    return list(rows.values())


def _interval(row: dict[str, str], name: str, scale: float) -> str:
    middle, low, high = (float(row[key]) / scale for key in (name, f"{name}_low", f"{name}_high"))
    return f"{middle:.3g}" if np.isnan(low) else f"{middle:.3g} [{low:.3g}, {high:.3g}]"


def trainings(results: Results) -> list[Row]:
    """Results of policies on held-out points of the domain that they were trained on, by seed."""
    each = lambda numbers: f"{np.mean(numbers):.2f} ({', '.join(f'{number:.2f}' for number in numbers)})"
    return [
        {"domain": name, "policy": label(name), "return": each(own["return"]), "clean hits": each(own["clean"])}
        for name, own in results.trainings.items()
    ]
