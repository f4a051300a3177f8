"""Command lines with something wrong in them: right words of every command, and what they are replaced by."""

import argparse
from typing import Any

import numpy as np

from jaxlfi.cli import evaluate, export, train
from jaxlfi.cli import parser as core
from jaxlfi.envs.whip import cli as whip
from jaxlfi.envs.whip import r2s2r

TASK, HOST = "gaussian_linear", "tests.fuzzing.words:on_host"
SMALL = (
    "--estimator mdn --hidden 16 --ensemble-size 1 --components 2 --rounds 2 --min-rounds 0 "
    "--simulations-per-round 20 --steps 20 --no-cache --no-figures"
).split()
"""Settings whose training compiles in seconds."""
OUT = "own/out"
RIGHT: dict[str, list[str]] = {
    "tasks": [TASK],
    "infer": [TASK, *SMALL, "--out", OUT],
    "compare": [TASK, *SMALL, "--out", OUT],
    "grid": [TASK, *SMALL, "--vary", "expansion=0.1,0.2", "--out", OUT],
    "resume": ["own/run", "--no-figures"],
    "sample": ["own/run", "-n", "3"],
    "diagnose": ["own/run", "--truths", "20", "--no-figures"],
    "report": ["own/run"],
    "train": ["whip", "--domain", "uniform", "--no-figures", "--out", OUT],
    "evaluate": ["whip", "own/policy.npz", "--domain", "uniform", "median", "--episodes", "2", "--out", f"{OUT}.csv"],
    "export": ["own/policy.npz", "--out", f"{OUT}.npz"],
    "r2s2r": ["--object", "dlo-0", "--policy", "own/policy.npz", "--recording", "own/recording.npz", "--out", OUT],
    "whip render": ["--policy", "own/actions.npz", "--out", OUT],
    "whip plan": ["--out", f"{OUT}.npz"],
    "whip deploy": ["own/policy.npz", "constant:0.03,-0.03", "--object", "dlo-0", "--out", OUT],
    "whip control": ["own/policy.npz", "--robot", "dlo-0", "--out", f"{OUT}.npz"],
    "whip pictures": ["--count", "2", "--out", OUT],
    "whip import-pictures": ["--yolo", "own", "--images", "own", "--out", OUT],
    "whip train-vision": ["--steps", "2", "--only", "segmenter", "--out", OUT],
    "whip export-vision": ["--out", f"{OUT}.onnx"],
    "whip record": ["--object", "dlo-0", "--actions", "own/actions.npz", "--out", f"{OUT}.npz"],
    "whip convert": ["own/recording.npz", f"{OUT}.npz"],
}
"""Every command, and words for it that are right."""
OFTEN = ("infer", "compare", "grid", "sample", "diagnose", "train")
"""Commands with many flags."""
UNFINISHED = ("resume",)
"""Commands on a run that is not finished."""
OWN = ("resume", "sample", "diagnose", "report")
"""Commands that write into the folder they are given."""

NUMBERS = (
    "-1", "0", "1", "2", "3", "7", "0.5", "1.5", "1e-3", "1e-320", "1e38", "nan", "inf", "-inf", "1e400", "-0",
    "100000",
    "2147483647", "2147483648", "4294967296", "9223372036854775807", "-9223372036854775809", "9" * 30,
    "9" * 5000, "0x10",
    "1_0", "٣", "1,2", "",
)  # fmt: skip
VALUES = (
    *NUMBERS, " ", "true", "None", "null", "[]", "{}", "[/x]", "[bold]", "[red]x[/red]", "é", "名前", "🦾",
    "\udcff", "a\nb",
    "a\tb", "a\0b", "\x1b[31m", "%s", "%(prog)s", "{0}", "$HOME", "..", "../..", "../../etc/passwd", "/",
    "/etc/passwd", "~",
    "a/b", "a\\b", "-", "--", "-x", "--rounds", "x" * 300, "x" * 5000, "ok", "edge", "ok+edge", "ok+", "+",
    "ok+edge+mode",
    "none", "mdn", "maf", "nsf", "mdn_likelihood", "ok+../..", "..+edge", ":", "a:b", "os:system", "builtins:dict",
    "json:loads", "os.path:join", "=", "a=b", "expansion=", "expansion=nan,1", "expansion=0.1,0.2",
    "expansion=1,1", "tail=a",
    "=1", "tail=1,1", "posterior", "posterior,posterior", "posterior,ok", ",", ",,", "good", "good/run",
    "good/file", "own",
    "good/nowhere", "own/policy.npz", "own/recording.npz", "own/actions.npz", "good/observation.npz",
    "good/observation.csv",
    "good/simulations.npz", "uniform", "uniform:x", "median", "median:1", "point:1", "point:nan,1", "point:200,1e5",
    "point:", "constant:1", "constant:nan,nan", "dlo-0", "dlo-9", "socket://", "socket://x", "socket://127.0.0.1:1",
    "socket://127.0.0.1:99999", "tcp://127.0.0.1:1", "own/recording.npz#episode=1", "red=dlo", "whip,detector=clean",
)  # fmt: skip
"""Values for any flag; by chance some are right."""
TASKS = (
    TASK, HOST, "", ",", "gaussian_linear,", "gaussian_linear,trials=0", "gaussian_linear,trials=x",
    "gaussian_linear,trials",
    "gaussian_linear,trials=1001", "gaussian_linear,pooling=x,trials=2", "gaussian_linear,a=b", "gaussian",
    "[/x]", "..",
    "gaussian_linear,=", "gaussian_linear,trials=2,trials=3", ":", "a:", ":b", "a:b:c", "os:getcwd", "os:path",
    "json:x",
    "builtins:exit", "builtins:open", "jaxlfi.envs.gaussian_linear:task", "jaxlfi.envs.gaussian_linear:nothing", "..:x",
    "lynx_hare", "mg1", "whip", "whip,object=x", "mujoco", "mujoco,config=x", "x" * 5000, "\0", "\udcff",
    "gaussian_linear;x",
    "/etc/passwd",
)  # fmt: skip
"""Names of tasks and environments, right and wrong."""
PLACES = (
    "good/file", "good/run", "good/nowhere", "", ".", "own/a/../out", "own/" + "x" * 300, "own/[/x]",
    "own/é\udcff", "own/a\0b",
    "/dev/null/x", "/proc/x", "good/file/x", "-", "own/名前", "..", "../new", "own/run", "own/new/deep", "own/out.npz",
    "own/out.csv", "own/out.nc", "own/out.onnx", "own/out.mcap", "own/policy.npz", "own",
)  # fmt: skip
"""Values for --out."""


