"""Execute a batch of runs from its plan to finished runs: in memory, or in a folder that can always be resumed."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine, RunSpec, stack_inputs, start_one
from jaxlfi.bayessim.correction import gaussian_prior
from jaxlfi.bayessim.host import engine_for
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.memory import budget, state_bytes
from jaxlfi.bayessim.multi_process import SharedEngine
from jaxlfi.bayessim.record import FINAL, own_evidence, split_final, stacked_rounds, theta_error, trajectory_error
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.precision import single
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance, workfolder
from jaxlfi.io.formats import COMPARE, GRID, RUN, RUNS
from jaxlfi.io.processes import ALONE, Partition, Processes
from jaxlfi.io.workfolder import StoreError
from jaxlfi.registry import TASKS
from jaxlfi.runs import describe
from jaxlfi.runs import folder as folders
from jaxlfi.runs.checkpoint import EXTENDED, Checkpoint
from jaxlfi.runs.result import Origin
from jaxlfi.runs.run import Run
from jaxlfi.tasks import failures, priors
from jaxlfi.tasks.executors import one_by_one
from jaxlfi.tasks.failures import FailureLog, Message
from jaxlfi.tasks.journal import Journal, OnSimulation
from jaxlfi.tasks.observation import observe, with_gaps_of
from jaxlfi.tasks.reference import raw
from jaxlfi.tasks.simulation import Simulations
from jaxlfi.tasks.summaries import layout
from jaxlfi.tasks.task import Task

OWN = ("configuration", "support", "heuristic", "seed", "widths")
"""Fields of config.json in which the runs of a batch differ."""
VERSIONS = ("jax", "jaxlib", "jaxlfi")
"""Packages whose versions must not change for a resumed run to be bit-for-bit the same."""


@dataclasses.dataclass(frozen=True)
class BatchPlan:
    """A plan of the runs to make."""

    kind: str  # the format of its folder (`jaxlfi.io.formats.RUN`, `RUNS` or `COMPARE`)
    reference: str | None  # name by which the task was found; None for a task made in Python
    task: Task  # the task
    preset: str | None  # name of the preset that the settings were made from; None for others
    settings: Settings  # all settings
    specs: tuple[RunSpec, ...]  # the runs
    keep_network: bool = False  # keep the trained networks in the folder
    polish: bool = False  # refine posteriors by the task's own method (`jaxlfi.runs.polishing`)

    def folders(self) -> list[str]:
        """Each run's folder, relative to the plan's."""
        if self.kind == RUN:
            return ["."]
        parts = [f"seed_{spec.seed:03d}" for spec in self.specs]
        if self.kind == RUNS:
            return parts
        return [f"{spec.configuration}/{part}" for spec, part in zip(self.specs, parts, strict=True)]

    def origin(self, spec: RunSpec, first: Simulations | None = None) -> Origin:
        """The description of one of its runs, with the number of simulations it was given."""
        given = 0 if first is None else len(first.theta)
        return Origin(self.reference, spec.configuration, spec.support_name, self.preset, given)


@dataclasses.dataclass(frozen=True)
class Observed:
    """Observations of a plan's runs, and simulations given for their first round."""

    trajectory: np.ndarray  # one for each run, shape [L, T, C] or [L, T]
    x: np.ndarray  # their summaries, shape [L, S]
    first: Simulations | None = None  # the same for all runs, or None


def prepare(
    plan: BatchPlan, observation: Any = None, first: Simulations | None = None, processes: Processes = ALONE
) -> Observed:
    """Check the plan, and make the observations.

    Args:
        plan: what to run.
        observation: a trajectory for all runs; by default the task's, or one simulated at the truth for each seed.
        first: simulations that replace those of the first round.
        processes: processes that share the runs; all use the observations of the one that writes.

    Raises:
        ValueError: if anything does not fit.
    """
    plan.settings.check()
    if plan.polish and plan.task.polish is None:
        raise ValueError(f"polish: expected a task that can be polished, such as a MuJoCo model, got {plan.task.name}")
    if plan.polish and not polishable(plan.task, plan.settings):
        raise ValueError("polish: expected an estimator that is a mixture of Gaussians (mdn), got another density")
    prior = plan.task.inference.prior
    for name, box in {spec.support_name: spec.support for spec in plan.specs}.items():
        priors.require_mass(prior, box, name)
    if plan.settings.correction == "paper" and prior is not None:
        gaussian_prior(prior)
    seeds = dict.fromkeys(spec.seed for spec in plan.specs)
    by_seed = {seed: observe(run_keys(key_of(seed)).observe, plan.task, observation) for seed in seeds}
    observed, x = (np.stack([np.asarray(by_seed[spec.seed][i]) for spec in plan.specs]) for i in range(2))
    observed, x = processes.broadcast((observed, x))
    plan.settings.estimator.check_for(plan.task.dim, x.shape[1])
    plan.settings.estimator.for_layout(layout(plan.task.summary, observed.shape[1:], x.shape[1]))
    if first is not None and first.x.shape[1] != x.shape[1]:
        raise ValueError(f"simulations: expected summaries of length {x.shape[1]}, got {first.x.shape[1]}")
    given = Observed(observed, x, first)
    _require_memory(plan, given, processes)
    return given


