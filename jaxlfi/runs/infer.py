"""infer: one whole inference run as a library call."""

import dataclasses
import functools
import warnings as python_warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.batch import RunInputs, RunSpec, run_one
from jaxlfi.bayessim.correction import gaussian_prior
from jaxlfi.bayessim.keys import run_keys, seed_of
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.bayessim.record import FINAL
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.arguments import as_key, is_concrete
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import SpaceName
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.heuristics import Edge, Heuristic, paired
from jaxlfi.heuristics.hyperparameters import build, check
from jaxlfi.io import formats, workfolder
from jaxlfi.io.locks import locked
from jaxlfi.io.progress import RoundProgress
from jaxlfi.registry import HEURISTICS
from jaxlfi.runs import describe
from jaxlfi.runs import execute as executing
from jaxlfi.runs import folder as folders
from jaxlfi.runs.checkpoint import EXTENDED
from jaxlfi.runs.execute import BatchPlan, Observed
from jaxlfi.runs.load import load
from jaxlfi.runs.polishing import polished
from jaxlfi.runs.result import Origin
from jaxlfi.runs.run import Run
from jaxlfi.tasks.executors import one_by_one
from jaxlfi.tasks.failures import FailureLog
from jaxlfi.tasks.observation import observe, trials_of, with_gaps_of
from jaxlfi.tasks.presimulated import presimulated, read_simulations
from jaxlfi.tasks.priors import require_mass
from jaxlfi.tasks.simulation import Simulations
from jaxlfi.tasks.task import Task

PRIOR = "prior_log_density"
"""Key in config.json of the numbers that distinguish priors; folders of earlier versions lack it."""
Callback = Callable[[int, dict[str, np.ndarray]], Any]
"""A function called at the end of each round with its index and its record (names as in history.npz)."""


def infer(
    key: jax.Array | int,
    task: Task,
    observation: Any = None,
    *,
    support: str | Support | None = None,
    heuristic: Heuristic | str = Edge(),
    settings: Settings = QUICK,
    space: SpaceName = "natural",
    simulations: Mapping[str, Any] | str | Path | None = None,
    progress: bool = False,
    callback: Callback | None = None,
    out: str | Path | None = None,
    executor: Executor | None = None,
    simulation_timeout: float | None = None,
    polish: bool | None = None,
) -> Run:
    """Infer a task's parameters from one observed trajectory, adapting the support (Algorithm 1).

    The result is the same as that of `jaxlfi infer` with the seed that the key was made from. The run is compiled on
    first use for a task and the static part of `settings`; further calls reuse the program. The function can be traced:
    jitted, and vmapped over keys, observations, supports, and the leaves of `heuristic` and `settings`. A traced run is
    one scan over its rounds, and supports neither a host simulator nor the last seven arguments. A scan has a fixed
    length: once a traced run has settled (`min_rounds`), its state no longer changes and further rounds count no
    simulations, but they are still computed.

    Args:
        key: a key, which is consumed; or a seed, like `--first-seed` on the command line.
        task: simulator, names and bounds.
        observation: the real trajectory, in the shape that the simulator produces (an axis for a single channel is
            optional), with NaN for missing values (`jaxlfi.with_gaps`); or a data frame, whose columns are matched by
            the channels' names; or a list of these: independent trials with the same parameters, combined into one
            posterior (`jaxlfi.repeated`), in which the missing ends of shorter ones count as missing values. By default
            the task's own observation or, if the truth is known, a fresh simulation at the truth.
        support: Theta_0: a name among `task.supports`, or a box. By default the task's first, or with `simulations` the
            box they fill.
        heuristic: the heuristic that adapts the support, or its registered name ("edge"), with the task's
            hyperparameters. If it compares components and networks are retrained from new weights in every round, it is
            wrapped in `jaxlfi.Matched`.
        settings: settings of the run; `jaxlfi.PAPER` has the paper's.
        space: whether a box is given in "natural" units or in "inference" space.
        simulations: existing simulations that replace those of the first round: a mapping of arrays, or an .npz file
            (`jaxlfi.tasks.presimulated.presimulated`). With one round nothing is simulated.
        progress: show a progress bar.
        callback: called after each round; it can end the run by raising StopIteration.
        out: a new folder in which the run is saved as it progresses. If the folder contains the same run, finished or
            not, that run is continued, with the same result; if `settings` ask for more rounds, these are added.
        executor: any `concurrent.futures.Executor`; it runs the simulations of a host simulator one by one, each with
            its own generator. Simulations that fail, crash or hang are counted by reason. The result is the same for
            any executor.
        simulation_timeout: time limit of a host simulator's simulation, in seconds.
        polish: refine the posterior at the end (`Task.polish`); by default if the task can, as MuJoCo models can by
            least squares. A traced run is not refined.

    Returns:
        The run: `run.posterior`, `run.belief.support`, `run.warnings`, `run.save(folder)`.

    Raises:
        ValueError: for a support, observation or settings that do not fit the task.
        SimulatorError: for a simulator that breaks its contract or always fails.
        ExecutorError: if the executor is lost.

    Example:
        >>> from jaxlfi.envs.gaussian_linear import task  # doctest: +SKIP
        >>> run = infer(jax.random.key(0), task(), support="misspecified", heuristic=Edge())  # doctest: +SKIP
        >>> run.posterior.sample(jax.random.key(1), 1000)  # doctest: +SKIP
    """
    key = as_key(key)
    if not isinstance(task, Task):
        raise ValueError(f"task: expected a jaxlfi.Task, got {type(task).__name__}")
    if not isinstance(settings, Settings):
        raise ValueError(f"settings: expected jaxlfi.Settings such as jaxlfi.QUICK, got {settings!r}")
    if isinstance(heuristic, str):
        heuristic = build(HEURISTICS.load(heuristic), task.hyperparameters.get(heuristic, {}), task.dim)
    check(heuristic, task.dim)
    heuristic = paired(heuristic, getattr(settings.estimator, "warm_start", True))  # its type is checked later
    embedding = getattr(settings.estimator, "embedding", "none")  # its type is checked later
    if executor is not None or simulation_timeout is not None:
        task = one_by_one(task, executor, simulation_timeout)
    task, observation = trials_of(task, observation, "all" if embedding == "trials" else "moments")
    task = with_gaps_of(task, observation, embedding != "none")
    if not is_concrete((key, observation, support, heuristic, settings)):
        if task.on_host or simulations is not None or progress or callback is not None or out is not None:
            raise ValueError(
                "infer: expected concrete arguments for a host simulator, simulations, progress, callback or out, "
                "got traced ones"
            )
        return _traced(key, task, observation, _traced_support(task, support, space), heuristic, settings)
    first, name = None, support if isinstance(support, str) else "own"
    if simulations is not None:
        arrays = read_simulations(simulations) if isinstance(simulations, str | Path) else simulations
        box = None if support is None else task.support(support, space)
        first, box = presimulated(task, arrays, box)
    else:
        box = task.support(support, space)
        name = next(iter(task.supports)) if support is None else name
    spec = RunSpec("own", name, box, heuristic, seed_of(key))
    if polish is None:
        polish = executing.polishable(task, settings)
    plan = BatchPlan(formats.RUN, None, task, None, settings, (spec,), polish=polish)
    run = _run(plan, observation, first, progress, callback, None if out is None else Path(out))
    for category, text in run.findings():
        python_warnings.warn(text, category, stacklevel=2)
    return run


