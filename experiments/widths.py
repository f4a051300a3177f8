"""Calibration of posterior widths, and its cost, for several proposals, restrictions and corrections.

    python -m experiments.widths --task lotka_volterra --configuration misspecified+edge --seeds 20 --truths 200

With the same settings except for one or two, each candidate infers (a) the task's own truth from `--seeds` observations
and (b) `--truths` truths drawn from the support that holds the task's truth, each from its own observation. (a) gives
the error and the number of lost runs. (b) gives the coverage of 50 % and 90 % regions, and the ranks of
simulation-based calibration, for the posterior of the run and for that on the box of the truths, which is their prior.
The two are different questions: most truths drawn from a box are easier than the task's own.

The runs of a candidate are made in batches of `--runs-per-batch`. A candidate whose arrays are there is not run again;
the table is made from the arrays.

`--margin` starts from the named support enlarged on every side, and reads posteriors on the support itself.
"""

import argparse
import dataclasses
import json
import operator
import time
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from experiments.ablation import CLIPPED
from jaxlfi import diagnostics
from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import RunSpec, posterior_after, stack, stack_inputs
from jaxlfi.bayessim.host import engine_for
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.presets import QUICK, snle
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.heuristics import Centre, Edge, Fixed, Heuristic, Mode, paired
from jaxlfi.io import files as atomic
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.provenance import environment
from jaxlfi.registry import TASKS
from jaxlfi.runs.describe import settings_to_json
from jaxlfi.studies.calibration.repeat import described
from jaxlfi.studies.calibration.truths import simulated_truths
from jaxlfi.tasks.observation import simulate_observation, simulator_shapes
from jaxlfi.tasks.task import Task

DRAWS = 200
"""Number of draws of each posterior that the truth is ranked among."""
LOST = 1.5
"""Summed error above which a run counts as lost."""
FLOOR = -30.0
"""Minimum log-density of a truth: one truth outside of its posterior's support would make any mean minus infinity."""
TUNING = 1000
"""First of the seeds for choosing settings; results are reported on seeds from 0."""

RULES: dict[str, Heuristic] = {"none": Fixed(), "edge": Edge(), "mode": Mode(), "centre": Centre()}
RULES |= {f"edge-{tau:g}": Edge(mass_threshold=tau, uninformed_factor=1.0) for tau in (0.005, 0.12, 0.15, 0.25)}

PACED = QUICK.estimator
"""Training in proportion to the number of simulations. `CLIPPED` makes as many steps in the first round as in the last:
it overfits the first hundred simulations within fifty steps, and has not converged on the thousand of the end."""


def candidates(clipped: Settings = CLIPPED) -> dict[str, Settings]:
    """The candidates by name: other proposals and corrections, other training, and the likelihood."""
    once = {"clipped": clipped, "reject": clipped.replace(restriction="reject")}
    wide = {
        f"{restriction}-{factor:g}": clipped.replace(restriction=restriction, inflation=factor)
        for restriction in ("clip", "reject", "mixed")
        for factor in (1.5, 2.0, 3.0)
    }
    divided = {f"{name}-quotient": wide[name].replace(correction="quotient") for name in wide}
    paced = {f"paced-{name}": settings.replace(estimator=PACED) for name, settings in (once | wide).items()}
    whole = {"quick": QUICK, "quick-reject": QUICK.replace(restriction="reject"), "snle": snle(QUICK)}
    return whole | once | wide | divided | paced


@dataclasses.dataclass(frozen=True)
class Cases:
    """Truths and their observations, one per row.

    Attributes:
        seeds: seeds of the runs.
        theta: truths in inference space, shape [N, D].
        observed: trajectories, shape [N, ...].
        x: summaries, shape [N, S].
    """

    seeds: np.ndarray
    theta: np.ndarray
    observed: np.ndarray
    x: np.ndarray

    def rows(self, rows: np.ndarray) -> "Cases":
        """Some of the cases."""
        return Cases(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))


def own_cases(task: Task, first: int, count: int) -> Cases:
    """The task's own truth, simulated again for each seed."""
    seeds = first + np.arange(count)
    observed = np.stack([simulate_observation(run_keys(key_of(int(seed))).observe, task) for seed in seeds])
    theta = np.broadcast_to(np.asarray(task.inference.truth, np.float32), (count, task.dim))
    return Cases(seeds, theta, observed, np.asarray(jax.vmap(task.summary)(observed)))


def drawn_cases(task: Task, box: str, first: int, count: int) -> Cases:
    """Truths from the prior over a named support."""
    shapes = simulator_shapes(task)
    found = simulated_truths(jax.random.key(first + 500_000), task, task.support(box), count, shapes)
    seeds = first + 500_000 + np.arange(count)
    return Cases(seeds, found["theta"], found["observed"], found["x"])


