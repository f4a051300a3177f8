"""Results made by commands of jaxlfi: rollouts of simulated objects, posteriors, policies. Existing ones are kept."""

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
from jaxlfi.io import files
from jaxlfi.rl import training
from jaxlfi.rl.settings import PRESETS


def believe(study: Study, name: str) -> None:
    """Infer an object's parameters from its rollout: "OBJECT-edge", "OBJECT-none", or "OBJECT-sysid", a point."""
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
        shutil.rmtree(path.parent, ignore_errors=True)  # left by an interrupted command
        length, young = SIMULATED[dlo]
        words = ["render", "--length", f"{length:g}", "--young", f"{young:g}", "--detector", "mask"]
        _command(whip.main, [*words, "--out", str(path.parent)], "whip ")
    return path


def learn(study: Study, names: Sequence[str], seeds: int, settings: Sequence[str]) -> None:
    """Train policies on domains, all seeds of all domains in parallel; the inference they need is made first."""
    for name in names:
        _check_same(study.training(name), seeds, settings)
    names = [name for name in names if not (study.training(name) / "table.csv").exists()]
    if not names:
        return
    for name in names:
        dlo, _, kind = name.rpartition("-")
        if name not in BROAD and kind != "true":
            believe(study, name if kind in (*HEURISTICS, "sysid") else f"{dlo}-edge")
    together = study.training("+".join(names))
    _check_same(together, seeds, settings)
    if (together / "config.json").exists():
        _command(command_line.main, ["resume", str(together)])
    else:
        domains = [study.domain(name) for name in names]
        words = ["whip", "--domain", *domains, "--seeds", str(seeds), "--preset", "quick", *settings]
        _command(train.main, [*words, "--out", str(together)], "train ")
    if len(names) > 1:
        split(together, [study.training(name) for name in names])


def _check_same(out: Path, seeds: int, settings: Sequence[str]) -> None:
    """Refuse an existing training whose seeds or settings differ from the requested ones.

    Raises:
        ValueError: in one line.
    """
    if not (out / "config.json").exists():
        return
    config = training.read_config(out)
    words = ["whip", "--domain", "uniform", "--out", str(out), *settings]
    asked = PRESETS["quick"].replace(**train.parser().parse_args(words).settings)
    found = training.settings_of(config)
    if found != asked:
        differ = [name for name, value in vars(asked).items() if value != vars(found)[name]]
        raise ValueError(f"{out}: expected a training of the same settings, got another {', '.join(differ)}: remove it")
    trained = {one["seed"] for one in config["trainings"]}
    if trained != set(range(seeds)):
        raise ValueError(
            f"{out}: expected a training of {seeds} seeds, got one of {len(trained)}: remove it to train again"
        )


def split(together: Path, outs: Sequence[Path]) -> None:
    """Give each domain of a finished training a folder of its own, as if it had been trained alone.

    Args:
        together: the training; it is removed.
        outs: folders for its domains, in their order; a folder with a table.csv is complete.
    """
    config = training.read_config(together)
    trained = [one["domain"] for one in config["trainings"]]
    header, *lines = (together / "table.csv").read_text().splitlines(keepends=True)
    arrays = {name: files.read_arrays(together / f"{name}.npz") for name in ("curves", "outcomes")}
    domains = files.read_sealed(together / "domains.npz")
    for domain, out in zip(dict.fromkeys(trained), outs, strict=True):
        if (out / "table.csv").exists():
            continue
        rows = [row for row, other in enumerate(trained) if other == domain]
        out.mkdir(exist_ok=True)
        shutil.copytree(together / domain, out / domain, dirs_exist_ok=True)
        points = {name: domains[name][rows] for name in ("trained", "held_out")}
        files.write_sealed(out / "domains.npz", domains | points)
        files.write_arrays(out / "curves.npz", {name: array[:, rows] for name, array in arrays["curves"].items()})
        files.write_arrays(out / "outcomes.npz", {name: array[rows] for name, array in arrays["outcomes"].items()})
        files.write_json(out / "config.json", config | {"trainings": [config["trainings"][row] for row in rows]})
        files.write_bytes(out / "table.csv", "".join([header, *(lines[row] for row in rows)]).encode())
    shutil.rmtree(together)


def _command(run: Callable[[list[str]], int], words: list[str], prefix: str = "") -> None:
    """Run a command of jaxlfi; the study ends if it fails."""
    print(f"\n== jaxlfi {prefix}{' '.join(words)}", flush=True)
    if status := run(words):
        raise SystemExit(status)
    jax.clear_caches()