def polishable(task: Task, settings: Settings) -> bool:
    """Whether a run's posterior can be polished: the task supports it, and it is a mixture of Gaussians."""
    return task.polish is not None and settings.estimator.closed_form


def _require_memory(plan: BatchPlan, given: Observed, processes: Processes) -> None:
    """Refuse a batch whose states alone would not fit into memory.

    Raises:
        ValueError: naming the settings that determine its size.
    """
    (spec, *_), observed = plan.specs, given.trajectory[:1]
    inputs, _ = stack_inputs([spec], observed, given.x[:1])
    first = None if given.first is None else len(given.first.theta)
    one = jax.tree.map(lambda leaf: leaf[0], inputs)
    state = jax.eval_shape(single(functools.partial(start_one, plan.task, first)), plan.settings, one)
    needed, free = len(plan.specs) * state_bytes(state), budget() * jax.local_device_count() * processes.count
    if needed > free:
        raise ValueError(
            f"settings: expected runs that fit into the memory, got {len(plan.specs)} of "
            f"{needed / 2**30:.3g} GiB in all, where {free / 2**30:.3g} GiB are free: lower simulations_per_round, "
            "rounds, seeds or the network's size"
        )


def execute(
    plan: BatchPlan,
    observed: Observed,
    folder: Path | None = None,
    on_round: Callable[[int, dict[str, np.ndarray]], Any] = lambda index, row: None,
    on_compiled: Callable[[float], Any] = lambda seconds: None,
    on_simulation: OnSimulation = lambda done, wanted: None,
    processes: Processes = ALONE,
) -> list[Run]:
    """Run the rounds that are not done yet.

    Args:
        plan: what to run.
        observed: result of `prepare`.
        folder: folder made by `begin`, finished or not; None to keep everything in memory.
        on_round: called at the end of each round with its index and its record.
        on_compiled: called with the compilation time in s.
        on_simulation: called for each simulation, if they are made one by one.
        processes: processes that share the runs. Only the one that writes needs the folder.

    Returns:
        The finished runs, on the host; none in a process that does not write.

    Raises:
        CheckpointError: for a damaged checkpoint.
        SimulatorError: for a simulator that breaks its contract or always fails.
    """
    inputs, places = stack_inputs(plan.specs, observed.trajectory, observed.x)
    checkpoint = None if folder is None or not processes.writes else Checkpoint(folder)
    journal = Journal(None if checkpoint is None else checkpoint.simulations, on_simulation)
    engine = engine_for(plan.task, plan.settings, inputs, observed.first, journal, processes)
    done = 0 if checkpoint is None else checkpoint.rounds_done()
    rows, seconds, final = ([], [], {}) if checkpoint is None else checkpoint.read_rounds(done)
    messages: list[list[Message]] = [[] for _ in plan.specs]
    if folder is not None and checkpoint is not None:
        _complete_ledgers(folder, plan, rows, seconds, places)
        messages = [failures.cut(folder / name, done) for name in plan.folders()]

    def keep(index: int, state: State, row: dict[str, np.ndarray], elapsed: float) -> None:
        nonlocal final
        whole = None if folder is None else engine.fetch(state)
        if not processes.writes:
            return
        seconds.append(elapsed / len(plan.specs))
        kept, final = split_final(row)
        for run, found in journal.failures().items():
            of_round = [Message(index, *failure) for failure in found]
            messages[run] += of_round
            if folder is not None:  # before the checkpoint: they are withdrawn if the round is repeated
                failures.append(folder / plan.folders()[run], of_round)
        if checkpoint is not None:
            checkpoint.require_records(rows[0] if rows else kept, kept)
            checkpoint.write_round(index, whole, row, seconds[-1])
            journal.clear()
        rows.append(kept)
        if folder is not None:
            for run, name in enumerate(plan.folders()):
                own = run_row(kept, run, places[run])
                folders.append_ledger(folder / name, index, own, plan.task.reasons, seconds[-1])
        on_round(index, row)

    if not plan.settings.min_rounds:  # a run that had settled was given more rounds
        rows = [row | {"settled": np.zeros_like(row["settled"])} for row in rows]
    last = done if rows and np.all(rows[-1]["settled"]) else plan.settings.rounds
    done, last = map(int, processes.broadcast((np.asarray(done), np.asarray(last))))
    with contextlib.closing(journal):
        state = run_rounds(engine, _state(engine, checkpoint, done), range(done, last), keep, on_compiled)
    state = engine.fetch(state)
    if not processes.writes:
        return []
    references = [None] * len(plan.specs) if engine.references is None else engine.references
    return [
        _run(
            *(plan, spec, jax.tree.map(lambda leaf, i=i: leaf[i], state), observed, i),
            *(rows, seconds, final, places[i], references[i]),
        ).replace(failure_log=FailureLog(plan.task.reasons, messages[i]))
        for i, spec in enumerate(plan.specs)
    ]


