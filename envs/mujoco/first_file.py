"""A first version of a task's file: recordings and their signals, noise, and candidate parameters of the model."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import candidates, columns, measured, plausible, starts
from jaxlfi.envs.mujoco.candidates import Candidate
from jaxlfi.envs.mujoco.inspection import Inspected, together
from jaxlfi.envs.mujoco.log_files import TIME
from jaxlfi.envs.mujoco.model_task import compile_spec
from jaxlfi.envs.mujoco.renaming import Called

FIRST = 8
"""Samples at the beginning of a recording that the initial velocity is estimated from."""


def text(path: Path, spec: mujoco.MjSpec, model: Path, logs: Sequence[Path], several: Sequence[Inspected]) -> str:
    """The text of the file.

    Args:
        path: of the file; it gives other paths relative to its own.
        spec: of the model.
        model: its file.
        logs: paths of the recordings.
        several: the inspected recordings.
    """
    relative = lambda other: Path(os.path.relpath(other, path.parent)).as_posix()
    compared = list(dict.fromkeys(name for one in several for name in one.measured))
    deviations = _deviations(several)
    resting = [name for name in compared if name not in deviations]
    own = spec.copy()
    measured.add_sensors(own, compared)
    sensing = compile_spec(own)
    parameters = candidates.candidates(spec, sensing, [one.log for one in several], list(deviations))
    lines = [
        "# A first version of the task. Parameters that are switched off begin with # and no space: remove the # to",
        "# infer them too. Check all bounds: support is the first guess, feasible is what is physically possible.",
        f"model = {_quoted(relative(model))}",
        f"log = [{', '.join(_quoted(relative(one)) for one in logs)}]",
        f"{'' if deviations else '#'}measured = [{', '.join(map(_quoted, deviations))}]",
        *([f"# not measured, as they are constant or have too few samples: {', '.join(resting)}"] if resting else []),
        "",
        *_signals(several),
        *_noise(deviations),
        *_initial(sensing, several, compared),
        *(line for one in parameters for line in _parameter(one)),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _signals(several: Sequence[Inspected]) -> Iterator[str]:
    """The table of names, units and signs."""
    called = {name: signal.called for name, signal in together(several).items() if signal.called}
    if times := [one.time for one in several if one.time]:
        called[TIME] = times[0]
    unknown = [signal for name, signal in together(several).items() if signal.place is None and name not in called]
    opposite = dict.fromkeys(name for one in several for name in one.opposite)
    if not called and not unknown and not opposite:
        return
    yield "[signals]                           # what recordings call them, and what they are in the model"
    for name, own in called.items():
        yield f"{_key(name)} = {_entry(own)}"
    if len(opposite) > 1:
        yield "# One of these seems to count the other way round than in the model:"
    for name in opposite:
        yield f"#{_key(name)} = {_entry(called.get(name, Called())._replace(scale=-1.0))}"
    for signal in unknown:
        near = _quoted(signal.nearest[0] if signal.nearest else "NAME")
        both = f'{{ name = {near}, unit = "UNIT" }}'
        yield f"#{_key(signal.name)} = {near if signal.unit else both}"
    yield ""


def _entry(own: Called) -> str:
    """The table's entry for one signal."""
    if not own.read:
        return "false"
    words = {key: _quoted(value) for key, value in (("name", own.name), ("unit", own.unit)) if value}
    numbers = {"scale": own.scale} if own.scale != 1 else {}
    if own.name and not (own.unit or numbers):
        return words["name"]
    return f"{{ {', '.join(f'{key} = {value}' for key, value in (words | numbers).items())} }}"


