"""Run: what an inference run found, as `infer` returns it and `load` reads it back."""

import dataclasses
import functools
import html
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.bayessim.batch import RunSpec, posterior_after
from jaxlfi.bayessim.correction import CORRECTIONS
from jaxlfi.bayessim.keys import run_keys, seed_of
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.bounds import BoundEvidence, bound_evidence, bound_warnings
from jaxlfi.diagnostics.resolution import resolution_warnings
from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.distributions.belief import Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import Space, SpaceName, is_natural
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Network
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.heuristics import Heuristic
from jaxlfi.io.run_summary import RunSummary
from jaxlfi.runs import folder as folders
from jaxlfi.runs.account import account
from jaxlfi.runs.summarise import summarised
from jaxlfi.runs.unlike import observation_findings
from jaxlfi.tasks import failures, owned
from jaxlfi.tasks.errors import SimulatorWarning
from jaxlfi.tasks.failures import Failure, FailureLog
from jaxlfi.tasks.gaps import gaps_of
from jaxlfi.tasks.observation import as_given
from jaxlfi.tasks.reference import counted_from, summaries_in_double
from jaxlfi.tasks.task import Task

DRAWS = 1000
"""Draws of the posterior that are saved with a run."""


class SupportWarning(UserWarning):
    """A bound looks wrong that the heuristic cannot move: of a support that cannot grow, or of Phi."""


