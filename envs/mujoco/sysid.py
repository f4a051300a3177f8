"""Tasks from what a user of `mujoco.sysid` has: its parameters, and its measured sequences."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import noise as noises
from jaxlfi.envs.mujoco import plausible, recordings
from jaxlfi.envs.mujoco.columns import controls_of, warn_of_clamped
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.measured import signals_of
from jaxlfi.envs.mujoco.model_task import task_of
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import Simulator
from jaxlfi.tasks.task import Task


def from_sysid(
    parameters: Any,
    sequences: Any,
    build_model: Callable[[Any, mujoco.MjSpec], mujoco.MjModel] | None = None,
    feasible: Mapping[str, tuple[float, float]] | None = None,
    log: Sequence[str] = (),
    units: Mapping[str, str] | None = None,
    noise: Mapping[str, float] | None = None,
    **others: Any,
) -> Task:
    """Infer the parameters that `mujoco.sysid.optimize` would be given, from the same recordings.

    Args:
        parameters: a `sysid.ParameterDict`; what is frozen keeps its value. Bounds are those of Theta_0. A parameter of
            n numbers is n parameters here, NAME[0] to NAME[n - 1].
        sequences: a `sysid.ModelSequences`, all of whose sequences are of these parameters.
        build_model: from parameters and a specification to a model, as sysid's `build_residual_fn` takes it; by default
            the parameters' own modifiers are applied.
        feasible: bounds in Phi by name; by default those of Theta_0, which then cannot grow.
        log: names of the parameters inferred as logarithms.
        units: by name.
        noise: standard deviations of the sensors' noise, by sensor or by its number, as "imu[2]". Others are estimated
            from the first sequence.
        **others: of `mujoco_task`'s `summary`, `threads` and `unmodelled_force`, and of `jaxlfi.Task`.

    Raises:
        ValueError: for names that are not known, and recordings that do not fit the model, in one line.

    Example:
        >>> from mujoco import sysid                                                          # doctest: +SKIP
        >>> task = from_sysid(params, sysid.ModelSequences("arm", spec, "swing", state, control, sensordata),
        ...                   feasible={"damping": (1e-3, 1.0)}, log=["damping"])             # doctest: +SKIP
    """
    free = [one for one in parameters.values() if not one.frozen]
    if not free:
        raise ValueError("parameters: expected one that is not frozen, got none")
    names = [name for one in free for name in _numbers(one.name, one.size)]
    low, high = (
        np.concatenate([np.ravel(bound) for bound in bounds]) for bounds in zip(*map(_bounds, free), strict=True)
    )
    for given in (feasible or {}, log, units or {}):
        if unknown := [name for name in given if name not in names]:
            raise ValueError(f"parameters: expected some of {', '.join(names)}, got {', '.join(unknown)}")
    spec, model = sequences.spec, sequences.gt_model
    signals = signals_of(model)
    episodes = [
        _log(f"{sequences.name}/{name}", control, sensed, model, signals)
        for name, control, sensed in zip(sequences.sequence_name, sequences.control, sequences.sensordata, strict=True)
    ]
    starts = sequences.initial_state
    several = zip(episodes, starts, strict=True)
    episodes = [recordings.prepared(model, log, signals, np.asarray(start)) for log, start in several]
    deviations = {name: _deviation(name, noise or {}, episodes[0]) for name in signals}
    for log, start in zip(episodes, starts, strict=True):
        plausible.check_start(model, log, signals, deviations, [plausible.sensed(model, np.asarray(start))])

    def build(theta: np.ndarray) -> mujoco.MjModel:
        own = parameters.copy()  # modifiers read their values
        own.update_from_vector(np.asarray(theta, float))
        changed = spec.copy()
        if build_model is not None:
            return build_model(own, changed)
        for one in own.values():
            if not one.frozen:
                one.apply_modifier(changed)
        return changed.compile()

    bounds = zip(names, low, high, strict=True)
    doubted = [
        Parameter(name, (float(a), float(b)), (feasible or {}).get(name), (units or {}).get(name, ""), name in log)
        for name, a, b in bounds
    ]
    summary, threads = others.pop("summary", "samples"), others.pop("threads", None)
    unmodelled_force = others.pop("unmodelled_force", 0.0)
    simulator = Simulator(model, build, episodes, signals, deviations, starts, threads=threads)
    for log in episodes:
        warn_of_clamped(log, model, names)
    others = {"name": sequences.name} | others
    return task_of(simulator, doubted, signals, summary, unmodelled_force=unmodelled_force, **others)


def _numbers(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}[{i}]" for i in range(count)]


def _bounds(one: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(one.min_value, float), np.asarray(one.max_value, float)


def _log(name: str, control: Any, sensed: Any, model: mujoco.MjModel, signals: Sequence[str]) -> Log:
    """A sequence as a recording; its controls and sensors may have clocks of their own."""
    times = np.unique(np.concatenate([control.times, sensed.times]))
    columns = {}
    for names, series in ((controls_of(model), control), (signals, sensed)):
        values = np.asarray(series.data, float).reshape(len(series.times), -1)
        if values.shape[1] != len(names):
            raise ValueError(f"{name}: expected {len(names)} numbers at a time, got {values.shape[1]}")
        for own, column in zip(names, values.T, strict=True):
            columns[own] = np.full(len(times), np.nan)
            columns[own][np.searchsorted(times, series.times)] = column
    return Log(times, columns, name)


def _deviation(name: str, given: Mapping[str, float], log: Log) -> float:
    for key in (name, name.rpartition("[")[0]):
        if key in given:
            return float(given[key])
    try:
        return noises.standard_deviation(log.signals[name])
    except ValueError as error:
        raise ValueError(f"noise: {name}: {error}") from error
