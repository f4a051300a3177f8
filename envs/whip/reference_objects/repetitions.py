"""Policies on the reference objects, again and again at displaced places: who hits, how cleanly, and where not."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from jaxlfi.envs.mujoco import logs
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS
from jaxlfi.envs.whip.reference_objects.deployment import Act, Deployed, deploy, places
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.observation import Perception
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.io import files
from jaxlfi.io.host_devices import processors
from jaxlfi.rl import policy as policies

PLANNED = (".csv", ".mcap")
"""Endings of files of planned actions, besides .npz."""
RATES = ("hit", "clean_hit", "settled_hit", "settled_clean", "outside", "failed")
"""Columns of which tables have means."""
COLUMNS = (
    "policy",
    "object",
    "place",
    "return",
    "hit",
    "clean_hit",
    "outside",
    "failed",
    "steps",
    "settled_hit",
    "settled_clean",
    "displaced",
)


def acting(word: str) -> Callable[[], Act]:
    """How to act by "constant:DX,DZ" (m), a policy's file, or open loop by one of planned actions (`actions_of`).

    Returns:
        What begins an episode: a function of no arguments that returns the policy.

    Raises:
        ValueError: for anything else, and policies of another environment.
    """
    if word.startswith("constant:"):
        try:
            action = np.array([float(number) for number in word.removeprefix("constant:").split(",")])
        except ValueError:
            action = np.zeros(0)
        if action.shape != (2,) or not (np.abs(action) <= rules.ACTION_LIMIT).all():
            raise ValueError(f"policy: expected constant:DX,DZ of at most {rules.ACTION_LIMIT} m, got {word!r}")
        return lambda: lambda observation: action
    if Path(word).suffix in PLANNED or "actions" in files.read_arrays(Path(word)):
        plan = np.clip(actions_of(word), -rules.ACTION_LIMIT, rules.ACTION_LIMIT)

        def begin() -> Act:
            steps = iter(plan)
            return lambda observation: next(steps)

        return begin
    policy = policies.load(word).require("whip", OBSERVATIONS, ACTIONS)
    return lambda: policy


def actions_of(path: str | Path) -> np.ndarray:
    """Actions of a file, in m, shape [16, 2].

    Args:
        path: an .npz with an array "actions", such as a plan, a rollout or a recording; or a .csv or .mcap with signals
            dx and dz, such as `jaxlfi design` writes.

    Raises:
        ValueError: for a file without them, another shape, other times, and numbers that are not finite.
        ImportError: for an .mcap without the extra `robotics`.
    """
    if Path(path).suffix in PLANNED:
        return _planned(path)
    actions = files.read_arrays(Path(path)).get("actions")
    if actions is None or actions.shape != (rules.STEPS, 2) or actions.dtype.kind not in "fiu":
        got = "none" if actions is None else f"{actions.dtype} of shape {list(actions.shape)}"
        raise ValueError(f"policy: expected an array actions of shape [{rules.STEPS}, 2] in {path}, got {got}")
    if not np.isfinite(actions).all():
        raise ValueError(f"policy: expected finite actions in {path}, got some that are not")
    return actions


def _planned(path: str | Path) -> np.ndarray:
    log = logs.read(path)
    if missing := [name for name in ACTIONS.names if name not in log.signals]:
        raise ValueError(f"policy: expected signals {' and '.join(ACTIONS.names)} in {path}, got no {missing[0]}")
    samples = [log.samples(name) for name in ACTIONS.names]
    begin = CONTROL_INTERVAL * np.arange(rules.STEPS)
    if any(len(times) != rules.STEPS or np.abs(times - begin).max() > 1e-3 for times, _ in samples):
        raise ValueError(f"policy: expected {rules.STEPS} actions in {path}, {CONTROL_INTERVAL} s apart, got others")
    return np.stack([values for _, values in samples], axis=-1)


Case = TypeVar("Case")
Made = TypeVar("Made")


def episodes(cases: Iterable[Case], of: Callable[[Case], Made]) -> list[Made]:
    """An episode of each case, in their order, as many at a time as there are processors."""
    with ThreadPoolExecutor(processors()) as pool:  # MuJoCo steps without Python's lock
        return list(pool.map(of, cases))


def repeat(
    key: jax.Array,
    begins: Mapping[str, Callable[[], Act]],
    objects: Sequence[ReferenceObject],
    n: int,
    on_episode: Callable[[], Any] = lambda: None,
    perceptions: Callable[[jax.Array], Perception | None] = lambda key: None,
) -> list[dict[str, Any]]:
    """Every policy on every object at the same n places, which are displaced as in training but for the first.

    Args:
        key: of places and camera noise; the same in all of them.
        begins: what begins an episode of each policy, by name.
        objects: to act on.
        n: how many places.
        on_episode: called after each episode.
        perceptions: makes of an episode's key what finds keypoints in its frames; by default `observation.found` does.

    Returns:
        A row for each episode, by `COLUMNS`.
    """
    key_places, key_noise = jax.random.split(key)
    scenes, cameras = places(key_places, n)
    keys = list(jax.random.split(key_noise, n))

    def episode(case: tuple[str, ReferenceObject, int]) -> dict[str, Any]:
        name, dlo, place = case
        perception = perceptions(jax.random.fold_in(keys[place], 2**31 - 1))  # far from the frames' indices
        one = deploy(keys[place], dlo, begins[name](), scenes[place], cameras[place], perception=perception)
        row = _row(name, dlo.name, place, one)
        on_episode()
        return row

    cases = [(name, dlo, place) for name in begins for dlo in objects for place in range(n)]
    return episodes(cases, episode)


def _row(name: str, dlo: str, place: int, one: Deployed) -> dict[str, Any]:
    values = (name, dlo, place, one.value, one.hit[rules.TOP], one.clean_hit, one.outside, one.failed, one.steps)
    values += (one.left.hit, one.left.clean, one.left.displaced.sum())
    return dict(zip(COLUMNS, (value.item() if hasattr(value, "item") else value for value in values), strict=True))


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Tabulate each policy on each object: mean return with standard error, worst return, rates of hits and exits."""
    pairs = dict.fromkeys((row["policy"], row["object"]) for row in rows)
    out = []
    for policy, dlo in pairs:
        own = [row for row in rows if (row["policy"], row["object"]) == (policy, dlo)]
        column = lambda name, own=own: np.array([row[name] for row in own], float)
        returns = column("return")
        out.append(
            {
                "policy": policy,
                "object": dlo,
                "return": returns.mean(),
                "error": returns.std(ddof=1) / len(own) ** 0.5 if len(own) > 1 else float("nan"),
                "worst": returns.min(),
                **{name: column(name).mean() for name in RATES},
            }
        )
    return out


def write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as csv."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files.write_bytes(path, text.getvalue().encode())
