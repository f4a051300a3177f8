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
from jaxlfi.envs.mujoco import columns, logs, noise, plausible, played, recordings, summaries
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.effects import built, effects, initial_state
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import FAILURES, Simulator, simulator_of
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

ENGINES = ("native", "mjx")
"""What simulates a model."""


def mujoco_task(
    model: str | Path | mujoco.MjSpec,
    parameters: Sequence[Parameter],
    recorded: Sequence[Log | str | Path] | Log | str | Path,
    measured: Sequence[str] | None = None,
    noises: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    discrepancies: Mapping[str, Discrepancy] | None = None,
    supports: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    summary: str | Callable[[jax.Array], jax.Array] = "samples",
    threads: int | None = None,
    unmodelled_force: float = 0.0,
    engine: Literal["native", "mjx"] = "native",
    design: Mapping[str, Any] | None = None,
    **others: Any,
) -> Task:
    """Infer numbers of a MuJoCo model from recordings of controls and sensors.

    A trajectory has a row for each time of the recordings at which something was measured, episodes one after another,
    and a column for each measured signal; what was not sampled is 0, in simulations too. Every episode begins in the
    same state and has the same parameters. Angles that wrap and orientations are put right first (`recordings`); that,
    and what looks wrong (`plausible`), is said in a `logs.RecordingWarning`.

    Args:
        model: an MJCF file, its text, or a specification.
        parameters: what is inferred (`parameters.Parameter`).
        recorded: recordings, or their files (`logs`): one for each episode. Signals that are called as the model's
            actuators are its controls, held between samples (`columns`).
        measured: signals that are compared: sensors of the model, and joint/NAME/qpos, joint/NAME/qvel,
            body/NAME/pos[0], body/NAME/quat[0]. By default all of the recording but its controls.
        noises: standard deviations of the signals' noise. Of others it is estimated from the first recording.
        initial: numbers of the state that episodes begin in, by JOINT/qpos and JOINT/qvel; others are the model's.
        discrepancies: what the model gets wrong of signals, beyond their noise; `least_squares` finds it.
        supports: other first guesses by name: the bounds of some parameters, those of others being their `support`.
        summary: what the network sees, by its name (`summaries`); or as for `jaxlfi.Task`.
        threads: of simulations; by default as many as processors.
        unmodelled_force: how large the forces may be that the model lacks, as a fraction of what acts on each joint at
            the centre of Theta_0. Each simulation has springs, dampers and dry friction of its own, of that standard
            deviation (`forces`); `least_squares` finds it.
        engine: "native" is MuJoCo on the processor's cores, in double precision; "mjx" is MuJoCo in JAX, in single
            precision and inside of compiled programs, where it can simulate the model (`mjx_simulator`).
        design: experiments that could be made next, as a table of the TOML file says (`played`); they are simulated by
            MuJoCo itself.
        **others: of `jaxlfi.Task`.

    Raises:
        ValueError: for whatever does not fit together, in one line, before anything is simulated.
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
    inferred = {signal for signal in measured if f"sensor/{signal.removeprefix('sensor/')}/noise" in names}
    _check_noises(episodes[0], measured, noises, inferred)
    add_sensors(spec, measured)
    compiled = compile_spec(spec)
    does = effects(spec, compiled, names, [one.support for one in parameters], measured)
    start = initial_state(compiled, initial or {})
    begins = does.started(start, np.array([_centre(one) for one in parameters]))
    episodes = [recordings.prepared(compiled, log, measured, begins) for log in episodes]
    deviations = _deviations(episodes[0], measured, noises, inferred)

    build = functools.partial(built, spec, does)
    starts = [start] * len(episodes)
    if unknown := [name for name in discrepancies if name not in measured]:
        raise ValueError(f"discrepancy: expected some of {', '.join(measured)}, got {', '.join(unknown)}")
    simulator = Simulator(compiled, build, episodes, measured, deviations, starts, does, discrepancies, threads)
    _check_starts(simulator, parameters, deviations)
    others = {"name": spec.modelname or "mujoco"} | others
    task = task_of(simulator, parameters, measured, summary, supports, unmodelled_force, **others)
    if design is not None:
        task = played.with_design(task, simulator_of(task), design, initial or {})
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
    for log in simulator.logs:
        columns.warn_of_clamped(log, simulator.model, [one.name for one in parameters])
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
        channels=[f"{name} [{unit}]" if unit else name for name, unit in zip(measured, simulator.units, strict=True)],
        record_label="time [s]" if len(simulator.times) == 1 else None,
        times=simulator.times[0] if len(simulator.times) == 1 else None,
        **seen,
        **others,
    )


def _centre(parameter: Parameter) -> float:
    """Of its bounds in Theta_0, in inference space, as a number in natural units."""
    low, high = parameter.support
    return float(np.sqrt(low * high)) if parameter.log else 0.5 * (low + high)


def _guessed(parameters: Sequence[Parameter], label: str, bounds: Mapping[str, tuple[float, float]]) -> list[Parameter]:
    """Parameters with other bounds of Theta_0."""
    known = [one.name for one in parameters]
    if unknown := [name for name in bounds if name not in known]:
        raise ValueError(f"supports: {label}: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    return [dataclasses.replace(one, support=bounds.get(one.name, one.support)) for one in parameters]


def specification(model: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """A model's specification: of an MJCF file, its text, or a copy of the one that is given.

    Raises:
        ValueError: where there is none, in one line.
    """
    if isinstance(model, mujoco.MjSpec):
        return model.copy()
    text = str(model)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(text)
        if not Path(text).is_file():
            raise ValueError(f"model: expected an MJCF file, got none called {text!r}")
        return mujoco.MjSpec.from_file(text)
    except ValueError as error:
        raise ValueError(f"model: {' '.join(str(error).split()).removeprefix('model: ')}") from error


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a specification.

    Raises:
        ValueError: where MuJoCo refuses it, in one line.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"model: MuJoCo refuses it: {' '.join(str(error).split())}") from error


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


def _check_starts(simulator: Simulator, parameters: Sequence[Parameter], noises: Mapping[str, float]) -> None:
    """Say where recordings begin elsewhere than the model does for all parameters that are possible."""
    does, begins = simulator.does, []
    bounds = np.array([one.feasible or one.support for one in parameters])
    for theta in (np.array([_centre(one) for one in parameters]), *bounds.T):
        try:
            model = simulator.build(theta) if does.edits else simulator.model
        except ValueError:
            continue  # such simulations fail, and are counted
        begins.append(plausible.sensed(model, does.started(simulator.starts[0], theta)))
    biased = {signal for signal, _ in does.biases}
    compared = [name for number, name in enumerate(simulator.signals) if number not in biased]
    for log in simulator.logs if begins else ():
        plausible.check_start(simulator.model, log, compared, noises, begins)


def box(bounds: Sequence[tuple[float, float]]) -> Support:
    """The support of these bounds."""
    return Support(*np.asarray(bounds, np.float32).T)