class MisspecificationWarning(UserWarning):
    """The observation is unlike everything that was simulated."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """How a run is described in its config.json.

    Attributes:
        reference: by which its task can be found (`jaxlfi.registry.TASKS`); None for a task made in Python.
        configuration: what the run is called in tables.
        support_name: of Theta_0.
        preset: that the settings were made from, or None.
        given_simulations: how many simulations took the place of the first round's; None where that was not recorded.
    """

    reference: str | None = None
    configuration: str = "own"
    support_name: str = "own"
    preset: str | None = None
    given_simulations: int | None = 0


class Run(struct.PyTreeNode):
    """What an inference run found. A pytree: under `vmap`, every array has a leading axis.

    Attributes:
        belief: the posterior mixture on the last support, in inference space.
        history: what every round did, by the names of history.npz: arrays with a leading axis of one entry a round, and
            the last round's simulations of posterior draws (`final_...`).
        dataset: all simulations.
        network: the trained density estimator; None where it was not saved.
        observed: the observed trajectory, shape [T, C] or [T].
        x: its summary x^r, shape [S].
        key: the key the run was made with.
        support: Theta_0, in inference space.
        feasible: Phi, in inference space, widened by Theta_0.
        heuristic: how the support was adapted.
        settings: the numbers of the run.
        space: the map between natural units and inference space.
        task: what was inferred; None for a loaded run whose task cannot be found.
        origin: how the run is described in its config.json: task, configuration, support's name, preset.
        units: of the parameters; None where its folder does not say.
        failure_log: what its simulations say of their failures (`failures`).
        reference: what the network's summaries are counted from, shape [S], in double precision; None for zero
            (`jaxlfi.tasks.reference`). `x` and those of the dataset are counted from zero.
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

    @property
    def posterior(self) -> Posterior:
        """The posterior of the observation, truncated to the support the run ended with."""
        if self.network is None:
            prior = None if self.task is None else self.task.inference.prior
            return _truncated(self.belief.mixture, self.belief.mixture, self.belief.support, self.space, prior)
        return _posterior_after(self.belief, self.network, self.counted(self.x))

    @property
    def amortised(self) -> bool:
        """Whether the network has learnt the posterior of any observation: it was kept, and had one round."""
        return self.settings.rounds == 1 and self.network is not None

    def posterior_of(self, observation: Any) -> Posterior:
        """The posterior of another observation, by the network of a run of one round.

        Args:
            observation: a trajectory in the shape the simulator produces, or its summary [S].

        Raises:
            ValueError: for a run of several rounds, whose network has learnt the posterior of its own observation only;
                one whose network was not kept; or an observation of another shape, or that is not finite.
        """
        if self.settings.rounds != 1:
            raise ValueError(
                f"posterior_of: expected a run of one round, got one of {self.settings.rounds}, whose network "
                "has learnt the posterior of its own observation alone: infer with settings.replace(rounds=1), or "
                "--method npe"
            )
        if self.network is None:
            raise ValueError("posterior_of: expected a run whose network was kept (--keep-network), got none")
        return self.conditioned(self.counted(self._summary(observation)))

    def conditioned(self, x: Float[Array, " obs"], key: jax.Array | None = None) -> Posterior:
        """The posterior of a summary, `counted`, that a run of one round would have ended with."""
        return _conditioned(self.task, self.settings, self.heuristic, self.network, self.support, self.feasible, x, key)

    def counted(self, x: Any) -> Any:
        """Summaries [..., S] as the run's network takes them: counted from its reference."""
        return counted_from(self.reference, x)

    @property
    def mixture(self) -> GaussianMixture:
        """The posterior as a mixture of Gaussians, in inference space."""
        return self.belief.mixture

    def final_support(self, space: SpaceName = "natural") -> Support:
        """The support that the run ended with, which its posterior is truncated to; bounds of shape [D]."""
        box = self.belief.support
        return self.space.box_to_natural(box) if is_natural(space) else box

    @property
    def warnings(self) -> list[str]:
        """In words, what looks wrong: bounds that the heuristic cannot move, summaries, and the observation.

        Bounds are those of a support that cannot grow, and those of Phi.
        """
        return [text for _, text in self.findings()]

    def findings(self) -> list[tuple[type[Warning], str]]:
        """What looks wrong, as the warnings that `jaxlfi.infer` issues: their classes and texts."""
        _require_one(self, "warnings")
        bounds = bound_warnings(self.space, self.units, [self.bound_evidence], self.feasible, self.heuristic.grows)
        bounds = [warning.replace("--heuristic edge", "heuristic=jaxlfi.Edge()") for warning in bounds]
        found = {
            SupportWarning: bounds,
            SimulatorWarning: self.unresolved,
            MisspecificationWarning: self.misspecification,
        }
        return [(category, text) for category, texts in found.items() for text in texts]

    @property
    def unresolved(self) -> list[str]:
        """In words, which summaries are the same in all simulations, or vary too little to be resolved."""
        _require_one(self, "unresolved")
        return resolution_warnings(self.summary_names, np.asarray(self.dataset.x)[: int(self.dataset.size)])

    @property
    def summary_names(self) -> tuple[str, ...]:
        """Names of the summary's numbers; x_1 to x_S where the task does not name them."""
        size = self.x.shape[-1]
        return tuple(f"x_{s + 1}" for s in range(size)) if self.task is None else self.task.named_summaries(size)

    @property
    def failures(self) -> list[Failure]:
        """Why simulations failed, the commonest first; messages that differ in numbers only are counted as one.

        Example:
            >>> run.failures  # doctest: +SKIP
            [Failure(reason='error', message='sim: exit status 3: mesh inverted at a=2.31', count=41)]
        """
        _require_one(self, "failures")
        return failures.together([(self.failure_log, self.history["failed"])])

    @property
    def misspecification(self) -> list[str]:
        """In words, in what the observation is unlike all simulations (`jaxlfi.diagnostics.unlike`); mostly nothing."""
        _require_one(self, "misspecification")
        return [f"observation: {finding}" for finding in observation_findings(self)]

    @property
    def bound_evidence(self) -> BoundEvidence:
        """What the posterior and the run's simulations say of the bounds of its last support."""
        _require_one(self, "bound_evidence")
        dataset = jax.device_get(self.dataset)
        rows = slice(int(dataset.size))
        return bound_evidence(self.belief, dataset.theta[rows], dataset.x[rows], self.x)

    @property
    def spec(self) -> RunSpec:
        """The run among those of a batch."""
        return RunSpec(
            self.origin.configuration, self.origin.support_name, self.support, self.heuristic, seed_of(self.key)
        )

    def summary(self, draws: Float[Array, "n dim"] | None = None) -> RunSummary:
        """The answer, stated: each parameter's median and intervals, and in sentences what follows from them.

        Whether the first guess was wrong, what the observation does not determine, whether simulations of the posterior
        fit it, what failed, whether the run had settled, and what to do next.

        Args:
            draws: of the posterior, in natural units, where they were made already.

        Example:
            >>> print(run.summary())  # doctest: +SKIP
            parameter  median   50 %          90 %          narrower than the guess  than Phi  identified
            stiffness  3.1 N/m  [2.9, 3.3]    [2.6, 3.6]    2.7 times                17 times  identified
        """
        _require_one(self, "summary")
        rule = getattr(self.heuristic, "rule", self.heuristic)
        found = summarised(
            np.asarray(self.draws() if draws is None else draws),
            self.space,
            self.units,
            (self.support, self.belief.support, self.feasible),
            None if self.task is None else self.task.truth,
            type(rule).__name__.upper(),
        )
        return account(self, found)

    def draws(self, n: int = DRAWS) -> Float[Array, "n dim"]:
        """The posterior draws that are saved with the run, in natural units; the same each time."""
        return self.posterior.sample(run_keys(self.key).of_check(self.settings.rounds), n)

    def save(self, path: str | Path, exist_ok: bool = False) -> Path:
        """Write a run folder, which `jaxlfi.load` reads and the command line's `sample`, `diagnose` and `report` take.

        Args:
            path: a new or empty folder.
            exist_ok: it may also hold a finished run, which is replaced together with its pictures and diagnostics
                once everything is written. Nothing else is ever replaced.

        Returns:
            The folder.

        Raises:
            ValueError: if something else is there, or for a run under `vmap`.
        """
        _require_one(self, "save")
        return folders.save(self, Path(path), exist_ok)

    def __repr__(self) -> str:
        if not is_concrete(self) or self.x.ndim != 1:
            return f"{self._headline()}; arrays have leading axes"
        return f"{self._headline()}\n{self.posterior!r}\nprint(run.summary()) says what follows from it."

    def _repr_html_(self) -> str | None:
        if not is_concrete(self) or self.x.ndim != 1:
            return None
        return f"<p>{html.escape(self._headline())}</p>{self.summary().to_html()}"

    def _headline(self) -> str:
        name = self.origin.configuration if self.task is None else self.task.name
        rule, rounds = getattr(self.heuristic, "rule", self.heuristic), self.history["attempted"].shape[-1]
        return f"Run of {name}: {rounds} {'round' if rounds == 1 else 'rounds'}, {type(rule).__name__.upper()}"

    def _summary(self, observation: Any) -> jax.Array:
        on_host = self.task is not None and self.task.on_host
        observation = observation if self.task is None else as_given(self.task, observation)
        observation = owned.array(observation) if is_concrete(observation) else observation
        observation = np.array(observation, float) if on_host else jnp.array(observation, jnp.float32)
        if observation.shape == self.observed.shape and self.task is not None:
            missing = gaps_of(self.task)
            _finite(observation if missing is None else observation[~missing])
            x = summaries_in_double(self.task, observation[None])[0] if on_host else self.task.summary(observation)
            return _finite(x, "a summary of finite numbers")
        if observation.shape == self.x.shape:
            return _finite(observation)
        if self.task is None:
            raise ValueError(
                f"observation: expected a summary of shape {list(self.x.shape)}, as the task is not known "
                f"(jaxlfi.load(folder, task=...) takes one), got shape {list(observation.shape)}"
            )
        raise ValueError(
            f"observation: expected a trajectory of shape {list(self.observed.shape)} or a summary of shape "
            f"{list(self.x.shape)}, got {list(observation.shape)}"
        )


def _finite(values: jax.Array, what: str = "finite numbers") -> jax.Array:
    if is_concrete(values) and not bool(jnp.isfinite(values).all()):
        raise ValueError(f"observation: expected {what}, got some that are not")
    return values


@functools.partial(jax.jit, static_argnums=0)
@single
def _conditioned(task, settings, heuristic, network, support, feasible, x, key):
    prior = uninformed(support, settings.estimator.ensemble_size * settings.estimator.components)
    correction = CORRECTIONS[settings.correction]
    if correction.report is None:
        mixture, _ = correction.change(task, network.condition(x, support, key).mixture, prior)
    else:
        mixture = network.estimator.weighted(network, x)
    belief, _ = heuristic(prior, mixture, feasible)
    return posterior_after(belief, network, x)


_posterior_after = jax.jit(single(posterior_after))
_truncated = jax.jit(single(truncated), static_argnums=(3, 4))


def _require_one(run: Run, what: str) -> None:
    if not is_concrete(run) or run.x.ndim != 1:
        raise ValueError(
            f"{what}: expected one run, got a batch of them (from vmap): take one by "
            "jax.tree.map(lambda leaf: leaf[0], runs)"
        )
