"""Diagnostics: how far a posterior is from the truth, whether it is calibrated, and where it piles up on a bound."""

from jaxlfi.diagnostics.bounds import BoundEvidence, bound_evidence, bound_warnings, edge_mass, mass_beyond
from jaxlfi.diagnostics.c2st import c2st
from jaxlfi.diagnostics.calibration import (
    OK,
    SIGNIFICANCE,
    Histogram,
    Uniformity,
    coverage_verdict,
    density_ranks,
    distance_ranks,
    distance_verdict,
    histogram,
    ranks,
    ranks_verdict,
    uniformity,
)
from jaxlfi.diagnostics.discrepancy import (
    POSTERIOR_SAMPLES,
    Discrepancy,
    channel_errors,
    compared,
    discrepancy,
    not_simulated,
    trajectory_distance,
)
from jaxlfi.diagnostics.identifiability import TradeOff, trade_offs
from jaxlfi.diagnostics.intervals import Estimate, Intervals, check_intervals, check_regions
from jaxlfi.diagnostics.misspecification import Finding, unlike
from jaxlfi.diagnostics.predictive import PredictiveCheck, Residual, predictive_check, residuals

__all__ = [
    "OK", "POSTERIOR_SAMPLES", "SIGNIFICANCE", "BoundEvidence", "Discrepancy", "Estimate", "Finding", "Histogram",
    "Intervals", "PredictiveCheck", "Residual", "TradeOff", "Uniformity", "bound_evidence", "bound_warnings",
    "c2st", "channel_errors", "check_intervals", "check_regions", "compared", "coverage_verdict", "density_ranks",
    "discrepancy", "distance_ranks", "distance_verdict", "edge_mass", "histogram", "mass_beyond", "not_simulated",
    "predictive_check", "ranks", "ranks_verdict", "residuals", "trade_offs", "trajectory_distance", "uniformity",
    "unlike",
]  # fmt: skip