def both(key: jax.Array, truth: jax.Array, posterior: Posterior, box: Support) -> dict[str, jax.Array]:
    """Describe a posterior with its truth, and the same posterior on the box that truths were drawn from."""
    keys = jax.random.split(key)
    return {
        f"{name}_{field}": value
        for name, key, one in (("own", keys[0], posterior), ("box", keys[1], posterior.on(box)))
        for field, value in described(key, truth, one, DRAWS).items()
    }


def final_states(
    task: Task, settings: Settings, support: Support, rule: Heuristic, cases: Cases, batch: int, console: Console
) -> tuple[State, float]:
    """The last states of all cases' runs, stacked, and the seconds they took without compilation.

    All runs make their first round, then all their second, a batch at a time; those that have settled are left out of
    later rounds. A batch is padded with repeated runs, so that one program serves all batches.
    """
    rule = paired(rule, settings.estimator.warm_start)
    states: dict[int, State] = {}
    active, seconds = np.arange(len(cases.seeds)), 0.0
    with RoundProgress(console, settings.rounds, 0, f"{len(cases.seeds)} runs") as progress:
        for index in range(settings.rounds):
            for start in range(0, len(active), batch):
                rows = active[start : start + batch]
                part = cases.rows(np.resize(rows, batch))
                specs = [RunSpec("", "", support, rule, int(seed)) for seed in part.seeds]
                engine = engine_for(task, settings, stack_inputs(specs, part.observed, part.x)[0])
                state = (
                    engine.place(stack([states[row] for row in np.resize(rows, batch)])) if index else engine.start()
                )
                engine.compile(state, index)
                began = time.perf_counter()
                state = engine.fetch(engine.round(state, index)[0])
                seconds += time.perf_counter() - began
                states |= {row: jax.tree.map(operator.itemgetter(place), state) for place, row in enumerate(rows)}
            active = np.array([row for row in active if not states[row].progress.settled], int)
            progress.advance()
            if not len(active):
                break
    return stack([states[row] for row in range(len(states))]), seconds


def widened(task: Task, support: Support, margin: float) -> Support:
    """A support enlarged on every side by a fraction of its width, within Phi."""
    reach, phi = margin * support.width, task.inference.feasible
    return Support(phi.clip(support.low - reach), phi.clip(support.high + reach))


def infer_all(
    task: Task,
    settings: Settings,
    support: Support,
    rule: Heuristic,
    cases: Cases,
    box: str,
    batch: int,
    console: Console,
    on: Support | None = None,
) -> dict[str, np.ndarray]:
    """Descriptions of the posteriors of all cases, on their final supports or on a given one."""

    @jax.jit
    @jax.vmap
    def one(key, truth, x, state):
        posterior = posterior_after(settings.correction, state.reported, state.network, x)
        found = both(key, truth, posterior if on is None else posterior.on(on), task.support(box))
        return found | {"rounds": state.progress.rounds, "moved": state.progress.moved}

    states, seconds = final_states(task, settings, support, rule, cases, batch, console)
    found = []
    for start in range(0, len(cases.seeds), batch):
        rows = np.resize(np.arange(start, min(start + batch, len(cases.seeds))), batch)
        part, state = cases.rows(rows), jax.tree.map(operator.itemgetter(rows), states)
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(77), jnp.asarray(part.seeds))
        found.append(jax.device_get(one(keys, part.theta, part.x, state)))
    arrays = {name: np.concatenate([part[name] for part in found])[: len(cases.seeds)] for name in found[0]}
    progress = {name: arrays[name] for name in ("rounds", "moved")}
    return judged(cases.theta, arrays) | progress | {"seeds": cases.seeds, "seconds": np.asarray(seconds)}


