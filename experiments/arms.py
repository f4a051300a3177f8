"""Shared code of studies with several arms: means with intervals, contrasts against one arm, and settings."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.diagnostics.contrasts import Arm, Contrast, contrast, holm
from jaxlfi.io import files, provenance, serialise


def mean(arm: Arm) -> Contrast:
    """The mean of an arm, as a difference from zero, with its interval over objects, seeds and places."""
    objects, _, places = arm.values.shape
    return contrast(Arm(np.zeros((objects, 1, places))), Arm(-arm.values, arm.shared))


def with_interval(found: Contrast, digits: int) -> str:
    """A difference and its interval."""
    return f"{found.difference:.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"


def p_text(p: float) -> str:
    """A p-value to three digits."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def contrast_rows(
    one: Arm, others: Mapping[str, Arm], against: str = "against", difference: str = "difference", digits: int = 2
) -> list[dict[str, str]]:
    """A row for the difference of one arm from each other one; all p-values are one family for Holm's correction.

    Args:
        one: the arm that should be ahead.
        others: the other arms, by name.
        against: heading of the names.
        difference: heading of the differences.
        digits: number of decimals of differences and effect sizes.
    """
    found = {name: contrast(one, other) for name, other in others.items()}
    corrected = holm([each.p for each in found.values()])
    return [
        {
            against: name,
            difference: with_interval(each, digits),
            "p": p_text(each.p),
            "p, Holm": p_text(p),
            "g": f"{each.standardised:.{digits}f}" if np.isfinite(each.standardised) else "-",
            "A": f"{each.superiority:.2f}",
        }
        for (name, each), p in zip(found.items(), corrected, strict=True)
    ]


def write_config(out: Path, module: str, settings: Any) -> None:
    """Write the settings, versions and command of a study that a module runs to the study's folder."""
    command = provenance.command_line(["python", "-m", module, *sys.argv[1:]])
    files.write_json(
        out / "config.json", provenance.environment() | {"command_line": command, "settings": written(settings)}
    )


def written(settings: Any) -> dict[str, Any]:
    """Settings as they are written: JSON has lists, but no tuples."""
    return json.loads(json.dumps(serialise.fields_to_json(settings, serialise.class_name)))


def written_settings(out: Path) -> dict[str, Any]:
    """The settings in the folder of a study."""
    return json.loads((out / "config.json").read_text())["settings"]


def markdown(rows: list[dict[str, str]]) -> str:
    """Rows as a Markdown table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
