"""An inference task of a MuJoCo model: its unknown parameters, and recordings of the real system."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import mujoco
import numpy as np

from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import (
    columns,
    logs,
    noise,
    plausible,
    played,
    recordings,
    stand_in,
    starts,
    summaries,
    visuals,
)
from jaxlfi.envs.mujoco import windows as cuts
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.effects import Effects, built, effects, sensed_by
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.polish import polish
from jaxlfi.envs.mujoco.simulator import FAILURES, Simulator, simulator_of
from jaxlfi.envs.mujoco.starts import Start
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

JITTERS = 5
"""Bound on the jitter of controls, in standard deviations."""
ENGINES = ("native", "mjx")
"""Names of the physics engines."""


def mujoco_task(
    model: str | Path | mujoco.MjSpec,
    parameters: Sequence[Parameter],
    recorded: Sequence[Log | str | Path] | Log | str | Path,
    measured: Sequence[str] | None = None,
    noises: Mapping[str, float] | None = None,
    initial: Mapping[str, float | Sequence[float]] | None = None,
    discrepancies: Mapping[str, Discrepancy] | None = None,
    supports: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    summary: str | Callable[[jax.Array], jax.Array] = "samples",
    threads: int | None = None,
    unmodelled_force: float = 0.0,
    engine: Literal["native", "mjx"] = "native",
    design: Mapping[str, Any] | None = None,
    begins: str | Sequence[str] | None = None,
    windows: int | None = None,
    window: float | None = None,
    **others: Any,
) -> Task:
    """Infer numbers of a MuJoCo model from recordings of controls and sensors.

    A trajectory has a row for each time of the recordings at which something was measured, episodes one after another,
    and a column for each measured signal; what was not sampled is 0, in simulations too. All episodes have the same
    parameters, and each begins where its recording does (`starts`). Angles that wrap and orientations are corrected
    first (`recordings`); a `logs.RecordingWarning` reports that, and what looks wrong (`plausible`).

    Args:
        model: an MJCF file, its text, or a specification.
        parameters: what is inferred (`parameters.Parameter`).
        recorded: recordings, or their files (`logs`): one for each episode. Signals that are called as the model's
            actuators are its controls, held between samples (`columns`).
        measured: signals that are compared: sensors of the model, and joint/NAME/qpos, joint/NAME/qvel,
            body/NAME/pos[0], body/NAME/quat[0]. By default all of the recording but its controls.
        noises: standard deviations of the signals' noise. Others are estimated from the first recording.
        initial: values of the initial state by JOINT/qpos and JOINT/qvel: one for all episodes or one for each.
        discrepancies: model errors of signals, beyond their noise; `least_squares` estimates them.
        supports: other first guesses by name: the bounds of some parameters; others keep their `support`.
        summary: what the network sees, by its name (`summaries`); or as for `jaxlfi.Task`.
        threads: number of threads for simulations; by default one per processor.
        unmodelled_force: size of the forces that the model lacks, as a fraction of the forces on each joint at the
            centre of Theta_0. Each simulation draws its own springs, dampers and dry friction with that standard
            deviation (`forces`); `least_squares` estimates it.
        engine: "native" is MuJoCo on all CPU cores, in double precision; "mjx" is MuJoCo in JAX, in single precision
            and inside compiled programs, if it can simulate the model (`mjx_simulator`).
        design: candidates for the next experiment, as in the table of the TOML file (`played`); MuJoCo itself simulates
            them.
        begins: where episodes begin (`starts`): "log", "model" or "keyframe NAME", for all episodes or for each; by
            default where the recording does, if it measures all joints.
        windows: number of windows that each recording is cut into, each an episode with its own start (`windows`); by
            default only recordings of many steps are cut.
        window: duration of each window, in s; by default a few periods of the motion.
        **others: of `jaxlfi.Task`.

    Raises:
        ValueError: for inconsistent input, in one line, before anything is simulated.
        ImportError: for the engine "mjx" where MJX is not installed.
    """
    if engine not in ENGINES:
        raise ValueError(f"engine: expected one of {', '.join(ENGINES)}, got {engine!r}")
    spec = specification(model)
    several = [recorded] if isinstance(recorded, Log | str | Path) else list(recorded)
    if not several or not parameters:
        raise ValueError("expected at least one recording and one parameter, got none")
    episodes = [log for one in several for log in ([one] if isinstance(one, Log) else logs.read_all(one))]
    actuators, sensors = ([one.name for one in several] for several in (spec.actuators, spec.sensors))
    episodes = [recordings.renamed(one, [*sensors, *actuators, *(measured or ())]) for one in episodes]
    episodes = [columns.arranged(one, actuators, sensors) for one in episodes]
    noises = columns.by_signal(noises, sensors, "noises")
    discrepancies = columns.by_signal(discrepancies, sensors, "discrepancy")
    if measured is None:
        controls = columns.control_names(actuators, sensors)
        measured = [name for name in episodes[0].signals if name not in controls]
    measured = [columns.signal_name(name, sensors) for name in measured]
    if not measured or len(set(measured)) < len(measured):
        raise ValueError(f"measured: expected at least one signal, each once, got {', '.join(measured) or 'none'}")
    names = [one.name for one in parameters]
    columns.require_measured(episodes[0], measured, actuators)
    inferred = {measured[i] for name in _of_sensors(names, "noise") for i in sensed_by(name, measured)}
    _check_noises(episodes[0], measured, noises, inferred)
    add_sensors(spec, measured)
    late = [one.name for one in spec.sensors]
    for number in (i for name in _of_sensors(names, "delay") for i in sensed_by(name, late)):
        spec.sensors[number].delay = 0.0  # replaced by the parameter
    compiled = compile_spec(spec)
    does = effects(
        spec,
        compiled,
        names,
        [one.support for one in parameters],
        measured,
        [one.tie for one in parameters],
        len(episodes),
    )
    bare = visuals.without(spec, compiled, names)
    compiled = compiled if bare is spec else compile_spec(bare.copy())
    modes = starts.modes(begins, len(episodes))
    given = starts.given(compiled, initial or {}, len(episodes))
    own = [starts.state_of(compiled, *pair) for pair in zip(modes, given, strict=True)]
    centre = np.array([_centre(one) for one in parameters])
    episodes = [
        recordings.prepared(compiled, log, measured, does.started(state, centre, number))
        for number, (log, state) in enumerate(zip(episodes, own, strict=True))
    ]
    deviations = _deviations(episodes[0], measured, noises, inferred)
    parts, whole = None, episodes
    complete = all(name in log.signals for name in measured for log in episodes)
    asked = complete and (windows is not None or window is not None)
    if asked or (complete and cuts.wanted(compiled, episodes, measured)):
        parts = _windows(compiled, parameters, episodes, measured, deviations, does, (modes, given), windows, window)
    if parts is None:
        begun = starts.chosen(compiled, episodes, measured, deviations, own, given, modes, does)
    else:
        episodes, begun = parts

    low, high = np.array([one.feasible or one.support for one in parameters], float).T
    build = stand_in.builder(bare, does, low, high)
    if unknown := [name for name in discrepancies if name not in measured]:
        raise ValueError(f"discrepancy: expected some of {', '.join(measured)}, got {', '.join(unknown)}")
    simulator = Simulator(compiled, build, episodes, measured, deviations, begun, does, discrepancies, threads)
    simulator.look = functools.partial(built, spec, does)
    _check_starts(simulator, parameters, deviations)
    for log in whole:
        columns.warn_of_clamped(log, compiled, names)
    others = {"name": spec.modelname or "mujoco"} | others
    task = task_of(simulator, parameters, measured, summary, supports, unmodelled_force, **others)
    if design is not None:
        task = played.with_design(task, simulator_of(task), design, own[0])
    if engine == "native":
        return task
    from jaxlfi.envs.mujoco.mjx_simulator import by_mjx  # MJX is not needed otherwise

    return by_mjx(task)


def task_of(
    simulator: Simulator,
    parameters: Sequence[Parameter],
    measured: Sequence[str],
    summary: str | Callable[[jax.Array], jax.Array] = "samples",
    guesses: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    unmodelled_force: float = 0.0,
    **others: Any,
) -> Task:
    """The task of a simulator; see `mujoco_task`."""
    if not 0 <= unmodelled_force < np.inf:
        raise ValueError(f"unmodelled_force: expected a fraction of at least 0, got {unmodelled_force!r}")
    if unmodelled_force:
        centre = np.array([_centre(one) for one in parameters])
        simulator = simulator.lacking(simulator.typical_forces(centre).times(unmodelled_force))
    seen = summaries.fields(summary, simulator)
    others["settings"] = seen.pop("settings", {}) | dict(others.get("settings", {}))
    supports = {"initial": box([one.support for one in parameters])}
    for label, bounds in (guesses or {}).items():
        supports[label] = box([one.support for one in _guessed(parameters, label, bounds)])
    feasible = [one.feasible or one.support for one in parameters]
    truth = [one.truth for one in parameters]
    return Task(
        HostSimulator(simulator),
        names=[one.name for one in parameters],
        units=[one.unit for one in parameters],
        log=[one.name for one in parameters if one.log],
        supports=supports | {"feasible": box(feasible)},
        feasible=box(feasible),
        truth=None if None in truth else np.asarray(truth, np.float32),
        observation=simulator.observation,
        failures=FAILURES,
        polish=polish,
        channels=[f"{name} [{unit}]" if unit else name for name, unit in zip(measured, simulator.units, strict=True)],
        record_label="time [s]" if len(simulator.times) == 1 else None,
        times=simulator.times[0] if len(simulator.times) == 1 else None,
        **seen,
        **others,
    )


def _centre(parameter: Parameter) -> float:
    """The centre of a parameter's bounds in Theta_0, taken in inference space, in natural units."""
    low, high = parameter.support
    return float(np.sqrt(low * high)) if parameter.log else 0.5 * (low + high)


