"""Polishing: replace the posterior of a finished run by a sharper one that its task computes from it."""

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.keys import run_keys
from jaxlfi.bayessim.record import FINAL
from jaxlfi.diagnostics.discrepancy import compared
from jaxlfi.distributions.belief import Belief
from jaxlfi.io.progress import RoundProgress
from jaxlfi.runs.result import PolishNotes
from jaxlfi.runs.run import Run
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

STARTS = 64
"""Number of posterior draws that a task starts from."""
REACH = 4.0
"""Distance from the sharper posterior's mean, in standard deviations, that a growing support must include."""


def polished(run: Run, console: Console) -> Run:
    """The run with its task's sharper posterior, or with a note on why it has none.

    A support that can grow is widened to include the posterior, within Phi; any other truncates it, as before.
    Simulations from the posterior are repeated, so that statements on the model's fit refer to the reported posterior.

    Args:
        run: one finished run, on the host.
        console: console for a progress bar.
    """
    task = run.task
    if task is None or task.polish is None:
        return run

    def counted(places: Sequence[int]) -> Iterator[int]:
        with RoundProgress(console, len(places), 0, f"{task.name}: polishing", "step", "") as progress:
            for place in places:
                yield place
                progress.advance()

    box = run.feasible if run.heuristic.grows else run.belief.support
    found = task.polish(
        task, np.asarray(run.observed), np.asarray(run.draws(STARTS)), run.space.box_to_natural(box), counted
    )
    notes = PolishNotes(found.sentences, found.steps, found.simulations)
    if found.mixture is None:
        return run.replace(polish=notes)
    mixture = jax.tree.map(jnp.asarray, found.mixture)
    support = run.belief.support
    if run.heuristic.grows:
        reach = REACH * jnp.sqrt(jnp.diagonal(mixture.covariance))
        support = support.replace(
            low=jnp.maximum(jnp.minimum(support.low, mixture.mean - reach), run.feasible.low),
            high=jnp.minimum(jnp.maximum(support.high, mixture.mean + reach), run.feasible.high),
        )
    run = run.replace(belief=Belief(mixture, support, jnp.asarray(True)), polish=notes, unpolished=run.belief)
    return run.replace(history=run.history | _predicted(run, task))


def _predicted(run: Run, task: Task) -> dict[str, np.ndarray]:
    """The history's entries on the last round's posterior, for the polished one."""
    count = run.history["sample_theta"].shape[1]
    key_draw, key_simulate = run_keys(run.key).of_predictive(run.settings.rounds + 1)
    theta = run.posterior.sample(key_draw, count, "inference")
    simulated = simulate_batch(key_simulate, task, theta, np.shape(run.observed))
    seen = compared(task, theta, *simulated, np.asarray(run.observed))
    changed = {}
    for name in ("theta", "theta_error", "trajectory_error"):
        rows = np.array(run.history[f"sample_{name}"])
        rows[-1] = getattr(seen, name)
        changed[f"sample_{name}"] = rows
    return changed | {FINAL + "trajectory": np.asarray(seen.trajectory), FINAL + "x": np.asarray(seen.x)}
