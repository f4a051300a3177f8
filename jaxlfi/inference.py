"""infer: one whole inference run as a library call."""

import functools
import warnings as python_warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi import atomic, bayessim, black_box, run_store
from jaxlfi import observation as observations
from jaxlfi.bayessim import Round, Settings, State
from jaxlfi.belief import Belief
from jaxlfi.dataset import Dataset
from jaxlfi.diagnostics import bound_warnings, discrepancy
from jaxlfi.estimator import Network
from jaxlfi.heuristics import Edge, Fixed, Heuristic, Truncate
from jaxlfi.history import DRAWS, apart, posterior_draws, record
from jaxlfi.keys import run_keys
from jaxlfi.lanes import Inputs
from jaxlfi.mixture import GaussianMixture
from jaxlfi.observation import SimulatorError
from jaxlfi.posterior import truncated_log_prob
from jaxlfi.presets import QUICK
from jaxlfi.sampling import network_arrays
from jaxlfi.support import Support
from jaxlfi.task import Task


class SupportWarning(UserWarning):
    """Posterior mass is piled on a bound of a support that cannot grow."""


@struct.dataclass
class Run:
    """What an inference run found. A pytree: under `vmap`, every array has a leading axis.

    Attributes:
        belief: the posterior on the last support.
        info: what every round did, stacked along the rounds.
        dataset: all simulations.
        network: the trained density estimator.
        observed: the observed trajectory, shape [T, C] or [T].
        x: its summary x^r, shape [S].
        key: the key the run was made with.
        heuristic: how the support was adapted.
        settings: the numbers of the run.
        task: what was inferred.
    """

    belief: Belief
    info: Round
    dataset: Dataset
    network: Network
    observed: Float[Array, "*shape"]
    x: Float[Array, "*batch obs"]
    key: jax.Array
    heuristic: Heuristic
    settings: Settings
    task: Task = struct.field(pytree_node=False)

    @property
    def mixture(self) -> GaussianMixture:
        """The posterior as a mixture of Gaussians, in coordinates."""
        return self.belief.mixture

    @property
    def warnings(self) -> list[str]:
        """In words, where posterior mass is piled on a bound of the last support, and what to do."""
        return bound_warnings(self.task, self.belief)

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws of the posterior inside the support, in coordinates (`task.to_natural` leads back).

        A flow's posterior is drawn from itself, not from the mixture fitted to it.
        """
        scale = self.task.feasible.hull(self._first_support())
        return posterior_draws(key, self.settings, self.network, self.x, scale, self.belief, n)

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density of the posterior truncated to the support it ended with, at coordinates theta [..., D].

        -inf outside. A flow's is its own, not that of the mixture fitted to it. The mass it is divided by is
        estimated from draws (`jaxlfi.posterior.MASS_DRAWS`), the same each time.
        """
        scale = self.task.feasible.hull(self._first_support())
        return truncated_log_prob(self.settings.estimator, self.network, self.x, scale, self.belief, theta)

    def save(self, path: str | Path) -> Path:
        """Write a run folder (`jaxlfi.run_store`), which `jaxlfi report` can draw.

        Discrepancies from the truth are measured now; rounds have no times of their own.

        Args:
            path: a new or empty folder.

        Returns:
            The folder.

        Raises:
            ValueError: if something is there already.
        """
        folder = Path(path)
        rounds = self.settings.rounds
        keys = jax.vmap(lambda i: jax.random.fold_in(run_keys(self.key).diagnose, i))(jnp.arange(rounds))
        observed = jnp.broadcast_to(self.observed, (rounds, *self.observed.shape))
        measure = black_box.discrepancies if self.task.black_box else _discrepancies
        seen = measure(keys, self.task, self.info.belief, observed, self.settings.restriction)
        stacked = jax.device_get(record(self.info, seen))
        parts = [apart({name: value[i] for name, value in stacked.items()}) for i in range(rounds)]
        draws = self.sample(jax.random.fold_in(run_keys(self.key).diagnose, rounds), DRAWS)

        def fill(beside: Path) -> None:
            seconds = [float("nan")] * rounds
            run_store.write_results(
                beside,
                self.task,
                [row for row, _ in parts],
                seconds,
                parts[-1][1],
                np.asarray(draws),
                jax.device_get(self.dataset),
                np.asarray(self.observed),
                np.asarray(self.x),
            )
            if self.settings.estimator.is_flow:
                atomic.write_arrays(beside / "network.npz", network_arrays(jax.device_get(self.network)))

        run_store.create(folder, self._config(), fill)
        return folder

    def _first_support(self) -> Support:
        return jax.tree.map(lambda leaf: leaf[0], self.info.proposal.support)

    def _config(self) -> dict[str, Any]:
        return run_store.run_config(
            task=self.task,
            reference=self.task.name,
            support_name="own",
            support=self._first_support(),
            heuristic=self.heuristic,
            preset=None,
            settings=self.settings,
            seed=np.asarray(jax.random.key_data(self.key)).tolist(),
        )


