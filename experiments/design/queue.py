"""The M/G/1 queue: many jobs in one run, or few jobs in many runs, at the same cost.

Its likelihood is not known. In place of a posterior, the parameters are regressed on the summaries of two experiments,
the nominal one and a second: the regression is quadratic in their logarithms, and trained at each design on simulations
at truths such as the study's. An interval is 1.645 standard deviations of the residuals either way, on held-out
simulations, on which its coverage is counted.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.design.comparison import SPREAD, chosen_for
from jaxlfi.envs import mg1_repetitions
from jaxlfi.io import files
from jaxlfi.tasks.task import Task

GRID = (1, 2, 3, 5, 8, 12, 18, 25, 30.5, 40, 50, 60)
"""Numbers of jobs before the queue is emptied in the second experiment, the nominal one included."""
SIMULATIONS = 20_000
"""Number of simulations for each regression, and of held-out ones."""
RATED = 48
"""Number of designs, of one variable, that are rated for each choice."""
NORMAL = 1.645
"""Number of standard deviations that contain 90 % of a normal distribution."""


def truths(rng: np.random.Generator, task: Task, count: int) -> np.ndarray:
    """Truths such as the study's, within a factor of the task's, shape [N, 3]."""
    return task.truth * SPREAD ** rng.uniform(-1, 1, (count, task.dim))


def summaries(key: jax.Array, task: Task, theta: np.ndarray, jobs: float) -> np.ndarray:
    """Logarithms of the summaries of an experiment at each truth, shape [N, S]."""
    x = _summarised(task)(
        jax.random.split(key, len(theta)), jnp.asarray(theta, jnp.float32), jnp.asarray([jobs], jnp.float32)
    )
    return np.log(np.maximum(np.asarray(x, float), 1e-3))


@functools.lru_cache
def _summarised(task: Task) -> Callable:
    one = lambda key, theta, design: task.summary(task.simulate.function(key, theta, design))
    return jax.jit(jax.vmap(one, (0, 0, None)))


def features(x: np.ndarray, centre: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """A constant 1, the scaled summaries, and their pairwise products."""
    z = np.clip((x - centre) / scale, -4, 4)
    rows, columns = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]], axis=1)


class Regression:
    """The parameters' means given summaries, and the covariance of the residuals."""

    def __init__(self, x: np.ndarray, theta: np.ndarray):
        """Fit to half of the pairs [N, S], [N, D]; the other half gives the residuals."""
        half = len(x) // 2
        self._centre, self._scale = x[:half].mean(axis=0), x[:half].std(axis=0) + 1e-9
        known = features(x[:half], self._centre, self._scale)
        gram = known.T @ known + 1e-5 * half * np.diag([0.0, *np.ones(known.shape[1] - 1)])
        self._coefficients = np.linalg.solve(gram, known.T @ theta[:half])
        self.residuals = theta[half:] - self.mean(x[half:])
        self.covariance = np.cov(self.residuals, rowvar=False)

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Means given summaries, shape [N, D]."""
        return features(x, self._centre, self._scale) @ self._coefficients

    @property
    def widths(self) -> np.ndarray:
        """Widths of 90 % intervals, shape [D]."""
        return 2 * NORMAL * np.sqrt(np.diagonal(self.covariance))

    @property
    def held(self) -> np.ndarray:
        """Fraction of truths that the intervals hold, shape [D]."""
        return np.mean(np.abs(self.residuals) < 0.5 * self.widths, axis=0)


def measured(count: int, seed: int, path: Path) -> None:
    """Write widths [1 + designs, 3] of the first experiment alone and with each second one of the grid.

    For each truth, the chosen design and a random one are written too, with widths [truths, 2, 3].
    """
    task, rng = mg1_repetitions.task(), np.random.default_rng(seed)
    keys = iter(jax.random.split(jax.random.key(seed), 4 * count + len(GRID) + 1))
    theta = truths(rng, task, 2 * SIMULATIONS)
    first = summaries(next(keys), task, theta, task.design.nominal[0])

    def after(jobs: float) -> Regression:
        return Regression(np.concatenate([first, summaries(next(keys), task, theta, jobs)], axis=1), theta)

    alone = Regression(first, theta)
    found = [alone, *map(after, GRID)]
    kept = {
        "jobs": np.array(GRID),
        "width": np.stack([one.widths for one in found]),
        "held": np.stack([one.held for one in found]),
    }
    low, high = np.asarray(task.feasible.low), np.asarray(task.feasible.high)
    rows: dict[str, list] = {"second": [], "second_width": [], "second_held": [], "bits": []}
    for truth in truths(rng, task, count):
        x = summaries(next(keys), task, truth[None], task.design.nominal[0])
        draws = rng.multivariate_normal(alone.mean(x)[0], alone.covariance, 4096)
        draws = draws[((draws > low) & (draws < high)).all(axis=1)]
        advice = chosen_for(next(keys), task, draws, rated=RATED)
        second = [float(advice.designs[0, 0]), float(rng.uniform(1, mg1_repetitions.COST))]
        both = [after(jobs) for jobs in second]
        rows["second"].append(second)
        rows["second_width"].append([one.widths for one in both])
        rows["second_held"].append([one.held for one in both])
        rows["bits"].append(advice.together[0])
        files.write_arrays(path, kept | {name: np.array(values) for name, values in rows.items()})
        print(f"{task.name}: truth {len(rows['bits'])} of {count}, chosen {second[0]:.1f} jobs", flush=True)
