"""Presets: named settings of a run."""

from collections.abc import Callable, Mapping
from typing import Any

from jaxlfi.bayessim.correction import OF_MIXTURES
from jaxlfi.bayessim.settings import Settings
from jaxlfi.estimators.base import Estimator, converted
from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.fields import declared
from jaxlfi.tasks.task import Task

PAPER = Settings()
"""Exactly the paper's numbers (section III-C); they are the defaults of `Settings` and `MixtureNetwork`."""

ENSEMBLE: dict[str, Any] = {
    "activation": "tanh",
    "ensemble_size": 4,
    "validation": 0.1,
    "warm_start": False,
    "normaliser": "asinh",
}
"""Four networks that are reinitialised every round."""

QUICK = Settings(
    estimator=MixtureNetwork(
        hidden=(64, 64),
        parameters="zscore",
        reduction="most",
        short_summary=9,
        prune=0.1,
        epochs=100,
        learning_rate=3e-3,
        schedule="cosine",
        **ENSEMBLE,
    ),
    rounds=20,
    min_rounds=10,
    correction="pooled",
    restriction="mixed",
    inflation=2.0,
)
"""An ensemble of four small networks, reinitialised every round: seconds to minutes on two cores.

Chosen by three studies, experiments/studies/ablation.md, widths.md and sharpness-changes.md. If the observation is
unlike everything simulated, as on a wrong support, one network extrapolates confidently to one place, and the next
round learns nothing there. Four disagree, and explore. Proposals twice as wide as the posterior keep its width from
shrinking with every round, and training takes as many passes over the data in the first round as in the last. If ten
rounds do not suffice, the posterior still moves, and more are made.

Regressions of Lotka-Volterra's four parameters on its nine summaries lose half of the information: without the
summaries, one run in eight on a wrong support stays lost. With more numbers, networks that see both overfit: with
twelve, standard deviations were 0.82 times the exact ones, and 0.95 times with the predictions alone. Then only one
network sees the summary, for what regressions miss: from fifty numbers networks learn little, and keep proposals wide.
"""

PRESETS: dict[str, Settings] = {"quick": QUICK, "paper": PAPER}
"""Presets by their names on the command line."""

HYPERPARAMETERS: dict[str, dict[str, dict[str, float]]] = {
    "quick": {},
    "paper": {"edge": {"mass_threshold": 0.005, "uninformed_factor": 1.0}},
}
"""Hyperparameters by which a preset replaces a heuristic's defaults, by the heuristics' registered names."""

FLOW = SplineFlow(
    loss="combined",
    hidden=(50, 50),
    activation="tanh",
    components=4,
    learning_rate=5e-4,
    clip_norm=5.0,
    epochs=500,
    batch_size=50,
    validation=0.1,
    patience=20,
    warm_start=True,
    normaliser="asinh",
)
"""Sequential neural posterior estimation with common settings (Greenberg et al. 2019; the paper's appendix A).

It differs in the combined loss: with the atomic loss alone, a flow under a wide prior leaks to where nothing was
simulated, and the truncated posterior can be altogether wrong. And as in `QUICK`, tanh and asinh limit extrapolation
for an observation unlike all simulations: with ReLU and EDGE, runs on a wrong support stay lost.
"""


def all_rounds(settings: Settings) -> Settings:
    """The same settings with a fixed number of rounds, whether or not the posterior settles."""
    return settings.replace(rounds=min(settings.min_rounds or settings.rounds, settings.rounds), min_rounds=0)


def with_estimator(settings: Settings, estimator: Estimator) -> Settings:
    """The same settings with another estimator; corrections for mixtures of Gaussians are dropped if it is none."""
    needs_mixtures = settings.correction in OF_MIXTURES and not estimator.closed_form
    return settings.replace(estimator=estimator, correction="none" if needs_mixtures else settings.correction)


def apt(settings: Settings) -> Settings:
    """Automatic posterior transformation, SNPE-C: a flow, the atomic loss, proposals from the truncated posterior.

    The flow is masked autoregressive, as in sbi: on most raw series its posteriors are about as wide as the exact ones,
    and those of spline flows were three to six times as wide (experiments/studies/sharpness-changes.md).
    """
    settings = with_estimator(all_rounds(settings), converted(FLOW, MaskedFlow, {}))
    return settings.replace(restriction="reject", inflation=1.0)


