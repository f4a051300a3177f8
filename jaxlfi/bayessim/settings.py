"""Settings of an inference run."""

import dataclasses

from jaxtyping import Array, Float

from jaxlfi.bayessim.correction import CORRECTIONS, OF_MIXTURES
from jaxlfi.distributions.belief import RESTRICTIONS
from jaxlfi.estimators.base import Estimator
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.fields import Checked, check_fields, hyperparameter, option


class Settings(Checked):
    """Settings of an inference run. The defaults are the paper's.

    Attributes:
        estimator: the density estimator and its training: an instance of one of the families
            (`jaxlfi.MixtureNetwork`, `jaxlfi.SplineFlow`, `jaxlfi.MaskedFlow`).
        rounds: largest number of inference rounds N_LFI.
        min_rounds: smallest number of rounds; the run then ends as soon as its posterior has settled
            (`jaxlfi.bayessim.convergence`). 0: always run all rounds, as in the paper.
        simulations_per_round: largest number of valid simulations added to the dataset each round.
        simulation_budget: largest number of simulations attempted each round, failures included.
        correction: how q_phi becomes the posterior, "none", "paper", "quotient", "pooled" or "importance"
            (docs/paper.md, reading A).
        restriction: how proposals are kept in the support, "clip", "reject" or "mixed" (docs/paper.md, reading E); or
            "prior": they are drawn from the prior, where the posterior's density is highest.
        defensive: fraction of each round's proposals drawn from the prior over the current support instead of the
            posterior; 0 in the paper. A leaf.
        inflation: width of the proposals relative to the posterior, about its mean; 1 in the paper. Without a
            correction, a Gaussian posterior settles at sqrt(1 - 1/s^2) of its true width if proposals are s times as
            wide; with s = 1 it narrows every round (docs: calibration). A leaf.
        predictive: whether 20 draws of each round's posterior are also simulated, to compare them with the
            observation (section V). The ledger reports these simulations; inference does not use them.
    """

    estimator: Estimator = dataclasses.field(default=MixtureNetwork())
    rounds: int = option(default=10, low=1, high=100_000, help="largest number of inference rounds, N_LFI")
    min_rounds: int = option(
        default=0,
        low=0,
        high=100_000,
        help="smallest number of rounds; the run then ends once its posterior has settled; 0: always run all rounds",
    )
    simulations_per_round: int = option(
        default=100, low=1, high=100_000_000, help="largest number of valid simulations added per round"
    )
    simulation_budget: int = option(
        default=125,
        low=1,
        high=100_000_000,
        help="largest number of simulations attempted per round, failures included",
    )
    correction: str = option(
        default="none", choices=tuple(CORRECTIONS), help="how to correct for proposals that are not the prior"
    )
    restriction: str = option(default="clip", choices=tuple(RESTRICTIONS), help="how proposals are kept in the support")
    defensive: Float[Array, "*batch"] | float = hyperparameter(
        default=0.0, low=0.0, high=1.0, help="fraction of proposals drawn from the prior over the support"
    )
    inflation: Float[Array, "*batch"] | float = hyperparameter(
        default=1.0, low=1.0, high=100.0, help="width of the proposals, relative to the posterior"
    )
    predictive: bool = option(
        default=True, help="simulate 20 draws of each round's posterior and compare them with the observation"
    )

    @property
    def includes_prior(self) -> bool:
        """Whether posteriors account for a task's own prior even if the proposals do not contain it."""
        by_weights = CORRECTIONS[self.correction].includes_prior
        return self.rounds == 1 or by_weights or self.estimator.includes_prior

    def check(self) -> "Settings":
        """Refuse settings that cannot work, by name; returns the settings."""
        if not isinstance(self.estimator, Estimator):
            raise ValueError(f"estimator: expected one such as jaxlfi.MixtureNetwork(), got {self.estimator!r}")
        self.estimator.check()
        check_fields(self)
        if self.simulation_budget < self.simulations_per_round:
            raise ValueError(
                f"simulation_budget: expected at least the {self.simulations_per_round} simulations of a round, "
                f"got {self.simulation_budget}"
            )
        if self.restriction == "prior" and self.correction != "none":
            raise ValueError(
                f"correction: expected 'none' with restriction='prior', whose proposals need none, got "
                f"{self.correction!r}"
            )
        if self.correction in OF_MIXTURES and not self.estimator.closed_form:
            raise ValueError(
                f"correction: expected 'none' or 'importance' for {type(self.estimator).__name__}, as "
                f"{self.correction!r} calculates with mixtures of Gaussians, got {self.correction!r}"
            )
        if self.correction != "none" and self.estimator.is_likelihood:
            raise ValueError(
                f"correction: expected 'none' for {type(self.estimator).__name__}, as a likelihood does not depend on "
                f"the proposals, got {self.correction!r}"
            )
        return self