def _guessed(parameters: Sequence[Parameter], label: str, bounds: Mapping[str, tuple[float, float]]) -> list[Parameter]:
    """Parameters with other bounds of Theta_0."""
    known = [one.name for one in parameters]
    if unknown := [name for name in bounds if name not in known]:
        raise ValueError(f"supports: {label}: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    return [dataclasses.replace(one, support=bounds.get(one.name, one.support)) for one in parameters]


def specification(model: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """A model's specification, from an MJCF file or its text, or a copy of the one that is given.

    Raises:
        ValueError: if it cannot be read, in one line.
    """
    if isinstance(model, mujoco.MjSpec):
        return named(model.copy())
    text = str(model)
    try:
        if text.lstrip().startswith("<"):
            return named(mujoco.MjSpec.from_string(text))
        if not Path(text).is_file():
            raise ValueError(f"model: expected an MJCF file, got none called {text!r}")
        return named(mujoco.MjSpec.from_file(text))
    except ValueError as error:
        raise ValueError(f"model: {' '.join(str(error).split()).removeprefix('model: ')}") from error


def named(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A specification whose unnamed elements, except actuators and sensors, are named by their number."""
    for several in (spec.bodies, spec.joints, spec.geoms, spec.sites, spec.tendons, spec.equalities, spec.pairs):
        taken = {one.name for one in several}
        for number, one in enumerate(several):
            if not one.name and str(number) not in taken:
                one.name = str(number)
    return spec


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a specification.

    Raises:
        ValueError: where MuJoCo refuses it, in one line.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"model: MuJoCo refuses it: {' '.join(str(error).split())}") from error


def _of_sensors(names: Sequence[str], what: str) -> list[str]:
    """The sensors that parameters sensor/NAME/what are of."""
    parts = [name.removeprefix("sensor/").rpartition("/") for name in names if name.startswith("sensor/")]
    return [sensor for sensor, _, own in parts if own == what]


def _check_noises(log: Log, measured: Sequence[str], given: Mapping[str, float], inferred: set[str]) -> None:
    if unknown := [name for name in given if name not in measured]:
        raise ValueError(f"noises: expected some of {', '.join(measured)}, got {', '.join(unknown)}")
    for name in measured:
        if name in given and not float(given[name]) >= 0:
            raise ValueError(f"noises: {name}: expected a standard deviation of at least 0, got {given[name]}")
        if name not in log.signals and name not in {*given, *inferred}:
            raise ValueError(f"measured: expected signals of {log.name}: {', '.join(log.signals)}; got {name!r}")


def _deviations(log: Log, measured: Sequence[str], given: Mapping[str, float], inferred: set[str]) -> dict[str, float]:
    """Standard deviations of the noise of signals: given, inferred (here 0), or estimated."""
    found = {}
    for name in measured:
        if name in given:
            found[name] = float(given[name])
        elif name in inferred:
            found[name] = 0.0
        else:
            try:
                found[name] = noise.standard_deviation(log.signals[name])
            except ValueError as error:
                raise ValueError(f"noises: {name}: {error}") from error
    return found


def _windows(
    model: mujoco.MjModel,
    parameters: Sequence[Parameter],
    episodes: Sequence[Log],
    measured: Sequence[str],
    noises: Mapping[str, float],
    does: Effects,
    given: tuple[Sequence[str | None], Sequence[Mapping[int, float]]],
    count: int | None,
    duration: float | None,
) -> tuple[list[Log], list[Start]] | None:
    """Recordings and starts of windows; None for long recordings that cannot be cut, which is reported.

    Raises:
        ValueError: for requested windows that are not possible, in one line.
    """
    modes, numbers = given
    missing = starts.unmeasured(model, measured, [])
    if missing:
        reason = f"recordings that measure all joints, got none of {', '.join(missing)}"
    elif any(mode not in (None, "log") for mode in modes) or any(numbers) or does.starts or does.own_starts:
        reason = "starts that recordings say, got others in [initial] or among the parameters"
    else:
        reason = None
    if reason is not None and (count is not None or duration is not None):
        raise ValueError(f"windows: expected {reason}")
    if reason is not None:
        plausible.say(
            f"{episodes[0].name}: long recordings are cut into windows, which expect {reason}: simulated whole"
        )
        return None
    windows = cuts.windows_of(model, episodes, measured, noises, count, duration)
    bounds = [one.feasible or one.support for one in parameters]
    lead = (0.0 if does.delay is None else max(bounds[does.delay][1], 0.0)) + (
        0.0 if does.jitter is None else JITTERS * bounds[does.jitter][1]
    )
    late = {measured[signal]: bounds[d][1] for signal, d in does.lags}
    parts, times = cuts.cut(episodes, windows, measured, lead, late)
    own = starts.state_of(model, None, {})
    begun = [starts.recorded(model, episodes[one.recording], measured, noises, own, at=one.begin) for one in windows]
    rows = sum(int(np.isfinite([log.signals[name] for name in measured]).any(axis=0).sum()) for log in parts)
    cuts.said(episodes, windows, model.opt.timestep, rows)
    return parts, [dataclasses.replace(start, time=time) for start, time in zip(begun, times, strict=True)]


def _check_starts(simulator: Simulator, parameters: Sequence[Parameter], noises: Mapping[str, float]) -> None:
    """Warn where recordings begin elsewhere than the model does for any feasible parameters."""
    does, tried = simulator.does, []
    bounds = np.array([one.feasible or one.support for one in parameters])
    for theta in (np.array([_centre(one) for one in parameters]), *bounds.T):
        try:
            model = simulator.build(theta)
        except ValueError:
            continue  # such simulations fail, and are counted
        tried.append((model, theta))
    compared = [name for number, name in enumerate(simulator.signals) if number not in does.rescaled]
    for episode, log in enumerate(simulator.logs if tried else ()):
        begins = [plausible.sensed(model, simulator.begun(episode, theta)) for model, theta in tried]
        plausible.check_start(simulator.model, log, compared, noises, begins)


def box(bounds: Sequence[tuple[float, float]]) -> Support:
    """The support of these bounds."""
    return Support(*np.asarray(bounds, np.float32).T)