def _deviations(several: Sequence[Inspected]) -> dict[str, float]:
    """The noise of compared signals; components of an orientation share one value, as some may hardly change."""
    own = {name for one in several for name in one.measured}
    found = {
        place.name: signal.noise
        for signal in together(several).values()
        if (place := signal.place) is not None and place.name in own
    }
    groups: dict[str, list[str]] = {}
    for name in found:
        match = columns.INDEXED.fullmatch(name)
        groups.setdefault(match["sensor"] if match else name, []).append(name)
    for names in groups.values():
        known = [noise for name in names if (noise := found[name]) is not None]
        if len(names) == 4 and known:
            found |= dict.fromkeys(names, max(known))
    return {name: noise for name, noise in found.items() if noise is not None}


def _noise(deviations: Mapping[str, float]) -> Iterator[str]:
    if deviations:
        yield "[noise]                             # standard deviations, estimated from the recordings"
        yield from (f"{_key(name)} = {deviation:.2g}" for name, deviation in deviations.items())
        yield ""


def _initial(model: mujoco.MjModel, several: Sequence[Inspected], compared: Sequence[str]) -> Iterator[str]:
    """The initial state of joints whose positions are measured, if recordings do not begin where the model does."""
    begun = [_beginning(model, one, compared) for one in several]
    first = begun[0]
    if not any(begun):
        return
    if all(not starts.unmeasured(model, one.measured, []) for one in several):
        yield "[initial]"
        yield 'from = "log"                        # where recordings begin, as the model begins elsewhere'
        yield ""
        return
    if not first:
        return
    same = all(
        one.keys() == first.keys() and np.allclose([*one.values()], [*first.values()], atol=0.05) for one in begun
    )
    yield "[initial]                           # where the recording begins, as the model begins elsewhere"
    if not same:
        yield "# The recordings begin in different states, and an episode of each begins in this one."
    for name, value in first.items():
        yield f"{_key(name)} = {value:.4g}"
    yield ""


def _beginning(model: mujoco.MjModel, one: Inspected, compared: Sequence[str]) -> Mapping[str, float]:
    """Positions and velocities that differ from the model's at the first sample by more than noise."""
    data, found = mujoco.MjData(model), {}
    deviations = {place.name: signal.noise for signal in one.signals.values() if (place := signal.place)}
    for name in compared:
        kind, item = measured.of_sensor(model, name)
        if kind != mujoco.mjtSensor.mjSENS_JOINTPOS or name not in one.log.signals:
            continue
        times, values = one.log.samples(name)
        noise, joint = deviations.get(name) or 0.0, model.joint(item).name
        if len(values) < FIRST or not joint:
            continue
        if abs(values[0] - data.qpos[model.jnt_qposadr[item]]) > plausible.FAR * noise:
            found[f"{joint}/qpos"] = float(values[0])
        velocity, deviation = _velocity(times[:FIRST], values[:FIRST], noise)
        if abs(velocity) > plausible.FAR * deviation:
            found[f"{joint}/qvel"] = velocity
    return found


def _velocity(times: np.ndarray, values: np.ndarray, noise: float) -> tuple[float, float]:
    """The velocity at the first sample by a parabola through some samples, and its standard deviation."""
    rows = np.vander(times - times[0], 3)
    inverse = np.linalg.pinv(rows)
    return float(inverse[1] @ values), noise * float(np.linalg.norm(inverse[1]))


def _parameter(one: Candidate) -> Iterator[str]:
    mark = "" if one.chosen else "#"
    yield f"{mark}[parameters.{_quoted(one.name)}]".ljust(60) + f"# {one.now:.4g} in the model"
    yield f"{mark}support = {_bounds(one.support)}"
    yield f"{mark}feasible = {_bounds(one.feasible)}"
    if one.unit:
        yield f"{mark}unit = {_quoted(one.unit)}"
    if one.log:
        yield f"{mark}log = true"
    yield ""


def _bounds(pair: tuple[float, float]) -> str:
    return f"[{pair[0]:.4g}, {pair[1]:.4g}]"


def _key(name: str) -> str:
    """A key of a TOML file, quoted unless it is a plain word."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _quoted(name)


def _quoted(value: str) -> str:
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