def _run(plan: BatchPlan, observation: Any, first, progress: bool, callback: Callback | None, out: Path | None) -> Run:
    """Make a batch of one run, in memory or in a folder."""
    observed = executing.prepare(plan, observation, first)
    if out is None:
        return executed(plan, observed, progress, callback, None)
    if not (out / "config.json").exists():
        executing.begin(out, plan, observed)
    with locked(out):
        config = folders.read_config(out)
        plan = _require_same(out, config, plan)
        config = folders.read_config(out)
        if workfolder.is_finished(config):
            executing.clean(out)
            run = load(out, plan.task)
            _require(out, "observation", run.observed, observed.trajectory[0])
            if observed.first is not None or run.origin.given_simulations:
                began = np.zeros(0) if run.origin.given_simulations == 0 else _first_round(run.dataset)
                _require(out, "first round (simulations)", began, _kept(observed.first))
            return run
        _, recorded = executing.reopen(out, plan.task)
        _require(out, "observation", recorded.trajectory[0], observed.trajectory[0])
        _require(out, "first round (simulations)", _kept(recorded.first), _kept(observed.first))
        run = executed(plan, recorded, progress, callback, out)
        executing.finish(out, plan, [run])
        return run


def executed(plan: BatchPlan, observed: Observed, progress: bool, callback: Callback | None, out: Path | None) -> Run:
    """Execute a batch of one run, with a progress bar."""
    console, done = Console(quiet=not progress), 0 if out is None else executing.rounds_done(out)
    with RoundProgress(console, plan.settings.rounds, done, f"{plan.task.name}: 1 run") as bar:

        def each(index: int, row: dict[str, np.ndarray]) -> None:
            bar.advance()
            if callback is not None:
                own = executing.run_row(row, 0, None)
                callback(index, {name: np.array(value) for name, value in own.items()})  # copies: it may change them

        (run,) = executing.execute(plan, observed, out, each, bar.compiled, bar.simulated)
    return polished(run, console) if plan.polish else run