def _state(engine: BatchEngine | SharedEngine, checkpoint: Checkpoint | None, done: int) -> State:
    """The state after the finished rounds; without a checkpoint, it comes from the process that has one."""
    state = engine.start()
    if not done:
        return state
    like = engine.fetch(state)
    return engine.place(like if checkpoint is None else checkpoint.read_state(like))


def _run(plan, spec, state, observed, index, rows, seconds, final, place, reference) -> Run:
    """One run, from the arrays of its batch."""
    history = stacked_rounds([run_row(row, index, place) for row in rows])
    return Run(
        belief=state.reported,
        history=history
        | {"seconds": np.asarray(seconds)}
        | {name: value[index] for name, value in final.items() if name.startswith(FINAL)},
        dataset=state.dataset.replace(x=raw(state.dataset.x, int(state.dataset.size), reference)),
        network=state.network,
        observed=observed.trajectory[index],
        x=observed.x[index],
        key=key_of(spec.seed),
        support=spec.support,
        feasible=state.network.scale,
        heuristic=spec.heuristic,
        settings=plan.settings,
        space=plan.task.space,
        task=plan.task,
        origin=plan.origin(spec, observed.first),
        units=tuple(plan.task.units),
        reference=reference,
    )


def run_row(row: Mapping[str, np.ndarray], index: int, place: int | None) -> dict[str, Any]:
    """One run's record, from that of its batch."""
    return own_evidence({name: value[index] for name, value in row.items()}, place)


def begin(folder: Path, plan: BatchPlan, observed: Observed, processes: Processes = ALONE) -> None:
    """Create the plan's folder; nothing is written before everything has been checked.

    Args:
        folder: a new or empty folder.
        plan: what to run.
        observed: result of `prepare`.
        processes: processes that share the runs.

    Raises:
        StoreError: if the folder is not empty.
    """
    runs = [
        folders.run_config(plan.task, plan.origin(spec, observed.first), spec, plan.settings) for spec in plan.specs
    ]
    status = {
        "status": "running",
        "devices": devices_of(len(plan.specs), processes),
        "processes": processes.count,
        "keep_network": plan.keep_network,
        "polish": plan.polish,
        "executor": plan.task.one_by_one and plan.task.simulate.executor is not None,
        "runs": [
            {"folder": name} | {field: run[field] for field in OWN}
            for name, run in zip(plan.folders(), runs, strict=True)
        ],
    }
    shared = {name: value for name, value in runs[0].items() if name not in OWN}
    config = runs[0] | status if plan.kind == RUN else shared | {"format": plan.kind} | status

    def fill(staging: Path) -> None:
        Checkpoint(staging).write_start(observed.trajectory, observed.x, observed.first)
        if plan.kind == RUN:
            return
        for name, run in zip(plan.folders(), runs, strict=True):
            (staging / name).mkdir(parents=True)
            atomic.write_json(staging / name / "config.json", run)

    workfolder.create(folder, config, fill)


