"""Widths: how far the settings of a run let its posteriors' widths be trusted, before anything was measured."""

import math

from jaxlfi.bayessim.settings import Settings
from jaxlfi.heuristics import Heuristic

MEASURE = "expected from the settings; `jaxlfi diagnose` measures it"
"""How that is known."""


def expected_widths(settings: Settings, heuristic: Heuristic) -> str:
    """How far the widths of a run's posterior can be trusted, and why, in one line.

    A network trained by the likelihood learns L(theta) p~(theta), with p~ what simulations were drawn from. Where that
    is the last posterior itself, every round counts the observation again; where it is s times as wide, the width
    settles at sqrt(1 - 1/s^2) of the right one (docs: calibration).

    Args:
        settings: of the run.
        heuristic: of the run.
    """
    return f"{_expected(settings, heuristic)} ({MEASURE})"


def _expected(settings: Settings, heuristic: Heuristic) -> str:
    inflation, correction = float(settings.inflation), settings.correction
    if settings.rounds == 1:
        return "right in principle, as all simulations are drawn from the prior"
    if settings.estimator.of_summaries:
        return "right in principle, as a likelihood does not depend on the proposals"
    if heuristic.proposes_from_prior or float(settings.defensive) == 1:
        return "right in principle, as every round draws from the prior over its support"
    if settings.estimator.loss != "likelihood":
        if correction == "none":
            return f"right in principle, as the {settings.estimator.loss} loss allows for the proposals"
        return (
            f"uncertain, as the {settings.estimator.loss} loss allows for the proposals and the correction "
            f"{correction!r} does so again"
        )
    if correction == "importance":
        return "right in principle, by importance weights, but few simulations have most of the weight"
    if correction == "paper":
        return "too narrow as a rule, as the correction 'paper' multiplies posteriors and counts the observation again"
    if correction == "quotient":
        if inflation > 1:
            return f"right in principle, as proposals {inflation:g} times as wide are divided out"
        return "uncertain, as the correction 'quotient' divides by proposals as wide as the posterior (no inflation)"
    if inflation > 1:
        percent = 100 * math.sqrt(1 - 1 / inflation**2)
        wide = f"{inflation:g} times as wide"
        return f"about {percent:.0f} % of the right ones, as proposals are {wide} and not corrected"
    return "too narrow as a rule, as every round counts the observation again, uncorrected"
