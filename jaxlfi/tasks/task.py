"""Task: a simulator with named, bounded parameters and, optionally, an observation."""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.arguments import require_texts
from jaxlfi.distributions.space import Space, SpaceName, is_natural
from jaxlfi.distributions.support import Support, check_within
from jaxlfi.tasks import design as designs
from jaxlfi.tasks import own_arrays, prior_checks, priors, summaries
from jaxlfi.tasks.command import Command
from jaxlfi.tasks.equality import same
from jaxlfi.tasks.host import HostSimulator

LABEL = re.compile(r"\w[\w .-]*")
"""Allowed names of supports: they name folders of a comparison, where "+" joins them with a heuristic."""


@dataclasses.dataclass(frozen=True)
class InferenceView:
    """What a task declares in natural units, in inference space.

    Attributes:
        feasible: Phi.
        supports: boxes Theta_0 by name.
        truth: theta_gt, shape [D], or None.
        prior: `sample(seed=key, sample_shape=n)` and `log_prob` over inference space (`jaxlfi.tasks.priors`), or None
            for a uniform prior.
    """

    feasible: Support
    supports: Mapping[str, Support]
    truth: jax.Array | None
    prior: Any


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A likelihood-free inference problem.

    Everything about parameters is declared in natural units. Inference works with the logarithms of the parameters
    named in `log` and with the others as they are: `space` maps there and back, and `inference` holds the declared
    boxes, truth and prior there. Tasks with equal content are equal, so a task that is created again (in a notebook
    cell, or by `dataclasses.replace`) reuses the programs compiled for the first one.

    Attributes:
        simulate: a pure JAX function for one simulation, `simulate(key, theta[D]) -> trajectory` or `-> (trajectory,
            outcome)`; all noise is drawn from the key. `outcome` must be a boolean (true: valid) or an integer (0:
            valid, i: failed for the reason `failures[i - 1]`; any other integer counts as the first reason). Wrap a
            simulator that JAX cannot trace in `jaxlfi.HostSimulator`.
        names: one name for each of the D parameters.
        supports: boxes Theta_0 by name; the first is the default. A box wider than Phi, like the paper's "broadest", is
            allowed and widens Phi for its run.
        feasible: Phi, the limits that no adapted support leaves.
        units: one unit for each parameter ("" for none).
        summary: the network's input: the name of a summary (`jaxlfi.tasks.summaries.SUMMARIES`) or a function from a
            trajectory to a vector [S].
        truth: the observation's parameters, if known, shape [D].
        observation: the observed trajectory, if the task has a fixed one (real data).
        log: names of the parameters inferred as logarithms.
        prior: a continuous distrax distribution, truncated to the support, that replaces the uniform prior. Where its
            density is zero or NaN, nothing is proposed and the posterior is zero.
        prior_space: whether the prior is over parameters in "natural" units or over "inference" space, where a normal
            prior is log-normal in a log parameter.
        failures: names of the reasons why a simulation can fail.
        summary_names: names of the summary's numbers, for plots; by default x_1 to x_S.
        channels: names of the columns of a trajectory, for plots.
        channel_noise: standard deviation of the measurement noise of each column of a trajectory, if known, shape [C].
            It is the unit of trajectory errors for channels that move less, so that a channel at rest does not
            dominate.
        times: times of the rows of a trajectory, shape [T], for plots.
        record_label: label of the row axis in plots; by default "time" if there are `times`, else "record".
        settings: settings for this task that replace the preset's, by their names in `jaxlfi.Settings` or in its
            estimator; used by the command line and `jaxlfi.settings_for`.
        hyperparameters: hyperparameters of heuristics, by the heuristic's name, that replace their defaults.
        name: the task's name in files and figures.
        design: adjustable settings of an experiment (`jaxlfi.tasks.design.Design`, or a mapping of its variables such
            as `{"amplitude": (0.1, 1.0, "N m")}`), from which `Run.design` recommends the most informative experiment.
            The simulator is then `simulate(key, theta, design[K])`, and the task uses its nominal design.
        polish: a function that refines a run's posterior (`jaxlfi.tasks.polish`), as least squares does for MuJoCo
            models; or None.

    Raises:
        ValueError: if the numbers of names, units and bounds differ; for reversed bounds, unknown names in `log`, and
            bounds or a truth of a log parameter that are not positive; and if the prior is not continuous over D
            parameters.

    Example:
        >>> spring = Task(lambda key, theta: theta[:1] / theta[1:], names=("force", "stiffness"), units=("N", "N/m"),
        ...               supports={"guess": Support([1.0, 0.5], [2.0, 50.0])},
        ...               feasible=Support([0.1, 0.1], [10.0, 100.0]), log=("stiffness",))
        >>> spring.space.labels
        ('force', 'ln stiffness')
    """

    simulate: Any
    names: Sequence[str]
    supports: Mapping[str, Support]
    feasible: Support
    units: Any = None
    summary: Any = "identity"
    truth: Any = None
    observation: Any = None
    log: Sequence[str] = ()
    prior: Any = None
    prior_space: SpaceName = "natural"
    failures: Sequence[str] = ("failed",)
    summary_names: Sequence[str] = ()
    channels: Sequence[str] = ()
    times: Any = None
    record_label: str | None = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    hyperparameters: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    name: str = "task"
    channel_noise: Any = None
    design: Any = None
    polish: Any = None

    def __post_init__(self):
        store = lambda field, value: object.__setattr__(self, field, value)
        for field in ("names", "log", "failures", "summary_names", "channels"):
            store(field, require_texts(getattr(self, field), field))
        names = self.names
        store("units", ("",) * len(names) if self.units is None else require_texts(self.units, "units"))
        for field, kind in (("supports", Mapping), ("settings", Mapping), ("hyperparameters", Mapping), ("name", str)):
            if not isinstance(getattr(self, field), kind):
                wanted = "a text" if kind is str else "a mapping from names"
                raise ValueError(f"{field}: expected {wanted}, got {getattr(self, field)!r}")
        if not callable(self.simulate):
            raise ValueError(f"simulate: expected a function, got {type(self.simulate).__name__}")
        if self.design is not None:
            store("design", designs.declared(self.design))
            if self.design.of is None:
                store("simulate", designs.at_nominal(self.simulate, self.design))
        if clash := set(self.failures) & set(self.simulate.reasons if self.on_host else ()):
            raise ValueError(f"failures: expected other names than those of every simulator, got {sorted(clash)}")
        if len(self.units) != len(names):
            raise ValueError(f"units: expected one for each of the {len(names)} parameters, got {len(self.units)}")
        if len(set(names)) != len(names) or not names:
            raise ValueError(f"names: expected at least one name, each once, got {names}")
        if unknown := set(self.log) - set(names):
            raise ValueError(f"log: expected names among {names}, got {sorted(unknown)}")
        if not self.supports:
            raise ValueError("supports: expected at least one named support, got none")
        for label in self.supports:
            if not isinstance(label, str) or not LABEL.fullmatch(label):
                raise ValueError(
                    f"supports: expected names of letters, digits, '_', '.', '-' and spaces, got {label!r}"
                )
        for label, box in [("feasible", self.feasible), *self.supports.items()]:
            self.check_box(box, label if box is self.feasible else f"supports[{label!r}]")
        if self.truth is not None:
            truth = _vector(self.truth, len(names), "truth")
            if bool(np.any(truth[np.asarray(self.space.log)] <= 0)):
                raise ValueError(f"truth: expected positive values of the log parameters {self.log}, got {truth}")
            store("truth", truth)
        if isinstance(self.summary, str):
            store("summary", summaries.named(self.summary))
        is_natural(self.prior_space)
        if self.channel_noise is not None:
            noise = _vector(self.channel_noise, len(self.channels) or None, "channel_noise")
            if bool(np.any(noise < 0)):
                raise ValueError(f"channel_noise: expected standard deviations of at least 0, got {noise}")
            store("channel_noise", noise)
        for field in ("observation", "times"):  # the caller may change them later
            store(field, own_arrays.copied(getattr(self, field)))
        if self.prior is not None:
            prior_checks.check_prior(self.prior, len(names))
            view = self.inference
            widest = functools.reduce(Support.hull, view.supports.values(), view.feasible)
            prior_checks.check_density(view.prior, self.space, widest)

    @classmethod
    def from_command(
        cls,
        template: str,
        names: Sequence[str],
        supports: Mapping[str, Support],
        feasible: Support,
        *,
        timeout: float | None = None,
        **others: Any,
    ) -> "Task":
        """The task of a simulator that is a program, in any language (`jaxlfi.tasks.command.Command`).

        Args:
            template: its command, such as "./sim --theta {theta} --seed {seed}". It writes a trajectory to standard
                output as a table of numbers, .npy or JSON.
            names: one name for each parameter.
            supports: boxes Theta_0 by name.
            feasible: Phi.
            timeout: seconds after which a simulation is given up; None waits forever.
            others: further fields of the task.

        Raises:
            ValueError: for a program that is not found, or a template that does not pass on all parameters.

        Example:
            >>> box = Support([0.0], [1.0])
            >>> coin = Task.from_command("echo [{theta}, {seed}]", ["bias"], {"unit": box}, box)
            >>> coin.one_by_one, coin.reasons
            (True, ('failed', 'error', 'wrong_shape', 'timeout', 'crash', 'non_finite'))
        """
        simulate = HostSimulator(Command(template, require_texts(names, "names")), each=True, timeout=timeout)
        return cls(simulate, names=names, supports=supports, feasible=feasible, **others)

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return len(self.names)

    @property
    def on_host(self) -> bool:
        """Whether the simulator runs outside compiled programs (`jaxlfi.HostSimulator`)."""
        return isinstance(self.simulate, HostSimulator)

    @functools.cached_property
    def space(self) -> Space:
        """The map between natural units and inference space."""
        return Space(tuple(self.names), tuple(name in self.log for name in self.names))

    @functools.cached_property
    def inference(self) -> InferenceView:
        """Phi, supports, truth and prior in inference space."""
        with jax.ensure_compile_time_eval():  # it is cached, so it must not contain tracers
            boxes = {label: self.space.box_to_inference(box) for label, box in self.supports.items()}
            truth = None if self.truth is None else self.space.to_inference(jnp.asarray(self.truth))
            feasible = self.space.box_to_inference(self.feasible)
        prior = self.prior
        if prior is not None:
            over_natural = is_natural(self.prior_space) and any(self.space.log)
            prior = priors.InferencePrior(prior, self.space if over_natural else None)
        return InferenceView(feasible, boxes, truth, prior)

    @property
    def reasons(self) -> tuple[str, ...]:
        """All reasons of failure, in the order of their codes from 1: the task's own, its simulator's, "non_finite"."""
        return (*self.failures, *(self.simulate.reasons if self.on_host else ()), "non_finite")

    @property
    def one_by_one(self) -> bool:
        """Whether its simulations are made one by one on the host, each with its own generator."""
        return self.on_host and self.simulate.each

    def named_summaries(self, count: int) -> tuple[str, ...]:
        """Names of the summary's `count` numbers.

        Raises:
            ValueError: if the task has a different number of names.
        """
        if self.summary_names and len(self.summary_names) != count:
            raise ValueError(
                f"summary_names: expected one for each of the summary's {count} numbers, got {len(self.summary_names)}"
            )
        return tuple(self.summary_names) or tuple(f"x_{i + 1}" for i in range(count))

    def support(self, choice: str | Support | None = None, space: SpaceName = "natural") -> Support:
        """A box Theta_0 in inference space, checked.

        Args:
            choice: a name among `supports`, None for the first of them, or a box of one's own.
            space: in which one's own box is given.

        Raises:
            ValueError: for an unknown name, or a box that is reversed, not finite or outside of Phi.
        """
        natural = is_natural(space)
        if isinstance(choice, Support):
            if natural:
                self.check_box(choice, "support")
                choice = self.space.box_to_inference(choice)
            return check_within(choice, self.inference.feasible)
        if choice is None:
            return next(iter(self.inference.supports.values()))
        if not isinstance(choice, str) or choice not in self.supports:
            raise ValueError(
                f"support: expected one of {sorted(self.supports)} or a box such as jaxlfi.Support([...], [...]), "
                f"got {choice!r}"
            )
        return self.inference.supports[choice]

    def check_box(self, box: Support, label: str) -> None:
        """Refuse a box in natural units that is reversed, not finite, of another dimension or has no logarithm.

        Raises:
            ValueError: naming the box by its label.
        """
        if not isinstance(box, Support):
            raise ValueError(f"{label}: expected a jaxlfi.Support, got {type(box).__name__}")
        if box.dim != self.dim:
            raise ValueError(f"{label}: expected bounds for {self.dim} parameters, got {box.dim}")
        check_within(box, box, label)
        if bool(np.any(np.asarray(box.low)[np.asarray(self.space.log)] <= 0)):
            raise ValueError(f"{label}: expected positive bounds for the log parameters {self.log}, got {box.low}")

    def __eq__(self, other: object) -> bool:
        """Whether all fields are the same, arrays by their values and functions by identity."""
        if self is other:
            return True
        if not isinstance(other, Task):
            return NotImplemented
        return all(same(getattr(self, f.name), getattr(other, f.name)) for f in dataclasses.fields(self))

    def __hash__(self) -> int:
        return hash((self.name, self.names, self.log, self.failures))


def _vector(value: Any, length: int | None, name: str) -> np.ndarray:
    wanted = f"{name}: expected {'some' if length is None else length} finite numbers"
    try:
        vector = np.array(own_arrays.array(value), np.float32)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{wanted}, got {value!r}") from error
    if vector.ndim != 1 or len(vector) != (length or len(vector)) or not np.isfinite(vector).all():
        raise ValueError(f"{wanted}, got shape {vector.shape}")
    return vector
