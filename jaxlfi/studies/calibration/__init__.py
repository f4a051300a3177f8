"""Calibration: whether the posteriors of a finished run's method can be believed, and whether its own fits.

Truths are drawn from the prior over a reference support and simulated, and the method is asked for the posterior of
each. A run of one round whose network was kept has learnt all posteriors at once: its network is conditioned on each
simulation. Any other run is repeated for each, with its own settings, support and heuristic, in chunks. The folder of
the diagnostics:

    plan.json             what was asked of which run
    truths.npz            the truths and their simulations
    chunks/000.npz ...    their posteriors, chunk by chunk; one that is there is not computed again
    diagnostics.json      the checks' numbers and verdicts
    diagnostics.npz       arrays, from which the pictures are drawn
    figures/              the pictures
"""

from jaxlfi.studies.calibration.checks import Check, read_reference
from jaxlfi.studies.calibration.folder import diagnose
from jaxlfi.studies.calibration.plan import CalibrationPlan, read_run
from jaxlfi.studies.calibration.truths import draw_truths

__all__ = ["CalibrationPlan", "Check", "diagnose", "draw_truths", "read_reference", "read_run"]
