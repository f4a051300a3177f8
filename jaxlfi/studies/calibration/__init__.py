"""Calibration: whether the posteriors of a finished run's method can be trusted, and whether its own fits the data.

True parameters (truths) are drawn from the prior over a reference support or from the run's own posterior. Each is
simulated, and the method infers a posterior from the simulation. A run of one round whose network was kept is
amortised: its network is conditioned on each simulation. Any other run is repeated for each, with its own settings,
support and heuristic, in chunks.

Over a support whose prior is that of inference, truths and draws from calibrated posteriors are exchangeable: ranks are
uniform, and all checks apply. Truths from the posterior have another distribution than the prior with which each
repeated inference begins: for these only the coverage of intervals and highest-density regions is checked, which
equals their levels if the data dominate the prior. The folder of the diagnostics:

    plan.json                       the run and the settings of its diagnostics
    box/, posterior/                for truths over a support, and for truths from the posterior:
        truths.npz                  the truths and their simulations
        chunks/000.npz ...          their posteriors by chunk; an existing chunk is not computed again
    diagnostics.json                numbers and verdicts
    diagnostics.npz                 arrays from which the figures are drawn
    report.html, figures/           a page with the verdicts and the figures
"""

from jaxlfi.studies.calibration.checks import Check, read_reference
from jaxlfi.studies.calibration.folder import Diagnosis, diagnose
from jaxlfi.studies.calibration.plan import POSTERIOR, CalibrationPlan, plans_of, read_run
from jaxlfi.studies.calibration.truths import draw_truths
from jaxlfi.studies.calibration.widths import Widths

__all__ = [
    "POSTERIOR", "CalibrationPlan", "Check", "Diagnosis", "Widths", "diagnose", "draw_truths", "plans_of",
    "read_reference", "read_run",
]  # fmt: skip
