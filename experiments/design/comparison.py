"""Comparison of designs: a first experiment is made, then the ones chosen by its posterior, and their rivals."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from experiments.design.trust import UntrustedError
from jaxlfi.design.recommendation import Recommendation, recommend
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.estimators.posterior import truncated
from jaxlfi.io import files
from jaxlfi.tasks.experiments import at
from jaxlfi.tasks.task import Task

SPREAD = 1.5
"""Largest factor between a truth and the task's, either way."""


class Sampler(Protocol):
    """A function that finds a posterior, such as `importance.posterior` or `tempered.posterior`."""

    def __call__(
        self,
        rng: np.random.Generator,
        task: Task,
        recorded: np.ndarray,
        designs: np.ndarray,
        before: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draws [N, D] in inference space, given the recordings [E, T, ...] of designs [E, K]."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """A task whose next experiments are chosen.

    Attributes:
        task: function that makes the task.
        posterior: function that finds the posterior of recordings.
        rivals: function that makes the experiments that the chosen ones are compared with, from the posterior's draws:
            names with designs [E, K].
        experiments: number of experiments that are chosen at once, E.
        rated: number of designs that are rated for each; by default as many as `jaxlfi design` rates.
    """

    task: Callable[[], Task]
    posterior: Sampler
    rivals: Callable[[np.random.Generator, Task, np.ndarray], list[tuple[str, np.ndarray]]]
    experiments: int = 1
    rated: int | None = None


def again_and_random(
    rng: np.random.Generator, task: Task, draws: np.ndarray, random: int = 2
) -> list[tuple[str, np.ndarray]]:
    """The nominal experiment again, and some random ones."""
    found = [("nominal again", np.array([task.design.nominal]))]
    return found + [("at random", task.design.of_unit(rng.random((1, len(task.design.names))))) for _ in range(random)]


def recorded_at(key: jax.Array, task: Task, truth: np.ndarray, designs: np.ndarray) -> np.ndarray:
    """Recordings of experiments, [E, T, ...]."""
    if task.on_host:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        made = [at(task, design).simulate.function(rng, truth[None]) for design in designs]
        return np.stack([trajectories[0] for trajectories, _ in made])
    keys = jax.random.split(key, len(designs)) if len(designs) > 1 else key[None]
    single = (jnp.asarray(each, jnp.float32) for each in (truth, designs))
    return np.asarray(jax.vmap(task.simulate.function, (0, None, 0))(keys, *single))


def chosen_for(
    key: jax.Array, task: Task, draws: np.ndarray, experiments: int = 1, rated: int | None = None
) -> Recommendation:
    """The recommendation for a posterior, which is a normal fitted to its draws."""
    mean, factor = draws.mean(axis=0), np.linalg.cholesky(np.cov(draws, rowvar=False))
    one = GaussianMixture(jnp.zeros(1), jnp.asarray(mean[None], jnp.float32), jnp.asarray(factor[None], jnp.float32))
    box = task.support(None)
    return recommend(key, task, truncated(one, one, box, task.space), box, box, box, experiments, rated=rated)


def measured(problem: Problem, truths: int, seed: int, path: Path) -> None:
    """Write widths [truths, 1 + arms, D] of 90 % intervals, and whether the truth is inside, truth by truth.

    The second axis is the first experiment alone, and with each arm: the chosen experiments and their rivals. Truths
    are added to existing ones of another seed. Those with a posterior that cannot be trusted are left out, and counted.

    Raises:
        ValueError: for a seed whose truths exist.
    """
    task, rng = problem.task(), np.random.default_rng(seed)
    there = files.read_arrays(path) if path.exists() else {}
    refused = int(there.pop("refused", 0))
    found = {name: list(values) for name, values in there.items() if name != "arms"}
    for number in range(truths):
        truth = task.truth * SPREAD ** rng.uniform(-1, 1, task.dim)
        if any(np.allclose(truth, other) for other in found.get("truth", [])):
            raise ValueError(f"seed: expected another one, as {path} has the truths of {seed}")
        try:
            row, names = _compared(jax.random.key(seed + number), rng, problem, task, truth)
        except UntrustedError as error:
            refused += 1
            print(f"{task.name}: truth {number + 1} of {truths} is left out: {error}", flush=True)
            continue
        for name, value in row.items():
            found.setdefault(name, []).append(value)
        kept = {name: np.array(values) for name, values in found.items()}
        files.write_arrays(path, kept | {"arms": np.array(names), "refused": np.array(refused)})
        chosen = np.round(row["design"][0], 2).tolist()
        print(f"{task.name}: truth {number + 1} of {truths}, chosen {chosen}", flush=True)


def _compared(
    key: jax.Array, rng: np.random.Generator, problem: Problem, task: Task, truth: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays that are kept of a truth, by name, and the names of the arms."""
    keys = jax.random.split(key, 3)
    inner = np.asarray(task.space.to_inference(truth))
    nominal = np.array([task.design.nominal])
    first = recorded_at(keys[0], task, truth, nominal)
    draws = problem.posterior(rng, task, first, nominal)
    advice = chosen_for(keys[1], task, draws, problem.experiments, problem.rated)
    arms = [("chosen", advice.designs), *problem.rivals(rng, task, draws)]
    posteriors = [draws]
    for (_, designs), own in zip(arms, jax.random.split(keys[2], len(arms)), strict=True):
        recorded = np.concatenate([first, recorded_at(own, task, truth, designs)])
        posteriors.append(problem.posterior(rng, task, recorded, np.concatenate([nominal, designs]), draws))
    low, high = np.stack([np.quantile(each, [0.05, 0.95], axis=0) for each in posteriors], axis=1)
    row = {
        "truth": truth,
        "design": np.stack([designs for _, designs in arms]),
        "width": high - low,
        "held": (inner > low) & (inner < high),
        "reach": advice.reach,
        "bits": advice.together[0],
        "narrower": advice.narrower,
    }
    return row, [name for name, _ in arms]