def reopen(folder: Path, task: Task | None = None) -> tuple[BatchPlan, Observed]:
    """The plan of a folder, finished or not, and the observations of its runs.

    Args:
        folder: folder made by `begin`.
        task: the task, if it was made in Python and cannot be found by name.

    Raises:
        StoreError: for an incomplete config.json, or a task that has changed.
    """
    config = folders.read_config(folder)
    if "runs" not in config:
        raise StoreError(f"expected the folder a command was given, got {str(folder)!r}, one run of several")
    try:
        if task is None and config["task"] is None:
            raise StoreError(f"{folder}: expected the task, which was made in Python and has no name: pass task=...")
        plan = BatchPlan(
            kind=config["format"],
            reference=config["task"],
            task=task or TASKS.load(config["task"]),
            preset=config["preset"],
            settings=describe.settings_from_json(config["settings"]),
            specs=tuple(_spec(run) for run in config["runs"]),
            keep_network=config["keep_network"],
            polish=config.get("polish", False),
        )
        labels = config["names"]
        if config.get("one_by_one", False):
            timeout = config["simulation_timeout"]
            plan = dataclasses.replace(plan, task=one_by_one(plan.task, timeout=timeout))
    except (KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"config.json: expected a complete description of the run, got: {error!r}") from error
    if not plan.specs:
        raise StoreError(f"{folder / 'config.json'}: expected at least one run, got none")
    if list(plan.task.space.labels) != labels:
        raise StoreError(
            f"{folder}: expected the task as it was when the run was begun, with parameters {labels}, "
            f"got {list(plan.task.space.labels)}"
        )
    observed = Observed(*Checkpoint(folder).read_start())
    task = with_gaps_of(plan.task, observed.trajectory[0], plan.settings.estimator.embedding != "none")
    return dataclasses.replace(plan, task=task), observed


def devices_of(runs: int, processes: Processes) -> int:
    """Number of devices, over all processes, among which a batch of so many runs is divided."""
    return min(Partition(processes, runs, jax.local_device_count()).devices * processes.count, runs)


def changed_machine(config: Mapping[str, Any], processes: Processes = ALONE) -> list[str]:
    """Changes since a folder was begun that affect the bits of results, in words: versions, devices, processes."""
    recorded = config.get("versions", {})
    now = provenance.versions()
    changed = [name for name in VERSIONS if recorded.get(name) not in (None, now[name])]
    words = [f"{name} {recorded[name]}, now {now[name]}" for name in changed]
    runs, devices = config.get("runs", config.get("trainings")), jax.local_device_count() * processes.count
    if isinstance(runs, list):
        devices = devices_of(len(runs), processes)
    for name, here in (("devices", devices), ("processes", processes.count)):
        if config.get(name) not in (None, here):
            words.append(f"{config[name]} {name}, now {here}")
    return words


def _spec(description: dict[str, Any]) -> RunSpec:
    if type(description["seed"]) is not int:
        raise StoreError(f"config.json: expected a whole number as the seed of a run, got {description['seed']!r}")
    return RunSpec(
        configuration=description["configuration"],
        support_name=description["support"]["name"],
        support=describe.support_from_json(description["support"]),
        heuristic=describe.heuristic_from_json(description["heuristic"]),
        seed=description["seed"],
    )


def _complete_ledgers(folder: Path, plan: BatchPlan, rows, seconds: Sequence[float], places) -> None:
    """Give each ledger one line for each round that the checkpoint counts, wherever the process was stopped.

    Lines of later rounds are removed, as these rounds are repeated; missing lines are added.
    """
    for run, name in enumerate(plan.folders()):
        whole = atomic.keep_lines(folder / name / "ledger.jsonl", len(rows))
        for index in range(whole, len(rows)):
            own = run_row(rows[index], run, places[run])
            folders.append_ledger(folder / name, index, own, plan.task.reasons, seconds[index])


def finish(folder: Path, plan: BatchPlan, runs: Sequence[Run]) -> None:
    """Write every run's results and a comparison's table, then mark the folder as finished."""
    for run, name in zip(runs, plan.folders(), strict=True):
        folders.write_run(folder / name, run, plan.keep_network)
        atomic.flush(folder / name / "ledger.jsonl")  # the checkpoint, which could restore it, is removed next
        if (said := folder / name / failures.FILE).exists():
            atomic.flush(said)
    if plan.kind == COMPARE:
        lines = results(plan, runs)
        order = list(dict.fromkeys(line["configuration"] for line in lines))
        lines.sort(key=lambda line: (order.index(line["configuration"]), line["seed"]))
        folders.write_table(folder / "table.csv", lines)
    workfolder.finish(folder)
    clean(folder)


