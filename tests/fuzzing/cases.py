"""Cases, each of its seed and number alone, and the good files that they damage."""

import contextlib
import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import jaxlfi.envs.whip
from jaxlfi.cli import commands
from jaxlfi.cli import parser as cli
from jaxlfi.cli.tables import Output
from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS
from jaxlfi.io import files
from jaxlfi.io.processes import ALONE
from jaxlfi.rl.policy import Policy
from jaxlfi.runs import execute as executing
from tests.fuzzing import words as grammar
from tests.fuzzing.damage import damaged
from tests.fuzzing.judging import Case, Reached, stubs
from tests.fuzzing.words import RIGHT, SMALL, TASK, picked

# ------------------------------------------------------------------------------------------------------- good input


def prepare(here: Path) -> None:
    """Make what is damaged later: runs, finished and stopped, and all files that a command can be given."""
    good = here / "good"
    good.mkdir(parents=True)
    with contextlib.ExitStack() as closing:
        arguments = cli.parse(["infer", TASK, *SMALL, "--out", str(good / "run")])
        arguments.closing, arguments.joined = closing, ALONE
        folder, (plan, observed) = commands.infer(arguments, Output.of(silent=True))

    def stop(index: int, row: Any) -> None:
        raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        executing.execute(plan, observed, folder, stop)
    shutil.copytree(folder, good / "stopped")
    executing.finish(folder, plan, executing.execute(plan, observed, folder))
    begun = {"compare": RIGHT["compare"], "grid": RIGHT["grid"], "train": RIGHT["train"]}
    with stubs(), mock.patch("builtins.print"):
        for name, words in begun.items():
            with contextlib.suppress(Reached):
                cli.main([name, *words[:-1], str(good / name)])
        with contextlib.suppress(Reached):
            cli.main(["diagnose", str(folder), *RIGHT["diagnose"][1:]])
    trajectory = np.asarray(observed.trajectory[0])
    files.write_arrays(good / "observation.npz", {"trajectory": trajectory})
    (good / "observation.csv").write_text("\n".join(str(value) for value in trajectory.ravel()) + "\n")
    rng = np.random.default_rng(0)
    theta = rng.uniform(-3, 3, (20, 2)).astype(np.float32)
    trajectories = rng.normal(size=(20, *trajectory.shape)).astype(np.float32)
    files.write_arrays(good / "simulations.npz", {"theta": theta, "trajectory": trajectories})
    files.write_arrays(good / "actions.npz", {"actions": np.full((16, 2), 0.01, np.float32)})
    signals = {"observations": dataclasses.asdict(OBSERVATIONS), "actions": dataclasses.asdict(ACTIONS)}
    bias = np.zeros(len(ACTIONS.names), np.float32)
    weight = np.zeros((len(OBSERVATIONS.names), len(ACTIONS.names)), np.float32)
    Policy((weight,), (bias,), {"environment": "whip", **signals}).save(good / "policy.npz")
    for suffix in (".npz", ".json"):
        shutil.copy(Path(jaxlfi.envs.whip.__file__).parent / "data" / f"dlo-0{suffix}", good / f"recording{suffix}")
    (good / "file").write_text("precious")
    (good / "nowhere").symlink_to("gone")


GIVEN = ("policy.npz", "actions.npz", "recording.npz", "recording.json")
"""Files that commands of robots are given."""


def placed(here: Path, command: str) -> None:
    """Copy what a command is given from good to own."""
    if command in grammar.OWN:
        shutil.copytree(here / "good" / ("stopped" if command in grammar.UNFINISHED else "run"), here / "own" / "run")
    elif any(word.startswith("own/") and not word.startswith("own/out") for word in RIGHT[command]):
        for name in GIVEN:
            shutil.copy(here / "good" / name, here / "own" / name)


# ------------------------------------------------------------------------------------------------------- generators


