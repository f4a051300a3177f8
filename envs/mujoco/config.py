"""The TOML file that describes a task.

model = "pendulum.xml"              # beside this file
log = ["swing.csv"]                 # recordings, one for each episode
measured = ["angle"]                # by default all signals except the controls
summary = "samples"                 # the network's input (`jaxlfi.envs.mujoco.summaries`)
windows = 12                        # cut from a long recording (`jaxlfi.envs.mujoco.windows`)
window = 2.5                        # s
unmodelled_force = 0.02             # forces that the model lacks, as a fraction of those that act on each joint

[parameters."joint/hinge/damping"]
support = [0.001, 0.01]             # Theta_0
feasible = [0.0001, 0.1]            # Phi; by default Theta_0
unit = "N m s/rad"
log = true                          # infer its logarithm

[parameters."joint/*/armature"]     # of all joints (`jaxlfi.envs.mujoco.ties`)
support = [0.5, 2.0]
tie = "scaled"                      # a common factor of their own values; or "shared", or "mirrored"

[parameters."body/link/inertial"]   # its whole inertia, ten numbers (`jaxlfi.envs.mujoco.inertia`)
spread = 0.2                        # about the model's own

[signals]                           # names, units and signs in the recording (`jaxlfi.envs.mujoco.renaming`)
"q1" = { name = "angle", unit = "deg" }

[noise]                             # standard deviations; estimated for other signals
angle = 0.002

[initial]                           # where episodes begin (`jaxlfi.envs.mujoco.starts`)
from = "log"                        # or "model", or "keyframe NAME"
"hinge/qpos" = 0.5                  # given numbers take precedence

[discrepancy]                       # the model's error: a standard deviation and a correlation time (s)
angle = { deviation = 0.01, time = 0.2 }

[supports.wide]                     # another first guess, for --support wide
"joint/hinge/damping" = [0.0001, 0.1]

[design]                            # experiments to choose among (`jaxlfi.envs.mujoco.played`), for `jaxlfi design`
duration = 3.0

[policy]                            # the policies' goal (`jaxlfi.envs.mujoco.goal`); inference ignores it
interval = 0.02

[robot.limits]                      # their limits on a robot (`jaxlfi.robots.settings`); inference ignores these, too
angle = [-1.0, 1.0]
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from jaxlfi.envs.mujoco import inertia, log_files, logs, renaming
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.tasks.task import Task

KEYS: Mapping[str, type] = {
    "model": str,
    "log": list,
    "measured": list,
    "summary": str,
    "unmodelled_force": float,
    "parameters": dict,
    "signals": dict,
    "noise": dict,
    "initial": dict,
    "discrepancy": dict,
    "supports": dict,
    "policy": dict,
    "robot": dict,
    "design": dict,
    "name": str,
    "windows": int,
    "window": float,
}
PARAMETER = ("support", "feasible", "unit", "log", "truth", "tie")


INERTIAL = ("spread", "feasible")
"""Keys of a body's whole inertia."""