def on_host():
    """The task with a host simulator and an observation, for `--workers` and `--scheduler`."""
    import dataclasses

    from jaxlfi import HostSimulator
    from jaxlfi.envs import gaussian_linear

    simulate = HostSimulator(lambda rng, theta: theta + rng.normal(size=theta.shape))
    return dataclasses.replace(gaussian_linear.task(), simulate=simulate, truth=None, observation=[0.8, -0.6])


def picked(rng: np.random.Generator, values: Any) -> Any:
    """One of several, evenly."""
    return values[int(rng.integers(len(values)))]


def parser_of(command: str) -> argparse.ArgumentParser:
    """The parser of a command's words."""
    others = {"train": train, "evaluate": evaluate, "export": export, "r2s2r": r2s2r}
    if command in others:
        return others[command].parser()
    program, _, name = command.rpartition(" ")
    return (whip if program else core).parser()._subparsers._group_actions[0].choices[name]


def flags_of(command: str) -> list[argparse.Action]:
    """Flags of a command but --debug, which is meant to show tracebacks."""
    return [one for one in parser_of(command)._actions if one.option_strings and "--debug" not in one.option_strings]


def value_for(rng: np.random.Generator, action: argparse.Action) -> str:
    """A value for a flag: of its kind, or any."""
    if action.choices and rng.random() < 0.5:
        return picked(rng, tuple(map(str, action.choices)))
    if action.dest == "out" and rng.random() < 0.9:
        return picked(rng, PLACES)
    return picked(rng, NUMBERS if action.type in (int, float) and rng.random() < 0.7 else VALUES)


def changed(rng: np.random.Generator, command: str) -> tuple[list[str], str]:
    """A command's words with up to three of them changed, added or left out; in words, which."""
    words, what = [*command.split(), *RIGHT[command]], []
    first = len(command.split())
    for _ in range(int(rng.integers(1, 4))):
        way = picked(rng, ("flag",) * 5 + ("value", "drop", "task", "host", "extra"))
        if way == "flag":
            action = picked(rng, flags_of(command))
            counts = {None: (1,), "+": (1, 2, 3), 0: (0,)}.get(action.nargs, (action.nargs, 1))
            values = [value_for(rng, action) for _ in range(picked(rng, counts))]
            flag = picked(rng, action.option_strings)
            words += [f"{flag}={values[0]}"] if len(values) == 1 and rng.random() < 0.5 else [flag, *values]
            what.append(flag)
        elif way == "value" and len(words) > first:
            index = int(rng.integers(first, len(words)))
            words[index] = picked(rng, VALUES)
            what.append(f"word {index}")
        elif way == "drop" and words:
            del words[int(rng.integers(len(words)))]
            what.append("a word less")
        elif way in ("task", "host") and command in ("tasks", "infer", "compare", "grid", "train", "evaluate"):
            words[1:2] = [HOST if way == "host" else picked(rng, TASKS)]
            what.append(way)
        elif way == "extra":
            words.insert(int(rng.integers(len(words) + 1)), picked(rng, VALUES))
            what.append("a word more")
    return words, ", ".join(what) or "nothing"