def _require_same(out: Path, config: dict[str, Any], plan: BatchPlan) -> BatchPlan:
    """The plan of a folder, extended if the given plan has more rounds; refuse the folder of another run."""
    (spec,) = plan.specs
    wanted = workfolder.as_json(folders.run_config(plan.task, plan.origin(spec), spec, plan.settings))
    compared = (
        "task_name", "names", "units", "feasible_low", "feasible_high", "prior", "support", "heuristic", "settings",
        "seed",
    )  # fmt: skip
    other = [name for name in compared if config.get(name) != wanted[name]]
    # Folders of earlier versions lack these two.
    added = {"one_by_one": False, "simulation_timeout": None}
    other += [name for name, before in added.items() if config.get(name, before) != wanted[name]]
    priors = [np.asarray(described.get(PRIOR), float) for described in (config, wanted)]
    if (
        PRIOR in config
        and "prior" not in other
        and not np.allclose(priors[0], priors[1], rtol=1e-3, atol=1e-3, equal_nan=True)
    ):
        other.append("prior")
    if other == ["settings"] and plan.settings.rounds > 1:
        asked = {"min_rounds": config[EXTENDED][0]["min_rounds"]} if config.get(EXTENDED) else {}
        recorded = config["settings"] | asked
        if recorded == wanted["settings"] | {"rounds": recorded["rounds"]}:
            if plan.settings.rounds > recorded["rounds"]:
                executing.extend(out, plan.settings.rounds)
                config = folders.read_config(out)
            if config["settings"]["rounds"] == plan.settings.rounds:
                return dataclasses.replace(plan, settings=describe.settings_from_json(config["settings"]))
    if other:
        raise _of_another_run(out, other)
    return plan


def _require(out: Path, what: str, recorded: Any, given: Any) -> None:
    """Refuse to continue in the folder of a run whose observation or simulations differ by more than rounding."""
    if not _same(recorded, given):
        raise _of_another_run(out, [what])


def _same(first: Any, second: Any) -> bool:
    """Whether arrays are equal up to rounding: to a small fraction of the range of each column."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    if first.shape != second.shape or not first.size:
        return first.shape == second.shape
    if not np.array_equal(np.isnan(first), np.isnan(second)):
        return False
    first, second = np.nan_to_num(first), np.nan_to_num(second)
    allowed = 1e-4 * np.ptp(first, axis=0) + 1e-6 * np.max(np.abs(first), axis=0)
    return bool(np.all(np.abs(first - second) <= allowed))


def _kept(given: Simulations | None) -> np.ndarray:
    """Given simulations as rows of parameters and summaries; none if the first round makes its own."""
    return np.zeros(0) if given is None else np.concatenate([given.theta, given.x], axis=1)[np.asarray(given.kept)]


def _first_round(dataset: Dataset) -> np.ndarray:
    """The simulations of a finished run's first round, in the same form."""
    rows = np.concatenate([dataset.theta, dataset.x], axis=1)[: int(dataset.size)]
    return rows[np.asarray(dataset.round)[: int(dataset.size)] == 0]


def _of_another_run(out: Path, other: list[str]) -> workfolder.StoreError:
    return workfolder.StoreError(
        f"out: expected a new folder or one of the same run, got {str(out)!r}, of a run with another {', '.join(other)}"
    )


def _traced_support(task: Task, support: Any, space: SpaceName) -> Support:
    if not isinstance(support, Support) or is_concrete(support):
        return task.support(support, space)
    return support if space == "inference" else task.space.box_to_inference(support)


def _traced(key, task: Task, observation, support: Support, heuristic, settings: Settings) -> Run:
    settings.check()
    prior = task.inference.prior
    if settings.correction == "paper" and prior is not None:
        gaussian_prior(prior)
    if is_concrete(support):
        with jax.ensure_compile_time_eval():
            require_mass(prior, support, "own")
    observed, x = observe(run_keys(key).observe, task, observation, concrete=False)
    settings.estimator.check_for(task.dim, x.shape[-1])
    inputs = RunInputs(key, support, heuristic, observed, x)
    state, records = _scan(task, settings, inputs)
    history = {name: value[-1] if name.startswith(FINAL) else value for name, value in records.items()}
    return Run(
        belief=state.reported,
        history=history | {"seconds": jnp.full(settings.rounds, jnp.nan)},
        dataset=state.dataset,
        network=state.network,
        observed=observed,
        x=x,
        key=key,
        support=support,
        feasible=state.network.scale,
        heuristic=heuristic,
        settings=settings,
        space=task.space,
        task=task,
        origin=Origin(),
        units=tuple(task.units),
        failure_log=FailureLog(task.reasons),
    )


@functools.partial(jax.jit, static_argnums=0)
@single
def _scan(task: Task, settings: Settings, inputs: RunInputs):
    return run_one(task, settings, inputs)
