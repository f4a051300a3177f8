"""Session: the lanes of one command, from a plan to a complete run folder, resumable at any moment."""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxlfi import atomic, describe, run_store, tasks
from jaxlfi.bayessim import Settings, State
from jaxlfi.belief import Belief
from jaxlfi.black_box import BlackBoxEngine
from jaxlfi.checkpoint import Checkpoint
from jaxlfi.diagnostics import bound_summary
from jaxlfi.heuristics import Fixed, Truncate
from jaxlfi.history import apart, posterior_draws
from jaxlfi.inference import observe, refuse_hopeless
from jaxlfi.keys import run_keys
from jaxlfi.lanes import Inputs, Lane, LaneEngine, diagnose_key, stack_inputs
from jaxlfi.progress import RoundProgress
from jaxlfi.sampling import network_arrays
from jaxlfi.task import Task


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a command is going to run.

    Attributes:
        kind: the format of its folder (`run_store.RUN`, `RUNS` or `COMPARE`).
        reference: by which the task was found.
        task: the task.
        preset: the settings were made from.
        settings: all of them.
        lanes: the runs.
        keep_network: leave the trained networks in the folder.
    """

    kind: str
    reference: str
    task: Task
    preset: str
    settings: Settings
    lanes: tuple[Lane, ...]
    keep_network: bool = False

    def folders(self) -> list[str]:
        """Each lane's folder, relative to the command's."""
        if self.kind == run_store.RUN:
            return ["."]
        parts = [f"seed_{lane.seed:03d}" for lane in self.lanes]
        if self.kind == run_store.RUNS:
            return parts
        return [f"{lane.configuration}/{part}" for lane, part in zip(self.lanes, parts, strict=True)]


def begin(folder: Path, plan: Plan, observation: Any = None) -> None:
    """Check all there is to check, then bring the folder into being; nothing is written before.

    Args:
        folder: new or empty.
        plan: what to run.
        observation: a trajectory for all lanes; by default the task's, or one simulated at the truth for each
            seed.

    Raises:
        ValueError: for anything that does not fit.
    """
    run_store.refuse_occupied(folder)
    plan.settings.check()
    seeds = sorted({lane.seed for lane in plan.lanes})
    by_seed = {seed: observe(run_keys(jax.random.key(seed)).observe, plan.task, observation) for seed in seeds}
    observed = np.stack([np.asarray(by_seed[lane.seed][0]) for lane in plan.lanes])
    x = np.stack([np.asarray(by_seed[lane.seed][1]) for lane in plan.lanes])
    config, lane_configs = _configs(plan)

    def fill(beside: Path) -> None:
        Checkpoint(beside).write_start(observed, x)
        if plan.kind == run_store.RUN:
            return
        for name, lane_config in zip(plan.folders(), lane_configs, strict=True):
            (beside / name).mkdir(parents=True)
            atomic.write_json(beside / name / "config.json", lane_config)

    run_store.create(folder, config, fill)


def _configs(plan: Plan) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """config.json of the command and of each of its runs."""
    runs = [
        run_store.run_config(
            task=plan.task,
            reference=plan.reference,
            support_name=lane.support_name,
            support=lane.support,
            heuristic=lane.heuristic,
            preset=plan.preset,
            settings=plan.settings,
            seed=lane.seed,
            configuration=lane.configuration,
        )
        for lane in plan.lanes
    ]
    own = ("configuration", "support", "heuristic", "seed")
    session = {
        "status": "running",
        "devices": min(jax.local_device_count(), len(plan.lanes)),
        "keep_network": plan.keep_network,
        "lanes": [
            {"folder": folder} | {name: run[name] for name in own}
            for folder, run in zip(plan.folders(), runs, strict=True)
        ],
    }
    if plan.kind == run_store.RUN:
        return runs[0] | session, runs
    shared = {name: value for name, value in runs[0].items() if name not in own}
    return shared | {"format": plan.kind} | session, runs


def plan_of(config: dict[str, Any]) -> Plan:
    """The plan that a folder's config.json tells of.

    Raises:
        StoreError: for a config.json that lacks something.
    """
    try:
        return Plan(
            kind=config["format"],
            reference=config["task"],
            task=tasks.load(config["task"]),
            preset=config["preset"],
            settings=describe.settings_from_json(config["settings"]),
            lanes=tuple(_lane_of(lane) for lane in config["lanes"]),
            keep_network=config["keep_network"],
        )
    except (KeyError, TypeError) as error:
        raise run_store.StoreError(
            f"config.json: expected a complete description of the run, got: {error!r}"
        ) from error


def _lane_of(description: dict[str, Any]) -> Lane:
    return Lane(
        configuration=description["configuration"],
        support_name=description["support"]["name"],
        support=describe.support_from_json(description["support"]),
        heuristic=describe.heuristic_from_json(description["heuristic"]),
        seed=description["seed"],
    )


def any_round(folder: Path) -> bool:
    """Whether a round was done."""
    return Checkpoint(folder).rounds_done() > 0


def advance(folder: Path, plan: Plan, console: Console) -> None:
    """Run the rounds that are not done yet, then write the results.

    Args:
        folder: made by `begin`, at whatever point it was left.
        plan: the folder's.
        console: for progress.

    Raises:
        CheckpointError: for a damaged checkpoint.
        SimulatorError: for a simulator that breaks its contract or fails always.
    """
    checkpoint = Checkpoint(folder)
    observed, x = checkpoint.read_start()
    inputs, places = stack_inputs(plan.lanes, observed, x)
    engine = (BlackBoxEngine if plan.task.black_box else LaneEngine)(plan.task, plan.settings, inputs)
    done = checkpoint.rounds_done()
    rows, seconds, final = checkpoint.read_rounds(done)
    lanes = len(plan.lanes)
    label = f"{plan.task.name}: {lanes} {'run' if lanes == 1 else 'runs side by side'}"
    state = _state(engine, checkpoint, done)
    with RoundProgress(console, plan.settings.rounds, done, label) as progress:
        if done < plan.settings.rounds:
            began = time.perf_counter()
            engine.compile(state)
            progress.compiled(time.perf_counter() - began)
        for index in range(done, plan.settings.rounds):
            began = time.perf_counter()
            state, row = engine.round(state, index)
            seconds.append((time.perf_counter() - began) / lanes)
            if index == 0:
                refuse_hopeless(row["succeeded"], row["failed"], plan.task)
            checkpoint.write_round(index, engine.fetch(state), row, seconds[-1])
            row, final = apart(row)
            rows.append(row)
            for lane, name in enumerate(plan.folders()):
                own = run_store.lane_rows(rows, lane, places[lane])
                run_store.write_ledger(folder / name, own, plan.task.reasons, seconds)
            progress.advance()
    state = engine.fetch(state)
    draws = jax.device_get(_draws(inputs, plan.settings, state))
    _finish(folder, plan, state, rows, seconds, final, draws, places, observed, x)
    checkpoint.remove()


def _state(engine: LaneEngine | BlackBoxEngine, checkpoint: Checkpoint, done: int) -> State:
    """The state after the rounds that are done."""
    state = engine.start()
    return engine.place(checkpoint.read_state(engine.fetch(state))) if done else state


@jax.jit
def _draws(inputs: Inputs, settings: Settings, state: State) -> jax.Array:
    """Draws of every lane's last posterior, shape [L, n, D]."""

    def one(lane: Inputs, state: State) -> jax.Array:
        key = diagnose_key(lane, settings.rounds)  # the rounds have those before
        return posterior_draws(key, settings, state.network, lane.x, state.feasible, state.belief)

    return jax.vmap(one)(inputs, state)


