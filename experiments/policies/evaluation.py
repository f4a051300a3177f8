"""Evaluation of policies in simulation and on the FEM objects; the file of each pair is kept.

runs/simulation/POLICY/DOMAIN.npz   `simulation.Performed` of the policies of all seeds, in the same episodes, and
                                    `fingerprints` of their files: results of a retrained policy are not kept
runs/objects/POLICY/OBJECT.npz      likewise, at the same places
runs/stills/POLICY@OBJECT.npz       film strips of a few
"""

import hashlib
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import jax
import numpy as np

from experiments.policies import actions, deployments
from experiments.policies.simulation import DOMAINS, Performed, Simulation
from experiments.policies.study import FEM, PAPER, Study
from jaxlfi.envs.whip.environment import make
from jaxlfi.io import files
from jaxlfi.rl.policy import load

EVERYWHERE = (*PAPER, "feasible", "constant", "plan-median")
"""Policies and baselines that do not belong to a single object and are evaluated everywhere."""
STILLS = (("dlo-0-none", "dlo-0"), ("dlo-0-edge", "dlo-0"), ("uniform", "dlo-0"), ("dlo-1-edge", "dlo-3"),
          ("dlo-3-edge", "dlo-3"), ("uniform", "dlo-3"))  # fmt: skip
"""Pairs of policy and object in the contact sheet: those of the paper's timelapses, and PPO-U on each object."""


def domains_of(policy: str) -> Sequence[str]:
    """Domains in simulation that a policy is evaluated on: all, or its own object's and the uniform one."""
    if policy in EVERYWHERE:
        return DOMAINS
    dlo = own_object(policy)
    return [name for name in (f"{dlo}-edge", f"{dlo}-true", "uniform") if name in DOMAINS]


def objects_of(policy: str) -> Sequence[str]:
    """FEM objects that a policy is evaluated on: all, or its own."""
    return FEM if policy in EVERYWHERE else [dlo for dlo in FEM if dlo == own_object(policy)]


def own_object(policy: str) -> str:
    """The object that a policy, or a plan, was made for."""
    return policy.removeprefix("plan-") if policy.startswith("plan-") else policy.rpartition("-")[0]


def in_simulation(study: Study, policies: Iterable[str], episodes: int) -> None:
    """Evaluate policies in simulation."""
    simulation = Simulation(study, make(), episodes)
    for policy in policies:
        paths, own = _files(study, policy), fingerprints(study, policy)
        for name in domains_of(policy):
            out = study.out / "runs" / "simulation" / policy / f"{name}.npz"
            if _is_there(out, (len(paths), episodes), own) or not study.has(name):
                continue
            print(f"simulation: {policy} on {name}", flush=True)
            if policy in actions.NAMES:
                _write(out, simulation.of_actions(files.read_arrays(paths[0])["actions"], name), own)
            else:
                _write(out, simulation.of_policies([load(path) for path in paths], name), own)


def on_objects(study: Study, policies: Iterable[str], displaced: int) -> None:
    """Evaluate policies on the FEM objects, one object after another."""
    where, policies = deployments.scenes(displaced), list(policies)
    for dlo, policy in itertools.product(FEM, policies):
        paths, own = _files(study, policy), fingerprints(study, policy)
        out = study.out / "runs" / "objects" / policy / f"{dlo}.npz"
        if dlo in objects_of(policy) and not _is_there(out, (len(paths), len(where)), own):
            print(f"objects: {policy} on {dlo}", flush=True)
            _write(out, deployments.on_object([str(path) for path in paths], dlo, where), own)


def stills(study: Study) -> None:
    """Make film strips of the first seed's policies, all with the same noise."""
    for policy, dlo in STILLS:
        out = study.out / "runs" / "stills" / f"{policy}@{dlo}.npz"
        if policy in study.policies() and not out.exists():
            print(f"stills: {policy} on {dlo}", flush=True)
            out.parent.mkdir(parents=True, exist_ok=True)
            files.write_arrays(out, deployments.stills(_files(study, policy)[0], dlo, jax.random.key(0)))


def fingerprints(study: Study, policy: str) -> np.ndarray:
    """Hashes that distinguish a policy's files, one per seed, from those of another training."""
    return np.array([hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in _files(study, policy)])


def _files(study: Study, policy: str) -> list[Path]:
    return [study.actions(policy)] if policy in actions.NAMES else study.policies()[policy]


def _is_there(path: Path, shape: tuple[int, int], fingerprints: np.ndarray) -> bool:
    """Whether a file has the requested number of episodes, of exactly these policies."""
    if not path.exists():
        return False
    found = files.read_arrays(path)
    return found["value"].shape == shape and np.array_equal(found["fingerprints"], fingerprints)


def _write(path: Path, performed: Performed, fingerprints: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {name: np.asarray(value) for name, value in vars(performed).items()}
    files.write_arrays(path, rows | {"fingerprints": fingerprints})
