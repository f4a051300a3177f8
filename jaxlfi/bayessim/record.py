"""Records of rounds as named arrays, and the ledger derived from them."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.algorithm import Round
from jaxlfi.bayessim.convergence import Progress
from jaxlfi.diagnostics.discrepancy import Discrepancy

EVIDENCE = "evidence/"
"""Prefix of the heuristic's evidence among the named arrays."""
FINAL = "final_"
"""Prefix of the named arrays that are kept for the last round only."""
PER_SIMULATION = ("theta", "counted", "kept", "failure")
"""Named arrays whose first axis is over the simulations of a round."""


def record(info: Round, progress: Progress, seen: Discrepancy) -> dict[str, jax.Array]:
    """One round as named arrays: the rows of history.npz, and everything that the ledger needs."""
    proposal, belief = info.proposal.support, info.belief.support
    return {
        **_named(info.simulations, "theta", "counted", "kept", "failure", "attempted", "succeeded"),
        "failed": info.failed,
        **{f"proposal_{end}": getattr(proposal, end) for end in ("low", "high")},
        **{f"support_{end}": getattr(belief, end) for end in ("low", "high")},
        **_named(info.adaptation, "low_shift", "high_shift"),
        **{EVIDENCE + name: seen_ for name, seen_ in info.adaptation.evidence.items()},
        **_named(info.belief.mixture, "logits", "means", "scale_tril"),
        **_named(info.fit, "loss", "validation_loss", "chosen_epoch", "nonfinite"),
        **_named(info.correction, "effective_size", "not_positive_definite", "mass_inside", "effective_share"),
        **_named(progress, "moved", "rescaled", "turned", "settled"),
        "predictive_simulations": seen.simulated,
        **{f"sample_{name}": getattr(seen, name) for name in ("theta", "theta_error", "trajectory_error")},
        FINAL + "trajectory": seen.trajectory,
        FINAL + "x": seen.x,
    }


def _named(parts: Any, *names: str) -> dict[str, jax.Array]:
    return {name: getattr(parts, name) for name in names}


def split_final(row: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a record into the arrays that are kept for every round and those kept for the last one only."""
    final = {name: value for name, value in row.items() if name.startswith(FINAL)}
    return {name: value for name, value in row.items() if name not in final}, final


def own_evidence(row: Mapping[str, Any], place: int | None) -> dict[str, Any]:
    """A run's record without the evidence of the heuristics that other runs of its batch follow.

    Args:
        row: a record of one run.
        place: index of the rule of a `Choice` that the run follows; None if all runs follow the same.
    """
    if place is None:
        return dict(row)
    own = f"{EVIDENCE}{place}/"
    kept = {name: value for name, value in row.items() if not name.startswith(EVIDENCE)}
    return kept | {EVIDENCE + name[len(own) :]: value for name, value in row.items() if name.startswith(own)}


def ledger_line(index: int, row: Mapping[str, np.ndarray], reasons: tuple[str, ...], seconds: float) -> dict[str, Any]:
    """A round's line of the ledger.

    Args:
        index: index of the round, from 0.
        row: its record; those of earlier versions have no effective share.
        reasons: names of the reasons for failure.
        seconds: wall time of the round, divided by the number of runs stepped together.
    """
    networks = np.arange(row["chosen_epoch"].shape[0])
    return {
        "round": index,
        "attempted": int(row["attempted"]),
        "succeeded": int(row["succeeded"]),
        "failed": {reason: int(count) for reason, count in zip(reasons, row["failed"], strict=True)},
        **{name: row[name].tolist() for name in ("support_low", "support_high", "proposal_low", "proposal_high")},
        "evidence": {name[len(EVIDENCE) :]: value.tolist() for name, value in row.items() if name.startswith(EVIDENCE)},
        **{name: row[name].tolist() for name in ("low_shift", "high_shift")},
        "loss": float(np.mean(row["loss"][networks, row["chosen_epoch"]])),
        "validation_loss": float(np.mean(row["validation_loss"][networks, row["chosen_epoch"]])),
        "nonfinite_steps": int(np.sum(row["nonfinite"])),
        "effective_size": float(row["effective_size"]),
        "not_positive_definite": int(row["not_positive_definite"]),
        "mass_inside": float(row["mass_inside"]),
        "effective_share": float(row.get("effective_share", np.nan)),
        **{name: float(row[name]) for name in ("moved", "rescaled", "turned")},
        "settled": bool(row["settled"]),
        "predictive_simulations": int(row["predictive_simulations"]),
        "theta_error": theta_error(row),
        "trajectory_error": trajectory_error(row),
        "seconds": round(float(seconds), 4),
    }


def theta_error(row: Mapping[str, np.ndarray]) -> float:
    """|theta - theta_gt| summed over parameters, mean over posterior samples; NaN without a known truth."""
    return float(np.mean(np.sum(row["sample_theta_error"], axis=-1)))


def trajectory_error(row: Mapping[str, np.ndarray]) -> float:
    """Distance from the observed trajectory, mean over the posterior samples that could be simulated."""
    valid = row["sample_trajectory_error"][np.isfinite(row["sample_trajectory_error"])]
    return float(np.mean(valid)) if valid.size else float("nan")


def stacked_rounds(rows: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Records of successive rounds, stacked along a new leading axis.

    Rounds with fewer simulations than others (if those of the first were given) are padded with some that do not count.
    """
    most = max(len(row["theta"]) for row in rows)

    def filled(name: str, array: np.ndarray) -> np.ndarray:
        if name not in PER_SIMULATION:
            return array
        return np.concatenate([array, np.zeros((most - len(array), *array.shape[1:]), array.dtype)])

    return {name: np.stack([filled(name, row[name]) for row in rows]) for name in rows[0]}