def npe(settings: Settings) -> Settings:
    """Neural posterior estimation: all simulations in a single round, from the prior.

    One round leaves time for an ensemble: the average of four flows is better than each. As no round follows,
    extrapolation need not be limited, and ReLU fits better than tanh where there are simulations. Three of the four see
    the predictions of kernel ridge regressions, and start from a linear regression on these: over a whole prior,
    parameters are seldom linear in a summary. One sees the summary alone, for what regressions miss, such as two modes,
    whose mean is not informative. Held-out simulations determine the weights of the flows.
    """
    estimator = FLOW.replace(
        loss="likelihood",
        activation="relu",
        ensemble_size=4,
        reduction="most",
        regressor="kernel",
        regression=3,
        warm_start=False,
    )
    settings = with_estimator(all_rounds(settings), estimator)
    return settings.replace(
        restriction="reject",
        inflation=1.0,
        rounds=1,
        simulations_per_round=settings.rounds * settings.simulations_per_round,
        simulation_budget=settings.rounds * settings.simulation_budget,
    )


def tsnpe(settings: Settings) -> Settings:
    """Truncated sequential neural posterior estimation (Deistler, Goncalves and Macke 2022), by flows.

    Proposals are drawn from the prior, in the region where the last posterior's density is highest. Flows are therefore
    trained by the likelihood, on the simulations of all rounds, and need no correction. So networks that see different
    inputs can be weighted by their log score on held-out simulations, as in `QUICK`: one sees the summary, and two see
    the predictions of regressions near the observation, and start from these. Also as in `QUICK`, networks are
    reinitialised every round.
    """
    estimator = FLOW.replace(
        loss="likelihood",
        ensemble_size=3,
        reduction="most",
        regression=2,
        warm_start=False,
        epochs=100,
        patience=0,
        learning_rate=2e-3,
        schedule="cosine",
    )
    settings = with_estimator(all_rounds(settings), estimator)
    return settings.replace(restriction="prior", inflation=1.0)


LIKELIHOOD = MixtureLikelihood(hidden=(50, 50), components=2, epochs=0, steps=1000, learning_rate=1e-3, **ENSEMBLE)
"""Four networks of two Gaussians over the summaries; hardly tuned."""


def snle(settings: Settings) -> Settings:
    """Sequential neural likelihood: an ensemble of mixture networks for the summary given the parameters.

    No correction is needed whatever the proposals, so they are wider than the posterior, and some come from the prior:
    where nothing was simulated, a likelihood is an extrapolation, and may be too high.
    """
    settings = with_estimator(all_rounds(settings), LIKELIHOOD)
    return settings.replace(restriction="reject", inflation=2.0, defensive=0.2)


METHODS: dict[str, Callable[[Settings], Settings]] = {
    "bayessim": lambda settings: settings,
    "tsnpe": tsnpe,
    "apt": apt,
    "npe": npe,
    "snle": snle,
}
"""Functions from a preset's settings to a method's, by name. All methods are Algorithm 1 with different parts."""


def settings_for(task: Task, method: str = "bayessim", preset: str = "quick") -> Settings:
    """The settings that `jaxlfi infer` starts from: those of a method and preset, with the task's own changes.

    Args:
        task: the task; its `settings` name fields of `Settings`, or of the methods' estimators, of which those of other
            methods are ignored.
        method: a name in `METHODS`.
        preset: a name in `PRESETS`.

    Raises:
        ValueError: for settings of the task that no method has, and for unknown methods and presets.
    """
    for what, name, known in (("method", method, METHODS), ("preset", preset, PRESETS)):
        if not isinstance(name, str) or name not in known:
            raise ValueError(f"{what}: expected one of {', '.join(known)}, got {name!r}")
    fields = {name for known in METHODS.values() for name in declared(known(PRESETS[preset]).estimator)}
    if unknown := sorted(set(task.settings) - fields - set(declared(Settings))):
        raise ValueError(f"{task.name}: settings: expected names of Settings or of an estimator, got {unknown[0]!r}")
    wanted = lambda of: {name: value for name, value in task.settings.items() if name in declared(of)}
    settings = PRESETS[preset]
    settings = METHODS[method](settings.replace(**wanted(settings)))  # the method splits the budget into rounds
    return with_fields(settings, wanted(settings.estimator))


def with_fields(settings: Settings, given: Mapping[str, Any]) -> Settings:
    """Settings with the named fields replaced, of the run or of its estimator.

    Raises:
        ValueError: for a name that neither has.

    Example:
        >>> with_fields(QUICK, {"rounds": 5, "epochs": 10}).estimator.epochs
        10
    """
    own = {name: value for name, value in given.items() if name in declared(settings)}
    others = {name: value for name, value in given.items() if name not in own}
    estimator = converted(settings.estimator, type(settings.estimator), others)
    return settings.replace(estimator=estimator, **own)