def bad_words(rng: np.random.Generator, here: Path) -> Case:
    """A command with up to three words changed, added or left out."""
    command = picked(rng, (*RIGHT, *grammar.OFTEN, *grammar.OFTEN))
    placed(here, command)
    words, what = grammar.changed(rng, command)
    return Case("words", tuple(words), what)


FOLDERS = {
    "run": ("sample", "diagnose", "report"),
    "stopped": ("resume", "resume", "report"),
    "compare": ("resume", "report"),
    "grid": ("resume", "report"),
    "train": ("resume",),
}
"""Folders of runs, and what is done with them."""


def bad_folder(rng: np.random.Generator, here: Path, suffix: str) -> Case:
    """A run's folder of which one file was changed."""
    source = picked(rng, ("run", "run", "run", "stopped", "stopped", "compare", "grid", "train"))
    command = picked(rng, FOLDERS[source])
    own = here / "own" / "run"
    shutil.copytree(here / "good" / source, own)
    found = sorted(path for path in own.rglob("*") if path.suffix.startswith(suffix))
    if command != "diagnose":
        found = [path for path in found if "diagnostics" not in path.parts]
    if suffix == ".json":  # the ledger of a run is a table beside its configuration
        found += [own / "config.json"] * 3
    path = picked(rng, found)
    what = damaged(rng, path)
    return Case("configuration" if suffix == ".json" else "arrays", (command, *RIGHT[command]), f"{source}, {what}")


def bad_configuration(rng: np.random.Generator, here: Path) -> Case:
    """A run's folder whose configuration, plan or ledger was changed."""
    return bad_folder(rng, here, ".json")


def bad_arrays(rng: np.random.Generator, here: Path) -> Case:
    """A run's folder of which one array file was changed; resumed to its end."""
    case = bad_folder(rng, here, ".npz")
    return dataclasses.replace(case, work=case.words[0] == "resume" and case.what.startswith("stopped"))


OBSERVATIONS_OF = {
    "--observation": ("infer", "observation.npz", "observation.csv"),
    "--simulations": ("infer", "simulations.npz"),
    "--against": ("diagnose", "observation.csv", "simulations.npz"),
}
"""Flags of files that were measured or simulated, their commands, and such files."""


def bad_observation(rng: np.random.Generator, here: Path) -> Case:
    """Files for `--observation` and `--simulations`, and samples to compare with."""
    flag = picked(rng, ("--observation", "--observation", "--simulations", "--against"))
    command, *names = OBSERVATIONS_OF[flag]
    placed(here, command)
    own = shutil.copy(here / "good" / picked(rng, names), here / "own")
    what = damaged(rng, Path(own))
    if rng.random() < 0.1:
        own = Path(own).rename(here / "own" / f"..[x]{picked(rng, ('.txt', '.NPZ', '', '.npz.csv', '.csv'))}")
    words = (command, *RIGHT[command], flag, f"own/{Path(own).name}")
    return Case("observations", words, f"{flag} {what}", work=flag == "--observation")


def bad_robotics(rng: np.random.Generator, here: Path) -> Case:
    """Policies, actions and recordings that were changed, for the commands of robots."""
    uses = {name: [one for one in RIGHT if f"own/{name}" in RIGHT[one]] for name in GIVEN[:-1]}
    uses["recording.json"] = uses["recording.npz"]
    name = picked(rng, GIVEN)
    command = picked(rng, uses[name])
    placed(here, command)
    return Case("robotics", (*command.split(), *RIGHT[command]), damaged(rng, here / "own" / name))


KINDS: tuple[Callable[[np.random.Generator, Path], Case], ...] = (
    bad_words, bad_configuration, bad_words, bad_arrays, bad_words, bad_observation, bad_robotics,
)  # fmt: skip
"""Generators, in turn."""


def made(seed: int, number: int, here: Path) -> Case:
    """A case's files below the folder `own`, and its words."""
    shutil.rmtree(here / "own", ignore_errors=True)
    (here / "own").mkdir()
    case = KINDS[number % len(KINDS)](np.random.default_rng([seed, number]), here)
    return dataclasses.replace(case, drawn=number % 10 == 0)