def judged(theta: np.ndarray, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of the table, from described posteriors (`both`) and their truths [N, D].

    Returns:
        `error` [N], averaged over draws and summed over parameters, `parameter_error` [N, D], the same before the sum;
        `density_rank` [N], the number of draws with a higher density than the truth, and `log_prob` [N] of the truth,
        under the run's posterior; `own_rank` and `box_rank` [N, D], the number of draws below the truth, under that
        posterior and on the box.
    """
    parameter_error = np.abs(arrays["own_draws"] - theta[:, None]).mean(axis=1)
    return {
        "error": parameter_error.sum(axis=1),
        "parameter_error": parameter_error,
        "density_rank": np.sum(arrays["own_log_prob"] > arrays["own_truth_log_prob"][:, None], axis=1),
        "log_prob": arrays["own_truth_log_prob"],
        "own_rank": np.sum(arrays["own_draws"] < theta[:, None], axis=1),
        "box_rank": np.sum(arrays["box_draws"] < theta[:, None], axis=1),
    }


def save(path: Path, arrays: dict[str, np.ndarray], settings: Settings, **more: str) -> None:
    """Write the arrays, and the settings and versions they were computed with in a .json file of the same name."""
    atomic.write_arrays(path, arrays)
    config = {"settings": settings_to_json(settings), **more, **environment()}
    path.with_suffix(".json").write_text(json.dumps(config, indent=2) + "\n")


def table(folder: Path) -> str:
    """The comparison as Markdown, from the saved arrays."""
    lines = [
        "| candidate | rounds | error, own truth | lost | 90 % covers it | 50 % | 90 % | SBC p | on the box | lp | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for path in sorted(folder.glob("*-own.npz")):
        own = atomic.read_arrays(path)
        error = own["error"]
        low, high = bootstrap_interval(error)
        lost = int(np.sum(error > LOST))
        held = np.mean(own["density_rank"] < 0.9 * (DRAWS + 1))
        cells = [
            f"{np.mean(own['rounds']):.1f}",
            f"{error.mean():.2f} [{low:.2f}, {high:.2f}] ({np.median(error):.2f})",
            f"{lost} of {len(error)}",
            f"{held:.2f}",
        ]
        drawn = path.with_name(path.name.replace("-own.npz", "-drawn.npz"))
        if drawn.exists():
            cells += _coverage(atomic.read_arrays(drawn))
        else:
            cells += [""] * 5
        cells.append(f"{float(own['seconds']) / len(error):.1f}")
        lines.append("| ".join(["", f"`{path.name.removesuffix('-own.npz')}` ", *(cell + " " for cell in cells), ""]))
    return "\n".join(lines) + "\n"


def _coverage(arrays: dict[str, np.ndarray]) -> list[str]:
    """Coverage at 50 % and 90 %, the smallest p-value of any parameter's ranks, and the mean log-density of truths."""
    dim = arrays["own_rank"].shape[1]
    cells = []
    for level in (0.5, 0.9):
        cells.append(f"{np.mean(arrays['density_rank'] < level * (DRAWS + 1)):.2f}")
    for name in ("own", "box"):
        ranks = arrays[f"{name}_rank"]
        p_value = min(diagnostics.uniformity(ranks[:, d], DRAWS, dim).p_value for d in range(dim))
        cells.append(f"{p_value:.3f}" if p_value >= 0.001 else "< 0.001")
    cells.append(f"{np.mean(np.maximum(arrays['log_prob'], FLOOR)):.1f}")
    return cells


def main() -> None:
    """Run the candidates that are missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="lotka_volterra")
    parser.add_argument("--configuration", default="misspecified+edge", help="support, or support+heuristic")
    parser.add_argument("--margin", type=float, default=0.0, help="fraction of the support's width, on each side")
    parser.add_argument("--box", default="ok", help="support that truths are drawn over")
    parser.add_argument("--candidates", nargs="+", choices=list(candidates()), default=list(candidates()))
    parser.add_argument("--seeds", type=int, default=20, help="observations of the task's own truth")
    parser.add_argument("--truths", type=int, default=40, help="truths drawn over the box; 0: none")
    parser.add_argument("--first-seed", type=int, default=TUNING, help="0 to report, from 1000 to choose settings")
    parser.add_argument("--runs-per-batch", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("runs/widths"))
    arguments = parser.parse_args()
    task, console = TASKS.load(arguments.task), Console()
    box, _, rule = arguments.configuration.partition("+")
    start, on, margin = task.support(box), None, ""
    if arguments.margin:
        start, on, margin = widened(task, start, arguments.margin), start, f"-margin-{arguments.margin:g}"
    folder = arguments.out / arguments.task / f"{arguments.configuration}{margin}"
    folder.mkdir(parents=True, exist_ok=True)
    sets = {"own": own_cases(task, arguments.first_seed, arguments.seeds)}
    if arguments.truths:
        sets["drawn"] = drawn_cases(task, arguments.box, arguments.first_seed, arguments.truths)
    for name in arguments.candidates:
        settings = candidates()[name].replace(predictive=False)
        for kind, cases in sets.items():
            path = folder / f"{name}-{kind}.npz"
            if path.exists():
                continue
            console.print(f"{name}, {kind}", highlight=False)
            arrays = infer_all(
                *(task, settings, start, RULES[rule or "none"], cases, arguments.box),
                *(arguments.runs_per_batch, console, on),
            )
            save(path, arrays, settings, box=arguments.box)
    (folder / "table.md").write_text(table(folder))
    print(table(folder))


if __name__ == "__main__":
    main()
