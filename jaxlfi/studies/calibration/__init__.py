"""Calibration: whether the posteriors of a finished run's method can be believed, and whether its own fits.

Truths are drawn from the prior over a reference support, or from the run's own posterior, and simulated, and the method
is asked for the posterior of each. A run of one round whose network was kept has learnt all posteriors at once: its
network is conditioned on each simulation. Any other run is repeated for each, with its own settings, support and
heuristic, in chunks.

Over a support whose prior is that of inference, truths and draws of calibrated posteriors are exchangeable: ranks are
uniform, and all checks apply. Truths from the posterior are from another distribution than the prior that each repeated
inference begins with: of these only how often intervals and densest regions hold them is asked, which is what their
levels promise wherever the data and not the prior decide. The folder of the diagnostics:

    plan.json                       what was asked of which run
    box/, posterior/                of the truths over a support, and from the posterior:
        truths.npz                  the truths and their simulations
        chunks/000.npz ...          their posteriors, chunk by chunk; one that is there is not computed again
    diagnostics.json                numbers and verdicts
    diagnostics.npz                 arrays, from which the pictures are drawn
    report.html, figures/           a page with the verdicts and the pictures
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
