"""Sequential neural posterior estimation: flows, the atomic loss of APT, and mixtures fitted to a flow's draws."""

from jaxlfi.npe.atomic import Contrasts, Within, acceptance, atomic, contrast, log_prob_truncated, nll, sample_within
from jaxlfi.npe.flows import FLOWS, MAF, NSF, Flow
from jaxlfi.npe.mixture_fit import fit_mixture

__all__ = [
    "FLOWS",
    "MAF",
    "NSF",
    "Contrasts",
    "Flow",
    "Within",
    "acceptance",
    "atomic",
    "contrast",
    "fit_mixture",
    "log_prob_truncated",
    "nll",
    "sample_within",
]
