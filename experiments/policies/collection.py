"""The collected results of a study: a few small files, from which tables and figures are made.

Results that were collected earlier are kept if the policies are still the same and no new evaluation is found. The
files of evaluations are too many to keep, and a study can thus continue without repeating them.

posteriors.csv      medians or points with 90 % intervals of each object's parameters
trainings.npz       NAME/...: returns of training episodes [U, S], the points trained on, returns on held-out points
simulation.npz      POLICY@DOMAIN/...: for each episode [S, E]: return, hits, exits, length
objects.npz         POLICY@OBJECT/...: likewise on the FEM objects [S, P], with path and heights; for the paper's
                    policies also all actions
actions.npz         actions of the open-loop baselines, shape [16, 2] each
stills.npz          film strips
provenance.json     command lines and versions of all of it
"""

import csv
import json
from pathlib import Path

import numpy as np

from experiments.policies import actions
from experiments.policies.evaluation import STILLS, domains_of, fingerprints, objects_of
from experiments.policies.results import grouped
from experiments.policies.study import FEM, HEURISTICS, NOMINAL, OBJECTS, PAPER, Study, truth
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.rl import training

PER_EPISODE = ("value", "hit", "clean", "outside", "failed", "steps", "fingerprints")


def collect(study: Study) -> None:
    """Collect the results so far."""
    _posteriors(study)
    trained = study.policies()
    names = [*actions.NAMES, *trained]
    files.write_arrays(study.out / "trainings.npz", _trainings(study))
    pairs = {
        "simulation": [(policy, domain) for policy in names for domain in domains_of(policy)],
        "objects": [(policy, dlo) for policy in names for dlo in objects_of(policy)],
    }
    own = {policy: fingerprints(study, policy) for policy in trained} | {
        name: fingerprints(study, name) for name in actions.NAMES if study.actions(name).exists()
    }
    for where, wanted in pairs.items():
        before, kept = _grouped(study.out / f"{where}.npz"), {}
        for policy, on in wanted:
            path, pair = study.out / "runs" / where / policy / f"{on}.npz", f"{policy}@{on}"
            found = _episodes(path, policy, on) if path.exists() else before.get(pair)
            if found is not None and np.array_equal(found["fingerprints"], own[policy]):
                kept |= {f"{pair}/{name}": row for name, row in found.items()}
        files.write_arrays(study.out / f"{where}.npz", kept)
    found = {name: study.actions(name) for name in actions.NAMES if study.actions(name).exists()}
    files.write_arrays(
        study.out / "actions.npz", {name: files.read_arrays(path)["actions"] for name, path in found.items()}
    )
    strips = {f"{policy}@{dlo}": study.out / "runs" / "stills" / f"{policy}@{dlo}.npz" for policy, dlo in STILLS}
    strips = {name: files.read_arrays(path) for name, path in strips.items() if path.exists()}
    files.write_arrays(
        study.out / "stills.npz", {f"{name}/{key}": row for name, strip in strips.items() for key, row in strip.items()}
    )
    files.write_json(study.out / "provenance.json", _provenance(study))


def _grouped(path: Path) -> dict[str, dict[str, np.ndarray]]:
    return grouped(path) if path.exists() else {}


def _episodes(path: Path, policy: str, on: str) -> dict[str, np.ndarray]:
    """The arrays that are kept of each episode: motion only on objects, and actions only if they are drawn."""
    arrays = files.read_arrays(path)
    kept = {name: arrays[name] for name in PER_EPISODE} | {"steps": arrays["steps"].astype(np.int8)}
    on_object = on in FEM
    if on_object:
        kept["path"] = np.nansum(np.linalg.norm(arrays["actions"], axis=-1), axis=-1).astype(np.float32)
        kept |= {name: np.nanmean(arrays[name], axis=-1).astype(np.float32) for name in ("gripper", "lowest")}
    if policy in PAPER and (on_object or on == "median"):
        kept["actions"] = arrays["actions"] if on_object else arrays["actions"][:, :NOMINAL]
    return kept


def _trainings(study: Study) -> dict[str, np.ndarray]:
    kept = {}
    for name in study.policies():
        out = study.training(name)
        curves, points, outcomes = (
            files.read_arrays(out / f"{which}.npz") for which in ("curves", "domains", "outcomes")
        )
        kept |= {
            f"{name}/curve": curves["value"].astype(np.float32),
            f"{name}/trained": points["trained"].astype(np.float32),
            f"{name}/return": outcomes["value"].mean(axis=1),
            f"{name}/clean": outcomes["clean_hit"].mean(axis=1),
            f"{name}/steps_per_update": np.asarray(training.settings_of(training.read_config(out)).steps_per_update),
        }
    return kept


def _posteriors(study: Study) -> None:
    out, before = study.out / "posteriors.csv", {}
    if out.exists():
        with out.open(newline="") as file:
            before = {(row["object"], row["how"]): list(row.values())[2:] for row in csv.DictReader(file)}
    rows = []
    for dlo in OBJECTS:
        for how in HEURISTICS:
            if study.has(f"{dlo}-{how}"):
                low, middle, high = np.quantile(study.draws(f"{dlo}-{how}"), [0.05, 0.5, 0.95], axis=0)
                rows.append((dlo, how, *np.stack([middle, low, high], axis=1).ravel()))
            elif (dlo, how) in before:
                rows.append((dlo, how, *map(float, before[dlo, how])))
        if study.has(f"{dlo}-sysid"):
            found = json.loads(study.sysid(dlo).read_text())
            rows.append((dlo, "sysid", *np.stack([found["theta"], *found["interval"]], axis=1).ravel()))
        rows.append((dlo, "true", *np.stack([truth(dlo), [np.nan] * 2, [np.nan] * 2], axis=1).ravel()))
    names = ("length", "length_low", "length_high", "young", "young_low", "young_high")
    with out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["object", "how", *names])
        writer.writerows([dlo, how, *(f"{number:.6g}" for number in numbers)] for dlo, how, *numbers in rows)


def _provenance(study: Study) -> dict:
    """Provenance: the command of each run and training, and its versions if they differ from the current ones."""
    out = study.out / "provenance.json"
    collected, runs = environment(), json.loads(out.read_text())["runs"] if out.exists() else {}
    for path in sorted((study.out / "runs").glob("p*/*/config.json")):
        config = json.loads(path.read_text())
        wanted = ["command_line", "started", *(["settings"] if path.parts[-3] == "policies" else [])]
        wanted += ["versions"] * (config["versions"] != collected["versions"])
        runs[f"{path.parts[-3]}/{path.parts[-2]}"] = {name: config[name] for name in wanted}
    return {"collected": collected, "runs": dict(sorted(runs.items()))}
