"""Inference problems: tasks on supports, and for each seed an observation with its truth or reference posterior."""

import dataclasses

import distrax
import jax
import jax.numpy as jnp
import numpy as np

from experiments.sbibm import tasks as benchmark
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.distributions.support import Support
from jaxlfi.registry import TASKS
from jaxlfi.tasks.observation import simulate_observation, simulator_shapes
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

SETTINGS: dict[str, tuple[str, str]] = {
    "lotka_volterra": ("lotka_volterra", "ok"),
    "lotka_volterra-misspecified": ("lotka_volterra", "misspecified"),
    "two_moons": ("two_moons", "prior"),
    "gaussian_linear": ("gaussian_linear", "prior"),
    "gaussian_mixture": ("gaussian_mixture", "prior"),
    "mg1": ("mg1", "ok"),
}
"""Task and support of each setting, by its name in tables. Tasks of the benchmark are those of experiments/sbibm."""
PUBLISHED_OBSERVATIONS = 3
"""Number of observations included here for each of the benchmark's own tasks; further seeds reuse them."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One observation, and the truth or reference that its posterior is judged by.

    Attributes:
        task: simulator, summary and names.
        box: the support that inference begins with, in inference space.
        seed: seed of the observation and of the inference.
        x: the observation's summary, shape [S].
        truth: true parameters in inference space, shape [D]; None for the published observations, which lack them.
        reference: draws of the exact posterior, shape [N, D], if there are any.
    """

    task: Task
    box: Support
    seed: int
    x: np.ndarray
    truth: np.ndarray | None
    reference: np.ndarray | None

    @property
    def prior(self) -> distrax.Distribution | None:
        """The prior over inference space; None if it is uniform on the box."""
        return self.task.inference.prior


def case_of(setting: str, seed: int) -> Case:
    """The case of a seed: for tasks with their own truth, a newly simulated observation, as in `jaxlfi infer --seed`.

    For the benchmark's tasks it is the published observation seed mod 3 + 1, or number seed + 1 if observations are
    made here.
    """
    name, support = SETTINGS[setting]
    if name not in benchmark.TASKS:
        task = _task(name)
        observed = simulate_observation(run_keys(key_of(seed)).observe, task)
        x, truth = np.asarray(task.summary(jnp.asarray(observed))), np.asarray(task.inference.truth)
        return Case(task, task.support(support), seed, x, truth, None)
    task, box = _task(name), _task(name).support(support)
    number, truth = seed % PUBLISHED_OBSERVATIONS + 1, None
    if name not in benchmark.PUBLISHED:
        number = seed + 1
        truth = np.asarray(box.sample(jax.random.split(jax.random.key(number))[0], 1)[0])
    x = benchmark.observation(name, number).astype(np.float32)
    return Case(task, box, seed, x, truth, benchmark.reference(name, number).astype(np.float32))


_TASKS: dict[str, Task] = {}


def _task(name: str) -> Task:
    """The task, always the same object, by which compiled simulators are cached."""
    if name not in _TASKS:
        _TASKS[name] = benchmark.TASKS[name]() if name in benchmark.TASKS else TASKS.load(name)
    return _TASKS[name]


class Simulator:
    """The task's simulator and summary for other libraries: arrays in and out, in batches, compiled once per length.

    Every parameter vector counts as a simulation, whether it fails or not.

    Attributes:
        simulated: number of parameter vectors simulated so far.
        failed: number of these without a valid result.
    """

    def __init__(self, task: Task, key: jax.Array):
        self._task, self._key = task, key
        self.simulated, self.failed = 0, 0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """Summaries [N, S] of parameters [N, D] in inference space; those of failed simulations are NaN."""
        self._key, key = jax.random.split(self._key)
        x = self._simulate(key, theta)
        self.simulated += len(theta)
        self.failed += int(np.isnan(x).any(axis=1).sum())
        return x

    def compile(self, theta: np.ndarray) -> None:
        """Compile for batches of the size of theta [N, D], so that it is not timed; nothing is counted."""
        self._simulate(jax.random.key(0), theta)

    def _simulate(self, key: jax.Array, theta: np.ndarray) -> np.ndarray:
        shape = simulator_shapes(self._task).trajectory
        _, x, failure = simulate_batch(key, self._task, jnp.asarray(theta, jnp.float32), shape)
        return np.where(np.asarray(failure)[:, None] == 0, x, np.nan).astype(np.float32)