def clean(folder: Path) -> None:
    """Remove what only an unfinished folder needs; a single run keeps its state for more rounds (`extend`)."""
    Checkpoint(folder).remove(keep_state=workfolder.read(folder, RUN, RUNS, COMPARE, GRID)["format"] == RUN)


def extend(folder: Path, rounds: int | None = None, simulations: int | None = None) -> None:
    """Raise the number of rounds or simulations of a run; `reopen` and `execute` then continue it.

    Finished rounds stay as they are, bit for bit. Later ones differ by chance from those of a run that was begun with
    the larger number: its arrays of simulations have more room from the start, so sums over them round differently. A
    run that ended because its posterior had settled makes all of them.

    Args:
        folder: folder of one run, finished or not.
        rounds: total number of rounds.
        simulations: total number of valid simulations; the run makes as many rounds as that takes if none fails. Give
            this or the rounds.

    Raises:
        ValueError: for no more than the run has, several runs, a run of one round, or one without its state.
    """
    if (rounds is None) == (simulations is None):
        raise ValueError(f"resume: expected rounds or simulations, got {'neither' if rounds is None else 'both'}")
    what = "rounds" if simulations is None else "simulations"
    config = folders.read_config(folder)
    if config["format"] != RUN or "runs" not in config:
        raise StoreError(f"{what}: expected the folder of a command with one run (of one seed), got {folder}")
    checkpoint = Checkpoint(folder)
    settings = describe.settings_from_json(config["settings"])
    done = checkpoint.rounds_done()
    if not done:
        raise StoreError(
            f"{what}: expected a run with {checkpoint.folder / 'state.npz'} to continue, got none: commands and "
            "infer(..., out=...) keep it, and run.save does not"
        )
    rows, _, _ = checkpoint.read_rounds(done)
    least = done if workfolder.is_finished(config) else max(done, settings.rounds)
    if simulations is not None:
        made = int(sum(np.sum(row["succeeded"]) for row in rows))
        rounds = done + max(-(-(simulations - made) // settings.simulations_per_round), 0)
        if rounds <= least:
            there = made + (least - done) * settings.simulations_per_round
            raise ValueError(f"simulations: expected more than the {there} of {folder}, got {simulations}")
    elif rounds is not None and rounds <= least:
        raise ValueError(f"rounds: expected more than the {max(done, settings.rounds)} of {folder}, got {rounds}")
    if settings.rounds == 1:
        raise ValueError(
            f"{what}: expected a run of several rounds, got one round, whose network already serves any observation"
        )
    settled = bool(np.all(rows[-1]["settled"]))
    more = settings.replace(rounds=rounds, min_rounds=0 if settled else settings.min_rounds).check()
    asked = {"rounds": settings.rounds, "min_rounds": settings.min_rounds, "made": done}
    before = [*config.get(EXTENDED, ()), asked]
    changed = {"settings": describe.settings_to_json(more), "status": "running", EXTENDED: before}
    atomic.write_json(folder / "config.json", config | changed)


def results(plan: BatchPlan, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One line of `jaxlfi.runs.folder.TABLE_COLUMNS` for each run.

    The errors are those of the last round, the success rate is over all rounds, and the seconds are the wall time
    without compilation, divided by the number of runs that were stepped together.
    """
    lines = []
    for spec, run in zip(plan.specs, runs, strict=True):
        history = run.history
        last = {name: history[name][-1] for name in ("sample_theta_error", "sample_trajectory_error")}
        lines.append(
            {
                "configuration": spec.configuration,
                "seed": spec.seed,
                "theta_error": theta_error(last),
                "trajectory_error": trajectory_error(last),
                "success_rate": float(np.sum(history["succeeded"]) / np.sum(history["attempted"])),
                "seconds": float(np.sum(history["seconds"])),
            }
        )
    return lines


def rounds_done(folder: Path) -> int:
    """Number of finished rounds in a folder."""
    return Checkpoint(folder).rounds_done()