def read(
    path: Path,
    recorded: Sequence[Path] = (),
    summary: str | None = None,
    engine: Literal["native", "mjx"] = "native",
) -> Task:
    """The task that a file describes.

    Args:
        path: of the file.
        recorded: recordings in place of the file's.
        summary: name of a summary in place of the file's.
        engine: what simulates the model (`model_task.mujoco_task`).

    Raises:
        ValueError: for a file that is missing, damaged or describes no task, in one line.
    """
    path = Path(path)
    config = load(path)
    several = [Path(one) for one in recorded] or [path.parent / str(one) for one in config.get("log", [])]
    if not several:
        raise ValueError(f"{path}: expected recordings, as log = [FILE], or mujoco,config={path},log=FILE; got none")
    try:
        begins, given = initial(config)
        called = renaming.table_of(config)
        recordings = [recording for one in several for recording in log_files.recorded(one)]
        return mujoco_task(
            path.parent / config["model"],
            parameters_of(config),
            [logs.log_of(one) for one in renaming.renamed(recordings, called)],
            config.get("measured"),
            numbers(config, "noise"),
            given,
            {name: _discrepancy(name, table) for name, table in config.get("discrepancy", {}).items()},
            {label: _guess(label, table) for label, table in config.get("supports", {}).items()},
            summary=summary or config.get("summary", "samples"),
            unmodelled_force=config.get("unmodelled_force", 0.0),
            engine=engine,
            begins=begins,
            windows=config.get("windows"),
            window=config.get("window"),
            design=config.get("design"),
            name=config.get("name", path.stem),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def load(path: Path) -> dict[str, Any]:
    """The tables of a file, which must include a model and parameters.

    Raises:
        ValueError: for a file that is missing or damaged, or has unknown tables.
    """
    try:
        with path.open("rb") as file:
            config = tomllib.load(file)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected a TOML file, got a missing or damaged one: {error}") from error
    for name, value in config.items():
        if name not in KEYS:
            raise ValueError(f"{path}: expected keys among {', '.join(KEYS)}, got {name!r}")
        if not isinstance(value, int | float if KEYS[name] is float else KEYS[name]) or isinstance(value, bool):
            raise ValueError(f"{path}: {name}: expected a {KEYS[name].__name__}, got {value!r}")
    for name in ("model", "parameters"):
        if not config.get(name):
            raise ValueError(f"{path}: expected {name}, got none")
    return config


def parameters_of(config: Mapping[str, Any]) -> list[Parameter]:
    """The inferred parameters.

    Raises:
        ValueError: for parameters without bounds, or with other keys.
    """
    several = (_parameters(name, table) for name, table in config["parameters"].items())
    return [one for own in several for one in own]


def numbers(config: Mapping[str, Any], table: str) -> dict[str, float]:
    """A table of numbers by name; empty where there is none.

    Raises:
        ValueError: for anything but a table of numbers.
    """
    found = config.get(table, {})
    if not isinstance(found, dict):
        raise ValueError(f"{table}: expected a table of numbers, got {found!r}")
    return {name: number(value, f"{table}: {name}") for name, value in found.items()}


def initial(config: Mapping[str, Any]) -> tuple[Any, dict[str, float | list[float]]]:
    """The table `initial`: where episodes begin (`starts.modes`), and values of the state, one for all or one for each.

    Raises:
        ValueError: for anything but a table of numbers.
    """
    table = dict(config.get("initial", {}))
    begins, given = table.pop("from", None), {}
    for name, value in table.items():
        where = f"initial: {name}"
        several = isinstance(value, list)
        given[name] = [number(one, where) for one in value] if several else number(value, where)
    return begins, given


def pair(value: Any, where: str) -> tuple[float, float]:
    """Two bounds.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{where}: expected [LOW, HIGH], got {value!r}")
    return number(value[0], where), number(value[1], where)


def number(value: Any, where: str) -> float:
    """A number.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{where}: expected a number, got {value!r}")
    return float(value)


def _parameters(name: str, table: Any) -> list[Parameter]:
    if not isinstance(table, dict) or "spread" not in table:
        return [_parameter(name, table)]
    where = f"parameters: {name!r}"
    if unknown := [key for key in table if key not in INERTIAL]:
        raise ValueError(f"{where}: expected keys among {', '.join(INERTIAL)}, got {', '.join(unknown)}")
    bounds = pair(table["feasible"], f"{where}: feasible") if "feasible" in table else None
    return inertia.parameters(name, number(table["spread"], f"{where}: spread"), bounds)


def _parameter(name: str, table: Any) -> Parameter:
    where = f"parameters: {name!r}"
    if not isinstance(table, dict) or "support" not in table:
        raise ValueError(f"{where}: expected support = [LOW, HIGH], got {table!r}")
    if unknown := [key for key in table if key not in PARAMETER]:
        raise ValueError(f"{where}: expected keys among {', '.join(PARAMETER)}, got {', '.join(unknown)}")
    bounds = {key: pair(table.get(key, table["support"]), f"{where}: {key}") for key in ("support", "feasible")}
    log, unit, truth = table.get("log", False), table.get("unit", ""), table.get("truth")
    if not isinstance(log, bool) or not isinstance(unit, str):
        raise ValueError(f"{where}: expected log = true or false and a unit in quotes, got {log!r} and {unit!r}")
    truth = None if truth is None else number(truth, f"{where}: truth")
    return Parameter(name, bounds["support"], bounds["feasible"], unit, log, truth, table.get("tie"))


def _guess(label: str, table: Any) -> dict[str, tuple[float, float]]:
    if not isinstance(table, dict):
        raise ValueError(f"supports: {label}: expected bounds [LOW, HIGH] of parameters, got {table!r}")
    return {name: pair(bounds, f"supports: {label}: {name!r}") for name, bounds in table.items()}


def _discrepancy(name: str, table: Any) -> Discrepancy:
    where = f"discrepancy: {name}"
    if not isinstance(table, dict) or set(table) != {"deviation", "time"}:
        raise ValueError(f"{where}: expected {{ deviation = NUMBER, time = SECONDS }}, got {table!r}")
    return Discrepancy(**{key: number(value, f"{where}: {key}") for key, value in table.items()})
