"""A run's note on its posterior's widths before they are measured."""

from jaxlfi.bayessim.settings import Settings
from jaxlfi.heuristics import Heuristic

MEASURE = "run `jaxlfi diagnose` to measure them"
"""How widths become known."""


def widths_note(settings: Settings, heuristic: Heuristic) -> str:
    """One line saying that widths were not measured, and how proposals are corrected for.

    It follows from the settings alone, so it has no numbers. A network trained by the likelihood on proposals p~ learns
    L(theta) p~(theta) instead of L(theta) p(theta), unless something corrects for it (docs: calibration). The error of
    the widths depends on the simulator and on how well the network has learnt: only a measurement can show it.

    Example:
        >>> from jaxlfi.bayessim.presets import QUICK
        >>> from jaxlfi.heuristics import Edge
        >>> widths_note(QUICK, Edge())
        'not measured; corrected for where simulations were drawn (run `jaxlfi diagnose` to measure them)'
    """
    return f"not measured; {_corrected_by(settings, heuristic)} ({MEASURE})"


def _corrected_by(settings: Settings, heuristic: Heuristic) -> str:
    correction, loss = settings.correction, settings.estimator.loss
    if settings.rounds == 1:
        return "a single round needs no correction for the proposals"
    if settings.estimator.is_likelihood:
        return "a likelihood needs no correction for the proposals"
    if heuristic.proposes_from_prior or float(settings.defensive) == 1:
        return "every round drew from the prior over its support, which needs no correction"
    if settings.restriction == "prior":
        return "every round drew from the prior, where the posterior's density was highest, which needs no correction"
    if loss != "likelihood":
        twice = "" if correction == "none" else f", and the correction {correction!r} does so once more"
        return f"the {loss} loss corrects for the proposals{twice}"
    return {
        "none": "nothing corrects for the proposals",
        "pooled": "corrected for where simulations were drawn",
        "importance": "importance weights correct for the proposals",
        "quotient": "the correction 'quotient' divides by the proposals",
        "paper": "the correction 'paper' multiplies posteriors, which counts the observation once per round",
    }[correction]