def _finish(folder, plan, state, rows, seconds, final, draws, places, observed, x) -> None:
    """Write every lane's results and the comparison's table, and then that the run is complete."""
    for lane, name in enumerate(plan.folders()):
        own = run_store.lane_rows(rows, lane, places[lane])
        lane_state = jax.tree.map(lambda leaf, lane=lane: leaf[lane], state)
        run_store.write_results(
            folder / name,
            plan.task,
            own,
            seconds,
            {name: value[lane] for name, value in final.items()},
            draws[lane],
            lane_state.dataset,
            observed[lane],
            x[lane],
        )
        # Draws of a flow's posterior are the flow's, not those of the mixture fitted to it.
        if plan.keep_network or plan.settings.estimator.is_flow:
            atomic.write_arrays(folder / name / "network.npz", network_arrays(lane_state.network))
    if plan.kind == run_store.COMPARE:
        lines = results(folder, plan)
        order = list(dict.fromkeys(line["configuration"] for line in lines))
        lines.sort(key=lambda line: (order.index(line["configuration"]), line["seed"]))
        run_store.write_table(folder / "table.csv", lines)
    config = run_store.read_config(folder)
    atomic.write_json(folder / "config.json", config | {"status": "finished"})


def results(folder: Path, plan: Plan) -> list[dict[str, Any]]:
    """One line of `run_store.TABLE_COLUMNS` for each lane, from its ledger.

    The errors are those of the last round, the success rate is over all rounds, and the seconds are the
    lane's share: wall time without compiling, divided by the lanes that were stepped together.
    """
    lines = []
    for lane, name in zip(plan.lanes, plan.folders(), strict=True):
        ledger = run_store.read_ledger(folder / name)
        attempted = sum(line["attempted"] for line in ledger)
        lines.append(
            {
                "configuration": lane.configuration,
                "seed": lane.seed,
                "theta_error": ledger[-1]["theta_error"],
                "trajectory_error": ledger[-1]["trajectory_error"],
                "success_rate": sum(line["succeeded"] for line in ledger) / attempted,
                "seconds": sum(line["seconds"] for line in ledger),
            }
        )
    return lines


def support_warnings(folder: Path, plan: Plan) -> Iterator[str]:
    """In words, which bounds the posterior lies beyond in the runs whose support cannot grow.

    A single run of a configuration is described in full; of several, the text says in how many of them.
    """
    fixed: dict[str, list[Belief]] = {}
    for lane, name in zip(plan.lanes, plan.folders(), strict=True):
        if isinstance(lane.heuristic, Fixed | Truncate):
            fixed.setdefault(lane.configuration, []).append(run_store.read_belief(folder / name))
    for configuration, beliefs in fixed.items():
        texts = bound_summary(plan.task.coordinates, beliefs, plan.task.feasible)
        yield from (f"{configuration}: {text}" for text in texts)
