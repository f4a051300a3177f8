"""Presets: named settings of a run."""

from collections.abc import Callable

from jaxlfi.bayessim.settings import Settings
from jaxlfi.estimators.flow_estimators import SplineFlow
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork

PAPER = Settings()
"""The paper's numbers to the letter (section III-C); they are the defaults of `Settings` and `MixtureNetwork`."""

ENSEMBLE = {
    "activation": "tanh",
    "ensemble_size": 4,
    "learning_rate": 1e-3,
    "epochs": 0,
    "steps": 1000,
    "validation": 0.1,
    "warm_start": False,
    "normaliser": "asinh",
}
"""Training of four networks that start anew every round."""

QUICK = Settings(estimator=MixtureNetwork(hidden=(64, 64), prune=0.1, **ENSEMBLE))
"""An ensemble of four small networks that start anew every round: minutes on two cores.

Chosen by the ablation in experiments/README.md. Where an observation is unlike everything simulated, as it
is on a wrong support, one network extrapolates confidently to one place, and the next round learns nothing
there. Four disagree, and explore.
"""

PRESETS: dict[str, Settings] = {"quick": QUICK, "paper": PAPER}
"""Presets by the name the command line gives them."""

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
"""Sequential neural posterior estimation as it is commonly set up (Greenberg et al. 2019; the paper's appendix A).

But for the combined loss: by the atomic loss alone, a flow under a wide prior leaks to where nothing was simulated,
and the posterior it is truncated to can be wrong altogether. And as in `QUICK`, tanh and asinh keep what the network
says of an observation unlike all simulations near what it has seen: with ReLU and EDGE, runs on a wrong support stay
lost.
"""


def apt(settings: Settings) -> Settings:
    """Automatic posterior transformation, SNPE-C: a flow, the atomic loss, truncated proposals."""
    return settings.replace(estimator=FLOW, restriction="reject")


def npe(settings: Settings) -> Settings:
    """Neural posterior estimation: all simulations in a single round, from the prior.

    One round leaves time for an ensemble: averaged over four, flows are better than each. And as no round follows,
    there is no need to hold back where nothing was simulated: ReLU fits better than tanh where something was.
    """
    return settings.replace(
        estimator=FLOW.replace(loss="likelihood", activation="relu", ensemble_size=4),
        restriction="reject",
        rounds=1,
        extra_rounds=0,
        simulations_per_round=settings.rounds * settings.simulations_per_round,
        simulation_budget=settings.rounds * settings.simulation_budget,
    )


LIKELIHOOD = MixtureLikelihood(hidden=(50, 50), components=2, **ENSEMBLE)
"""Four networks of two Gaussians over the summaries; hardly tuned."""


def snle(settings: Settings) -> Settings:
    """Sequential neural likelihood: an ensemble of mixture networks for the summary given the parameters.

    As no correction is needed whatever was proposed, proposals are wider than the posterior, and some are the prior's:
    a likelihood is an extrapolation where nothing was simulated, and may be high there by mistake.
    """
    return settings.replace(estimator=LIKELIHOOD, restriction="reject", inflation=2.0, defensive=0.2)


METHODS: dict[str, Callable[[Settings], Settings]] = {
    "bayessim": lambda settings: settings,
    "apt": apt,
    "npe": npe,
    "snle": snle,
}
"""What a method makes of a preset, by the name the command line gives it. All are Algorithm 1 with other parts."""
