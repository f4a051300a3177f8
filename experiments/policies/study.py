"""The parts of the study, by name, and their places in its folder.

runs/recordings/NAME/     rollouts of the simulated objects, whose truth is known (`jaxlfi whip render`)
runs/posteriors/NAME-H/   posteriors of each object, by heuristic (`jaxlfi infer`)
runs/sysid/NAME.json      least-squares points with their intervals
runs/policies/NAME/       the trainings of each domain (`jaxlfi train`)
runs/actions/NAME.npz     open-loop baselines: the best constant action, and plans
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxlfi.envs.whip.parameters import MILLIMETRES
from jaxlfi.envs.whip.reference_objects.objects import load as load_object
from jaxlfi.rl.domains import limits_of, of_belief
from jaxlfi.runs.load import load as load_run

FEM = ("dlo-0", "dlo-1", "dlo-2", "dlo-3")
"""Reference objects."""
SIMULATED: Mapping[str, tuple[float, float]] = {
    "sim-in": (230.0, 8e3),
    "sim-stiff": (170.0, 1.2e5),
    "sim-long": (330.0, 1.2e4),
}
"""Length (mm) and modulus (Pa) of the simulated objects: the first is inside of Theta_0, the others outside."""
OBJECTS = (*FEM, *SIMULATED)
HEURISTICS = ("edge", "none")
"""Heuristics that adapt the support: EDGE, and none."""
BROAD: Mapping[str, str] = {"uniform": "uniform", "median": "median", "feasible": "uniform:feasible"}
"""Domains that do not depend on an object, as named by `jaxlfi train`: PPO-U, PPO-mu, and uniform over Phi."""
MASS_THRESHOLDS: Mapping[str, tuple[float, float]] = {"dlo-2": (0.005, 0.005)}
"""EDGE's tau for objects on which the paper's is not that of the task, (0.003, 0.005)."""
POINTS = ("mean", "true", "sysid")
"""Point domains of an object: its posterior mean by EDGE, its true parameters, and a least-squares point."""
ORDER = (
    *("dlo-0-edge", "uniform", "median", "dlo-0-none", "dlo-3-edge", "dlo-3-none", "dlo-2-edge", "dlo-2-none"),
    *("dlo-1-edge", "dlo-1-none", "dlo-0-mean", "dlo-0-true", "feasible", "dlo-0-sysid"),
    *("sim-stiff-edge", "sim-stiff-none", "sim-stiff-true", "sim-in-edge", "sim-in-none", "sim-in-true"),
    *("sim-long-edge", "sim-long-none", "sim-long-true", "dlo-3-mean", "dlo-3-true", "dlo-3-sysid"),
    *("dlo-2-mean", "dlo-2-true", "dlo-2-sysid", "dlo-1-mean", "dlo-1-true", "dlo-1-sysid"),
    *("sim-stiff-mean", "sim-in-mean", "sim-long-mean"),
)
"""All domains that policies are trained on, the most important first."""
PAPER: Mapping[str, str] = {
    **{f"dlo-{i}-none": f"PPO-{i}" for i in range(4)},
    **{f"dlo-{i}-edge": f"PPO-{i}'" for i in range(4)},
    "uniform": "PPO-U",
    "median": "PPO-μ",
}
"""The paper's ten policies, and their names there."""
NOMINAL = 4
"""Number of episodes at the nominal place, which come first: the paper's repetitions, with different camera noise."""
DISPLACED = 16
"""Number of other places; stack and camera are displaced as in training."""
STILLS = (0, 3, 5, 7, 9, 11, 13, 16)
"""Control steps of an episode that are shown."""
DRAWS = 4000
"""Number of draws from a posterior, for its quantiles and mean."""


@dataclasses.dataclass(frozen=True)
class Study:
    """The folder of a study.

    Attributes:
        out: folder of the results; files that are bulky or can be made again are in `runs` below it.
    """

    out: Path

    def recording(self, name: str) -> Path:
        """The rollout of a simulated object."""
        return self.out / "runs" / "recordings" / name / "rollout.npz"

    def posterior(self, name: str) -> Path:
        """The run that inferred a posterior."""
        return self.out / "runs" / "posteriors" / name

    def sysid(self, name: str) -> Path:
        """The least-squares point of an object."""
        return self.out / "runs" / "sysid" / f"{name}.json"

    def training(self, name: str) -> Path:
        """The trainings on a domain."""
        return self.out / "runs" / "policies" / name

    def actions(self, name: str) -> Path:
        """Actions of an open-loop baseline."""
        return self.out / "runs" / "actions" / f"{name}.npz"

    def policies(self) -> dict[str, list[Path]]:
        """The files of all policies with finished training, by domain, in the order of seeds."""
        found = {name: sorted(self.training(name).glob("*/seed_*/policy.npz")) for name in ORDER}
        return {name: paths for name, paths in found.items() if paths and (self.training(name) / "table.csv").exists()}

    def draws(self, name: str) -> np.ndarray:
        """Draws of a posterior as policies are trained on it, clipped, in natural units, shape [4000, 2]."""
        run = load_run(self.posterior(name))
        return np.asarray(of_belief(jax.random.key(1), run.belief, run.space, limits_of(run), DRAWS).theta)

    def point(self, name: str) -> np.ndarray:
        """A point, "OBJECT-mean", "OBJECT-true" or "OBJECT-sysid": length (mm) and modulus (Pa), shape [2]."""
        dlo, _, kind = name.rpartition("-")
        if kind == "true":
            return truth(dlo)
        if kind == "sysid":
            return np.asarray(json.loads(self.sysid(dlo).read_text())["theta"])
        draws = self.draws(f"{dlo}-edge")
        return np.array([draws[:, 0].mean(), np.exp(np.log(draws[:, 1]).mean())])

    def has(self, name: str) -> bool:
        """Whether the results that a domain is made from exist."""
        dlo, _, kind = name.rpartition("-")
        if name in BROAD or kind == "true":
            return True
        if kind == "sysid":
            return self.sysid(dlo).exists()
        return (self.posterior(name if kind in HEURISTICS else f"{dlo}-edge") / "posterior.npz").exists()

    def domain(self, name: str) -> str:
        """The name of a domain for `jaxlfi train`."""
        if name in BROAD:
            return BROAD[name]
        if name.endswith(POINTS):
            return "point:" + ",".join(f"{number:.6g}" for number in self.point(name))
        return str(self.posterior(name))


def truth(dlo: str) -> np.ndarray:
    """Length (mm) and modulus (Pa) of an object; for an FEM one, those of the light DLO that hangs and swings alike."""
    if dlo in SIMULATED:
        return np.asarray(SIMULATED[dlo])
    known = load_object(dlo)
    return np.array([known.length * MILLIMETRES[0], known.light_young])


def chosen(only: Sequence[str], known: Sequence[str]) -> list[str]:
    """The requested names, in the order of the request; by default all.

    Raises:
        ValueError: for names that are not known.
    """
    if unknown := [name for name in only if name not in known]:
        raise ValueError(f"only: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    return list(dict.fromkeys(only)) or list(known)
