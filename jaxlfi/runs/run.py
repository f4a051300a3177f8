"""Run: the result of an inference run, as `infer` returns it and `load` reads it back."""

import html
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.bayessim.keys import key_of
from jaxlfi.design import choosing
from jaxlfi.design.recommendation import Method, Recommendation, recommend
from jaxlfi.design.regions import INFLATION, SHARE
from jaxlfi.diagnostics.bounds import BoundEvidence, bound_evidence, bound_warnings
from jaxlfi.diagnostics.resolution import resolution_warnings
from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.io.run_summary import RunSummary
from jaxlfi.runs import account
from jaxlfi.runs import folder as folders
from jaxlfi.runs.result import Result, require_one
from jaxlfi.runs.unlike import observation_findings
from jaxlfi.tasks import own_arrays
from jaxlfi.tasks.errors import SimulatorWarning
from jaxlfi.tasks.gaps import gaps_of
from jaxlfi.tasks.observation import as_given
from jaxlfi.tasks.reference import summaries_in_double


class SupportWarning(UserWarning):
    """A bound that the heuristic cannot move looks wrong: of a support that cannot grow, or of Phi."""


class MisspecificationWarning(UserWarning):
    """The observation is unlike everything that was simulated."""


class Run(Result):
    """The result of an inference run: its posterior, a summary in words, and a method to save it.

    A pytree: under `vmap`, every array has a leading axis. Its attributes are those of `jaxlfi.runs.result.Result`.
    """

    def posterior_of(self, observation: Any) -> Posterior:
        """The posterior of another observation, from the amortised network of a single-round run.

        Args:
            observation: a trajectory in the shape that the simulator produces, or its summary [S].

        Raises:
            ValueError: for a run of several rounds, whose network has only learnt the posterior of its own observation;
                a run whose network was not kept; or an observation of another shape or with values that are not finite.
        """
        if self.settings.rounds != 1:
            raise ValueError(
                f"posterior_of: expected a run of one round, got one of {self.settings.rounds}, whose network has "
                "only learnt the posterior of its own observation: infer with settings.replace(rounds=1), or "
                "--method npe"
            )
        if self.network is None:
            raise ValueError("posterior_of: expected a run whose network was kept (--keep-network), got none")
        return self.conditioned(self.counted(self._summary(observation)))

    @property
    def warnings(self) -> list[str]:
        """What looks wrong, in words: bounds that the heuristic cannot move, summaries, and the observation.

        Bounds are those of a support that cannot grow, and those of Phi.
        """
        return [text for _, text in self.findings()]

    def findings(self) -> list[tuple[type[Warning], str]]:
        """What looks wrong, as the warnings that `jaxlfi.infer` issues: their classes and texts."""
        require_one(self, "warnings")
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
        """Which summaries are the same in all simulations or vary too little to be resolved, in words."""
        require_one(self, "unresolved")
        return resolution_warnings(self.summary_names, np.asarray(self.dataset.x)[: int(self.dataset.size)])

    @property
    def misspecification(self) -> list[str]:
        """How the observation is unlike all simulations, in words (`jaxlfi.diagnostics.unlike`); usually empty."""
        require_one(self, "misspecification")
        return [f"observation: {finding}" for finding in observation_findings(self)]

    @property
    def bound_evidence(self) -> BoundEvidence:
        """The evidence of the posterior and the run's simulations about the bounds of its final support."""
        require_one(self, "bound_evidence")
        dataset = jax.device_get(self.dataset)
        rows = slice(int(dataset.size))
        return bound_evidence(self.belief, dataset.theta[rows], dataset.x[rows], self.x)

    def summary(self, draws: Float[Array, "n dim"] | None = None) -> RunSummary:
        """Summarise the result: each parameter's median and intervals, and conclusions in sentences.

        They say whether the first guess was wrong, what the observation does not determine, whether simulations from
        the posterior fit it, what failed, whether the run had settled, and what to do next.

        Args:
            draws: posterior draws in natural units, if they exist already.

        Example:
            >>> print(run.summary())  # doctest: +SKIP
            parameter  median   50 %          90 %          narrower than the guess  than Phi  identified
            stiffness  3.1 N/m  [2.9, 3.3]    [2.6, 3.6]    2.7 times                17 times  identified
        """
        require_one(self, "summary")
        return account.summary(self, self.draws() if draws is None else draws)

    def design(
        self,
        experiments: int = 1,
        about: str | Sequence[str] = (),
        method: Method = "auto",
        *,
        inflation: float = INFLATION,
        share: float = SHARE,
        tolerance: float = choosing.TOLERANCE,
        rated: int | None = None,
        simulations: int | None = None,
        seed: int = 0,
        advanced: Callable[[int], None] = lambda designs: None,
    ) -> Recommendation:
        """Recommend the next experiment: the task's designs with the largest expected information.

        Designs are rated over the widened posterior and, with a smaller weight, over the box that the heuristic has
        moved to, so that the recommendation does not rely on a posterior that is too narrow or in the wrong place.

        Args:
            experiments: number of experiments to choose at once; each is chosen given the others.
            about: parameters of interest, or "ridge", the direction that the posterior determines worst; all parameters
                by default.
            method: "fisher" averages Fisher information (`jaxlfi.design.fisher`), "contrastive" bounds the expected
                information gain by simulations (`jaxlfi.design.contrastive`); "auto" takes the first if the task
                declares its noise.
            inflation: width of the distribution that designs are rated over, relative to the posterior's.
            share: weight of the box.
            tolerance: share of draws of the wider posterior for which a chosen experiment may fail or be unsafe.
            rated: number of designs rated for each experiment; by default 300, or 75 with a simulator outside JAX.
            simulations: number for each design in the contrastive method; by default 1024, or 256 outside JAX.
            seed: seed of all random numbers.
            advanced: called with the number of designs rated since its last call, for a progress bar.

        Raises:
            ValueError: for a run whose task is not known or has no design, unknown parameters, or numbers out of
                range; or if every design fails too often.

        Example:
            >>> print(run.design(about="stiffness"))  # doctest: +SKIP
            experiment  amplitude [N m]  frequency [Hz]  bits         stiffness +-  damping +-  ridge  fails
            1           1                2.31            3.10 (0.04)  0.012         0.11        4.1x   0%
        """
        require_one(self, "design")
        if self.task is None:
            raise ValueError("design: expected a run whose task is known: jaxlfi.load(folder, task=...) takes one")
        return recommend(
            key_of(seed),
            self.task,
            self.posterior,
            self.belief.support,
            self.feasible,
            self.support,
            experiments,
            about,
            method,
            inflation,
            share,
            tolerance,
            rated,
            simulations,
            advanced,
        )

    def save(self, path: str | Path, exist_ok: bool = False) -> Path:
        """Write a run folder, for `jaxlfi.load` and the commands `sample`, `diagnose` and `report`.

        Args:
            path: a new or empty folder.
            exist_ok: the folder may contain a finished run, which is replaced together with its pictures and
                diagnostics once everything is written. Nothing else is ever replaced.

        Returns:
            The folder.

        Raises:
            ValueError: if something else is there, or for a run under `vmap`.
        """
        require_one(self, "save")
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
        observation = own_arrays.array(observation) if is_concrete(observation) else observation
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
