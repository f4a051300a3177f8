"""Result: the data and the posterior of a run; `jaxlfi.runs.run.Run` adds conclusions in words, and saving."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.bayessim.batch import RunSpec, posterior_after, posterior_of, posterior_program, quick_options
from jaxlfi.bayessim.correction import CORRECTIONS
from jaxlfi.bayessim.keys import run_keys, seed_of
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.distributions.belief import Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import Space, SpaceName, is_natural
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Network
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.heuristics import Heuristic
from jaxlfi.io.executables import quickly
from jaxlfi.tasks import failures
from jaxlfi.tasks.failures import Failure, FailureLog
from jaxlfi.tasks.reference import counted_from
from jaxlfi.tasks.task import Task

DRAWS = 1000
"""Number of posterior draws that are saved with a run."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """Description of a run in its config.json.

    Attributes:
        reference: name by which its task can be found (`jaxlfi.registry.TASKS`); None for a task made in Python.
        configuration: name of the run in tables.
        support_name: name of Theta_0.
        preset: name of the preset that the settings were made from, or None.
        given_simulations: number of given simulations that replaced the first round's; None if it was not recorded.
    """

    reference: str | None = None
    configuration: str = "own"
    support_name: str = "own"
    preset: str | None = None
    given_simulations: int | None = 0


@dataclasses.dataclass(frozen=True)
class PolishNotes:
    """How a posterior was polished, or why not, in words; and the simulations used (`jaxlfi.tasks.polish.Polished`)."""

    sentences: tuple[str, ...]
    steps: tuple[str, ...]
    simulations: int


class Result(struct.PyTreeNode):
    """The result of a run. A pytree: under `vmap`, every array has a leading axis.

    Attributes:
        belief: the posterior mixture on the last support, in inference space.
        history: the record of every round, named as in history.npz: arrays with a leading axis of one entry per round,
            and the last round's simulations of posterior draws (`final_...`).
        dataset: all simulations.
        network: the trained density estimator; None if it was not saved.
        observed: the observed trajectory, shape [T, C] or [T].
        x: its summary x^r, shape [S].
        key: the key the run was made with.
        support: Theta_0, in inference space.
        feasible: Phi, in inference space, widened by Theta_0.
        heuristic: the heuristic that adapted the support.
        settings: the settings of the run.
        space: the map between natural units and inference space.
        task: the task of the run; None for a loaded run whose task cannot be found.
        origin: description of the run in its config.json: task, configuration, support's name, preset.
        units: units of the parameters; None if its folder does not give them.
        failure_log: messages of its failed simulations (`failures`).
        reference: origin of the network's summaries, shape [S], in double precision; None for zero
            (`jaxlfi.tasks.reference`). The origin of `x` and the dataset's summaries is zero.
        polish: notes on how the posterior was polished, or why not; None if that was not tried.
        unpolished: the belief before polishing; None if the posterior is the rounds' own.
    """

    belief: Belief
    history: dict[str, Any]
    dataset: Dataset
    network: Network | None
    observed: Float[Array | np.ndarray, "*shape"]
    x: Float[Array | np.ndarray, "*batch obs"]
    key: jax.Array
    support: Support
    feasible: Support
    heuristic: Heuristic
    settings: Settings
    space: Space = struct.field(pytree_node=False)
    task: Task | None = struct.field(pytree_node=False)
    origin: Origin = struct.field(pytree_node=False)
    units: tuple[str, ...] | None = struct.field(pytree_node=False, default=None)
    failure_log: FailureLog = struct.field(pytree_node=False, default=FailureLog())
    reference: np.ndarray | None = None
    polish: PolishNotes | None = struct.field(pytree_node=False, default=None)
    unpolished: Belief | None = None

    @property
    def posterior(self) -> Posterior:
        """The posterior of the observation, truncated to the run's final support."""
        # A polished posterior was not fitted to draws inside the box.
        correction = self.settings.correction if self.unpolished is None else "none"
        if self.network is None:
            prior = None if self.task is None else self.task.inference.prior
            return _posterior_of(correction, self.belief, self.space, prior)
        options = quick_options(self.network.estimator)
        given = self.belief, self.network, self.counted(self.x)
        return quickly(posterior_program(correction), *given, options=options)

    @property
    def amortised(self) -> bool:
        """Whether the network gives the posterior of any observation: it was kept, and the run had one round."""
        return self.settings.rounds == 1 and self.network is not None

    def conditioned(self, x: Float[Array, " obs"], key: jax.Array | None = None) -> Posterior:
        """The posterior of a summary (`counted`) with which a run of one round would have ended."""
        return _conditioned(self.task, self.settings, self.heuristic, self.network, self.support, self.feasible, x, key)

    def counted(self, x: Any) -> Any:
        """Summaries [..., S] as the run's network takes them: relative to its reference."""
        return counted_from(self.reference, x)

    @property
    def mixture(self) -> GaussianMixture:
        """The posterior as a mixture of Gaussians, in inference space."""
        return self.belief.mixture

    def final_support(self, space: SpaceName = "natural") -> Support:
        """The run's final support, to which its posterior is truncated; bounds of shape [D]."""
        box = self.belief.support
        return self.space.box_to_natural(box) if is_natural(space) else box

    @property
    def summary_names(self) -> tuple[str, ...]:
        """Names of the summary's numbers; x_1 to x_S if the task does not name them."""
        size = self.x.shape[-1]
        return tuple(f"x_{s + 1}" for s in range(size)) if self.task is None else self.task.named_summaries(size)

    @property
    def failures(self) -> list[Failure]:
        """Why simulations failed, most common reasons first; messages that differ only in numbers are counted as one.

        Example:
            >>> run.failures  # doctest: +SKIP
            [Failure(reason='error', message='sim: exit status 3: mesh inverted at a=2.31', count=41)]
        """
        require_one(self, "failures")
        return failures.together([(self.failure_log, self.history["failed"])])

    @property
    def spec(self) -> RunSpec:
        """The run's specification in a batch."""
        return RunSpec(
            self.origin.configuration, self.origin.support_name, self.support, self.heuristic, seed_of(self.key)
        )

    def draws(self, n: int = DRAWS) -> Float[Array, "n dim"]:
        """The posterior draws that are saved with the run, in natural units; the same each time."""
        return self.posterior.sample(run_keys(self.key).of_check(self.settings.rounds), n)


def require_one(run: Result, what: str) -> None:
    """Refuse a batch of runs, which the method called `what` cannot take."""
    if not is_concrete(run) or run.x.ndim != 1:
        raise ValueError(
            f"{what}: expected one run, got a batch of them (from vmap): take one by "
            "jax.tree.map(lambda leaf: leaf[0], runs)"
        )


@functools.partial(jax.jit, static_argnums=0)
@single
def _conditioned(task, settings, heuristic, network, support, feasible, x, key):
    prior = uninformed(support, settings.estimator.ensemble_size * settings.estimator.components)
    correction = CORRECTIONS[settings.correction]
    if correction.divide is None:
        mixture, _ = correction.change(task.inference.prior, network.condition(x, support, key).mixture, prior)
    else:
        estimator: Any = network.estimator
        mixture = estimator.weighted(network, estimator.density(network, x))
    belief, _ = heuristic(prior, mixture, feasible)
    return posterior_after(settings.correction, belief, network, x)


_posterior_of = jax.jit(single(posterior_of), static_argnums=(0, 2, 3))