def infer(
    key: jax.Array,
    task: Task,
    observation: Any = None,
    *,
    support: str | Support | None = None,
    heuristic: Heuristic = Edge(),
    settings: Settings = QUICK,
) -> Run:
    """Infer a task's parameters from one observed trajectory, adapting the support (Algorithm 1).

    Compiled on first use for a task and the static part of `settings`; further calls reuse the program. Pure:
    it can be jitted, and vmapped over keys, observations, supports, and the leaves of `heuristic` and
    `settings` (not for a black box, which runs on the host).

    Args:
        key: consumed.
        task: simulator, names and bounds.
        observation: the real trajectory, in the shape the simulator produces. By default the task's own, or,
            where the truth is known, a fresh simulation at the truth.
        support: Theta_0: a name among `task.supports`, or a box in coordinates. By default the task's first.
        heuristic: how the support is adapted.
        settings: the numbers of the run; `jaxlfi.PAPER` are the paper's.

    Returns:
        The run: `run.belief.support`, `run.mixture`, `run.warnings`, `run.save(folder)`.

    Raises:
        ValueError: for a support, observation or settings that do not fit the task.
        SimulatorError: for a simulator that breaks its contract or fails always.

    Example:
        >>> from jaxlfi.envs.gaussian_linear import task  # doctest: +SKIP
        >>> run = infer(jax.random.key(0), task(), support="misspecified", heuristic=Edge())  # doctest: +SKIP
        >>> run.save("runs/gaussian")  # doctest: +SKIP
    """
    settings.check()
    check_heuristic(heuristic, task)
    if not isinstance(support, Support) or _is_concrete(support):
        support = task.support(support)
    concrete = _is_concrete((key, observation, support, heuristic, settings))
    if task.black_box:
        if not concrete:
            raise ValueError("infer: expected concrete arguments for a black box, which cannot be traced or vmapped")
        run = _infer_black_box(key, task, observation, support, heuristic, settings)
    else:
        observed, x = observe(run_keys(key).observe, task, observation, concrete)
        state, info = _run(task, run_keys(key).run, settings, heuristic, x, support)
        run = _as_run(task, key, settings, heuristic, observed, x, state, info)
    if concrete:
        refuse_hopeless(np.asarray(run.info.simulations.succeeded)[:1], np.asarray(run.info.failed)[0], task)
        if isinstance(heuristic, Fixed | Truncate):
            for warning in run.warnings:
                python_warnings.warn(warning, SupportWarning, stacklevel=2)
    return run


