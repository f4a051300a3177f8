"""The collected results of a study, read back."""

import csv
import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments.policies.study import NOMINAL, PAPER
from jaxlfi.io import files

Pair = tuple[str, str]
"""A policy, and the domain or object it was evaluated on."""
KINDS = {
    "edge": "PPO on EDGE's posterior",
    "none": "PPO on the fixed support's posterior",
    "mean": "PPO at EDGE's posterior mean",
    "sysid": "PPO at the point of least squares",
    "true": "PPO at the true parameters",
}


@dataclasses.dataclass(frozen=True)
class Results:
    """Arrays by pair and name, as `collection` describes them.

    Attributes:
        simulation: results by policy and domain, rows [S, E].
        objects: results by policy and FEM object, rows [S, P], the nominal place's first.
        trainings: results by domain.
        posteriors: rows of the table of posteriors.
    """

    simulation: Mapping[Pair, Mapping[str, np.ndarray]]
    objects: Mapping[Pair, Mapping[str, np.ndarray]]
    trainings: Mapping[str, Mapping[str, np.ndarray]]
    posteriors: list[dict[str, str]]

    def displaced(self, policy: str, dlo: str, name: str = "value") -> np.ndarray:
        """Values of policies on an object at displaced places, shape [S, 16]."""
        return np.asarray(self.objects[policy, dlo][name], float)[:, NOMINAL:]

    def nominal(self, policy: str, dlo: str, name: str = "value") -> np.ndarray:
        """Values of policies on an object at the nominal place, shape [S, 4]."""
        return np.asarray(self.objects[policy, dlo][name], float)[:, :NOMINAL]

    def simulated(self, policy: str, domain: str, name: str = "value") -> np.ndarray:
        """Values of policies in simulation, shape [S, E]."""
        return np.asarray(self.simulation[policy, domain][name], float)

    @property
    def policies(self) -> list[str]:
        """Names of all policies and baselines that were deployed on an object."""
        return list(dict.fromkeys(policy for policy, _ in self.objects))


def load(folder: Path) -> Results:
    """Read a study's folder."""
    with (folder / "posteriors.csv").open(newline="") as file:
        posteriors = list(csv.DictReader(file))
    pairs = {where: grouped(folder / f"{where}.npz") for where in ("simulation", "objects")}
    split = {where: {tuple(name.split("@")): rows for name, rows in own.items()} for where, own in pairs.items()}
    return Results(**split, trainings=grouped(folder / "trainings.npz"), posteriors=posteriors)


def grouped(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Arrays that were written as NAME/WHAT, by name."""
    out: dict[str, dict[str, np.ndarray]] = {}
    for key, row in files.read_arrays(path).items():
        name, _, what = key.rpartition("/")
        out.setdefault(name, {})[what] = row
    return out


def label(policy: str) -> str:
    """The name of a policy in tables."""
    if policy in PAPER:
        return PAPER[policy]
    if policy in OTHERS:
        return OTHERS[policy]
    dlo, _, kind = policy.rpartition("-")
    return (
        f"open-loop plan for {policy.removeprefix('plan-')}" if policy.startswith("plan-") else f"{KINDS[kind]}: {dlo}"
    )


OTHERS = {
    "feasible": "PPO on Φ, uniform",
    "constant": "best constant action",
    "plan-median": "open-loop plan for μ",
}
