"""Diagnostics: how far a posterior is from the truth, whether it is calibrated, and where it piles up on a bound."""

from jaxlfi.diagnostics.discrepancy import (
    POSTERIOR_SAMPLES,
    Discrepancy,
    bound_warnings,
    discrepancy,
    edge_mass,
    trajectory_distance,
)

__all__ = [
    "POSTERIOR_SAMPLES",
    "Discrepancy",
    "bound_warnings",
    "discrepancy",
    "edge_mass",
    "trajectory_distance",
]
