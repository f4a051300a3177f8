"""summary.json: what a run found, stated, and its forms as text, table and HTML."""

import dataclasses
import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxlfi.io import files

NAME = "summary.json"


@dataclasses.dataclass(frozen=True)
class ParameterSummary:
    """What is known of one parameter, in natural units.

    Attributes:
        name: of the parameter.
        unit: "" where it has none.
        median: of the draws.
        central_50: the interval between the quarters.
        central_90: between the first and the last twentieth.
        narrower: how many times narrower the central 90 % are than those of the first guess, in inference space.
        verdict: "identified", "weakly" or "not at all".
        leans: on which bounds of the last box the draws lean: "lower", "upper", both or none.
        truth: where it is known, else None.
        decimals: as many as the Monte Carlo error of the intervals allows; negative for tens and hundreds.
    """

    name: str
    unit: str
    median: float
    central_50: tuple[float, float]
    central_90: tuple[float, float]
    narrower: float
    verdict: str
    leans: tuple[str, ...]
    truth: float | None
    decimals: int

    def shown(self, value: float) -> str:
        """A value of this parameter with as many digits as are known; "-" for what is no number."""
        if not math.isfinite(value):
            return "-"
        if not 1e-4 <= abs(value) < 1e6 and value:
            digits = self.decimals + math.floor(math.log10(abs(value)))
            return f"{value:.{min(max(digits, 0), 6)}e}"
        return f"{round(value, self.decimals):.{max(self.decimals, 0)}f}"


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """What a run found: `print` it, or look at it in a notebook.

    Attributes:
        parameters: of the task, in its order.
        sentences: what follows from them.
    """

    parameters: tuple[ParameterSummary, ...]
    sentences: tuple[str, ...]

    def table(self) -> tuple[list[str], list[list[str]]]:
        """The headings, and a row of texts for each parameter."""
        headings = ["parameter", "median", "50 %", "90 %", "narrower than the guess", "identified"]
        known = any(one.truth is not None for one in self.parameters)
        return headings + ["truth"] * known, [_row(one, known) for one in self.parameters]

    def to_dict(self) -> dict[str, Any]:
        """The same as numbers and texts, as summary.json has it."""
        return {"parameters": [dataclasses.asdict(one) for one in self.parameters], "sentences": list(self.sentences)}

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> "RunSummary":
        """The summary that `to_dict` described."""
        return cls(tuple(map(_parameter_of, described["parameters"])), tuple(described["sentences"]))

    @classmethod
    def read(cls, folder: Path) -> "RunSummary | None":
        """The summary in a run folder; None in those of earlier versions.

        Raises:
            ValueError: for a damaged one.
        """
        path = folder / NAME
        if not path.exists():
            return None
        try:
            return cls.from_dict(files.read_json(path))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{path}: expected the summary of a run, got something else ({error})") from error

    def __str__(self) -> str:
        headings, rows = self.table()
        widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in (headings, *rows)]
        return "\n".join([*lines, *self.sentences])

    def to_html(self) -> str:
        """The table and the sentences, as a page or a notebook shows them."""
        headings, rows = self.table()
        cells = lambda row, tag: "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)
        body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
        said = "".join(f"<li>{html.escape(one)}</li>" for one in self.sentences)
        return f"<table><thead><tr>{cells(headings, 'th')}</tr></thead><tbody>{body}</tbody></table><ul>{said}</ul>"

    _repr_html_ = to_html


def _parameter_of(described: Mapping[str, Any]) -> ParameterSummary:
    """From its description, in which null stands for what is no number."""
    number = lambda value: math.nan if value is None else value
    pairs = {name: tuple(map(number, described[name])) for name in ("central_50", "central_90")}
    numbers = {name: number(described[name]) for name in ("median", "narrower")}
    return ParameterSummary(**{**described, **pairs, **numbers, "leans": tuple(described["leans"])})


def _row(one: ParameterSummary, known: bool) -> list[str]:
    interval = lambda ends: f"[{one.shown(ends[0])}, {one.shown(ends[1])}]"
    unit = f" {one.unit}" if one.unit else ""
    cells = [
        one.name,
        one.shown(one.median) + unit,
        interval(one.central_50),
        interval(one.central_90),
        f"{one.narrower:.1f} times" if one.narrower < 10 else f"{one.narrower:.0f} times",
        one.verdict,
    ]
    return cells + ["" if one.truth is None else f"{one.truth:.6g}"] * known