def observe(key: jax.Array, task: Task, observation: Any, concrete: bool = True) -> tuple[jax.Array, jax.Array]:
    """The observed trajectory, checked, and its summary.

    Args:
        key: simulates it, where none is given and the task has none.
        task: for the simulator's shapes, and for the default.
        observation: what was given, or None.
        concrete: false inside a traced function.
    """
    if observation is None:
        observation = task.observation
    if task.black_box:
        observation = observations.simulate_observation(key, task) if observation is None else observation
        shapes = observations.observed_shapes(task, np.asarray(observation))
    else:
        shapes = simulator_shapes(task)
        if observation is None:
            simulate = observations.simulate_observation if concrete else observations.trace_observation
            observation = simulate(key, task)
    observed = observations.checked(observation, shapes)
    x = jnp.asarray(task.summary(observed), jnp.float32)
    if not isinstance(x, jax.core.Tracer) and not np.isfinite(np.asarray(x)).all():
        raise ValueError(f"observation: expected a finite summary, got {np.asarray(x).tolist()}")
    task.named_summaries(x.shape[-1])  # refuses names that are not the summary's
    return observed, x


simulator_shapes = functools.lru_cache(maxsize=64)(observations.simulator_shapes)
"""`observations.simulator_shapes`, remembered for each task."""


def check_heuristic(heuristic: Heuristic, task: Task) -> None:
    """Refuse hyperparameters that are neither scalars nor one value a dimension.

    Raises:
        ValueError: naming the shape.
    """
    if not isinstance(heuristic, Heuristic):
        raise ValueError(f"heuristic: expected one such as jaxlfi.Edge(), got {heuristic!r}")
    for leaf in jax.tree.leaves(heuristic):
        if np.shape(leaf) not in ((), (task.dim,)):
            raise ValueError(
                f"heuristic: expected hyperparameters that are scalars or {task.dim} values, got shape {np.shape(leaf)}"
            )


def refuse_hopeless(succeeded: np.ndarray, failed: np.ndarray, task: Task) -> None:
    """Refuse to go on where no simulation of the first round succeeded, in any lane.

    Args:
        succeeded: number of successes of each lane.
        failed: failures by reason, of all lanes or of one.
        task: for the reasons' names.

    Raises:
        SimulatorError: with the counts by reason.
    """
    if np.sum(succeeded) > 0:
        return
    counts = np.sum(np.atleast_2d(failed), axis=0)
    told = ", ".join(f"{reason}: {count}" for reason, count in zip(task.reasons, counts, strict=True))
    raise SimulatorError(f"simulate: expected some valid simulations in the first round, got none ({told})")


def _infer_black_box(key, task, observation, support, heuristic, settings) -> Run:
    observed, x = observe(run_keys(key).observe, task, observation)
    heuristic = jax.tree.map(jnp.asarray, heuristic)
    inputs = jax.tree.map(lambda leaf: leaf[None], Inputs(key, support, heuristic, observed, x))
    engine = black_box.BlackBoxEngine(task, settings, inputs)
    state, infos = engine.start(), []
    for index in range(settings.rounds):
        state, info = engine.step(state, index)
        infos.append(info)
        refuse_hopeless(np.asarray(infos[0].simulations.succeeded), np.asarray(infos[0].failed), task)
    state = jax.tree.map(lambda leaf: leaf[0], state)
    info = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *infos)
    return _as_run(task, key, settings, heuristic, observed, x, state, info)


def _as_run(task, key, settings, heuristic, observed, x, state: State, info: Round) -> Run:
    return Run(state.belief, info, state.dataset, state.network, observed, x, key, heuristic, settings, task)


@functools.partial(jax.jit, static_argnums=0)
def _run(task, key, settings, heuristic, x, support):
    return bayessim.run(key, task, settings, heuristic, x, support)


@functools.partial(jax.jit, static_argnames=("task", "restriction"))
def _discrepancies(keys, task, beliefs, observed, restriction):
    one = lambda key, belief, seen: discrepancy(key, task, belief, seen, restriction)
    return jax.vmap(one)(keys, beliefs, observed)


def _is_concrete(tree: Any) -> bool:
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
