"""What is made by commands of jaxlfi: rollouts of simulated objects, posteriors, policies. What is there is kept."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import jax

from experiments.policies import sysid
from experiments.policies.study import BROAD, FEM, HEURISTICS, MASS_THRESHOLDS, SIMULATED, Study
from jaxlfi.cli import parser as command_line
from jaxlfi.cli import train
from jaxlfi.envs.whip import cli as whip
from jaxlfi.envs.whip.real2sim import recorded


def believe(study: Study, name: str) -> None:
    """What an object may be, of its one rollout: "OBJECT-edge", "OBJECT-none", or "OBJECT-sysid", a point."""
    dlo, _, how = name.rpartition("-")
    rollout = dlo if dlo in FEM else str(_record(study, dlo))
    if how == "sysid":
        if not study.sysid(dlo).exists():
            print(f"\n== mujoco.sysid: {dlo}", flush=True)
            sysid.fit(study.sysid(dlo), recorded(rollout))
        return
    out = study.posterior(name)
    if (out / "posterior.npz").exists():
        return
    words = ["infer", "whip", "--object", rollout, "--heuristic", how]
    if how == "edge" and dlo in MASS_THRESHOLDS:
        words += ["--mass-threshold", *(f"{tau:g}" for tau in MASS_THRESHOLDS[dlo])]
    begun = (out / "config.json").exists()
    _command(command_line.main, ["resume", str(out)] if begun else [*words, "--out", str(out)])


def _record(study: Study, dlo: str) -> Path:
    """A rollout of a simulated object under the exploratory actions, seen as FEM objects are."""
    path = study.recording(dlo)
    if not path.with_suffix(".json").exists():
        shutil.rmtree(path.parent, ignore_errors=True)  # what was left of one that was stopped
        length, young = SIMULATED[dlo]
        words = ["render", "--length", f"{length:g}", "--young", f"{young:g}", "--detector", "mask"]
        _command(whip.main, [*words, "--out", str(path.parent)], "whip ")
    return path


def learn(study: Study, name: str, seeds: int, settings: Sequence[str]) -> None:
    """Policies on a domain, a seed each, side by side; what the domain needs is made before."""
    out = study.training(name)
    if (out / "table.csv").exists():
        return
    dlo, _, kind = name.rpartition("-")
    if name not in BROAD and kind != "true":
        believe(study, name if kind in (*HEURISTICS, "sysid") else f"{dlo}-edge")
    if (out / "config.json").exists():
        _command(command_line.main, ["resume", str(out)])
    else:
        words = ["whip", "--domain", study.domain(name), "--seeds", str(seeds), "--preset", "quick", *settings]
        _command(train.main, [*words, "--out", str(out)], "train ")


def _command(run: Callable[[list[str]], int], words: list[str], prefix: str = "") -> None:
    """Run a command of jaxlfi; the study ends where it fails."""
    print(f"\n== jaxlfi {prefix}{' '.join(words)}", flush=True)
    if status := run(words):
        raise SystemExit(status)
    jax.clear_caches()
