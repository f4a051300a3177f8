"""summary.json: the summary of a run, and its forms as text, table and HTML."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxlfi.io import files, text_table
from jaxlfi.io.web_page import prose, wide

if TYPE_CHECKING:
    import pandas

NAME = "summary.json"
FOLDER = "FOLDER"
"""Placeholder in next steps for the folder of a run that may not be saved yet."""
UNSAVED = "; for a run without a folder, `jaxlfi.infer` again with "
"""Beginning of the last part of a next step, which a run in a folder does not need."""


@dataclasses.dataclass(frozen=True)
class ParameterSummary:
    """Summary of one parameter, in natural units.

    Attributes:
        name: name of the parameter.
        unit: its unit, "" if it has none.
        median: median of the draws.
        central_50: central 50 % credible interval.
        central_90: central 90 % credible interval.
        narrower: how many times narrower the central 90 % interval is than that of the first guess; less than 1 if it
            is wider.
        narrower_than_phi: the same relative to Phi.
        verdict: "identified", "weakly" or "not at all".
        leans: bounds of the last box that the draws lean on: "lower", "upper", both or none.
        truth: true value; None if it is not known.
        decimals: number of decimals that the Monte Carlo error of the intervals allows; negative for tens and hundreds.
    """

    name: str
    unit: str
    median: float
    central_50: tuple[float, float]
    central_90: tuple[float, float]
    narrower: float
    narrower_than_phi: float
    verdict: str
    leans: tuple[str, ...]
    truth: float | None
    decimals: int

    def shown(self, value: float) -> str:
        """A value of this parameter with as many digits as are known; "-" if it is not finite."""
        if not math.isfinite(value):
            return "-"
        if not 1e-4 <= abs(value) < 1e6 and value:
            digits = self.decimals + math.floor(math.log10(abs(value)))
            return f"{value:.{min(max(digits, 0), 6)}e}"
        return f"{round(value, self.decimals):.{max(self.decimals, 0)}f}"


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """Summary of a run, to `print` or to look at in a notebook.

    Attributes:
        parameters: summaries of the task's parameters, in its order.
        sentences: conclusions from them and from the run.
        next_steps: what to do next, each step with its command or argument.
    """

    parameters: tuple[ParameterSummary, ...]
    sentences: tuple[str, ...]
    next_steps: tuple[str, ...] = ()

    def table(self) -> tuple[list[str], list[list[str]]]:
        """The headings, and a row of texts for each parameter."""
        headings = ["parameter", "median", "50 %", "90 %", "narrower than the guess", "than Phi", "identified"]
        optional = {
            "leans on": lambda one: " and ".join(one.leans),
            "truth": lambda one: "" if one.truth is None else f"{one.truth:.6g}",
        }
        cells = {name: [cell(one) for one in self.parameters] for name, cell in optional.items()}
        shown = {name: column for name, column in cells.items() if any(column)}
        rows = [
            [*_row(one), *(column[place] for column in shown.values())] for place, one in enumerate(self.parameters)
        ]
        return [*headings, *shown], rows

    def to_dict(self) -> dict[str, Any]:
        """The summary as numbers and texts, as in summary.json."""
        return {
            "parameters": [dataclasses.asdict(one) for one in self.parameters],
            "sentences": list(self.sentences),
            "next_steps": list(self.next_steps),
        }

    def to_pandas(self) -> "pandas.DataFrame":
        """The parameters' numbers as a data frame, indexed by name.

        Raises:
            ImportError: without pandas.
        """
        import pandas

        return pandas.DataFrame([dataclasses.asdict(one) for one in self.parameters]).set_index("name")

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> "RunSummary":
        """The summary that `to_dict` described."""
        parameters = tuple(map(_parameter_of, described["parameters"]))
        return cls(parameters, tuple(described["sentences"]), tuple(described["next_steps"]))

    @classmethod
    def read(cls, folder: Path) -> "RunSummary | None":
        """The summary in a run folder; None in folders of earlier versions.

        Raises:
            ValueError: for a damaged summary.
        """
        path = folder / NAME
        if not path.exists():
            return None
        try:
            return cls.from_dict(files.read_json(path))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"{path}: expected the summary of a run, got something else ({error})") from error

    def __str__(self) -> str:
        return "\n".join([text_table.as_text(*self.table()), *self.sentences, *self.steps()])

    def steps(self) -> list[str]:
        """What to do next, in lines of text."""
        return ["Next:", *(f"- {step}" for step in self.next_steps)] if self.next_steps else []

    def at(self, folder: Path | str) -> "RunSummary":
        """The summary of a run saved in a folder, with next steps that name the folder."""

        def saved(step: str) -> str:
            needed, without, _ = step.replace(f"`run.save({FOLDER})`, then ", "").partition(UNSAVED)
            return needed.replace(FOLDER, f"{folder}") + "." * bool(without)

        return dataclasses.replace(self, next_steps=tuple(map(saved, self.next_steps)))

    def to_html(self) -> str:
        """The table and the sentences, as a page or a notebook shows them."""
        items = lambda texts: "<ul>" + "".join(f"<li>{prose(one)}</li>" for one in texts) + "</ul>"
        steps = f"<p>Next:</p>{items(self.next_steps)}" if self.next_steps else ""
        return wide(text_table.as_html(*self.table())) + items(self.sentences) + steps

    _repr_html_ = to_html


def _parameter_of(described: Mapping[str, Any]) -> ParameterSummary:
    """A parameter's summary from its description, in which null stands for NaN."""
    number = lambda value: math.nan if value is None else value
    pairs = {name: tuple(map(number, described[name])) for name in ("central_50", "central_90")}
    numbers = {name: number(described[name]) for name in ("median", "narrower", "narrower_than_phi")}
    return ParameterSummary(**{**described, **pairs, **numbers, "leans": tuple(described["leans"])})


def with_unit(unit: str) -> str:
    """The text that follows a number: its unit, if it has one.

    Example:
        >>> f"2{with_unit('kg')}, 3{with_unit('1/day')}, 4{with_unit('')}"
        '2 kg, 3 per day, 4'
    """
    unit = f"per {unit[2:]}" if unit.startswith("1/") and len(unit) > 2 else unit
    return f" {unit}" if unit else ""


def _row(one: ParameterSummary) -> list[str]:
    interval = lambda ends: f"[{one.shown(ends[0])}, {one.shown(ends[1])}]"
    return [
        one.name,
        one.shown(one.median) + with_unit(one.unit),
        interval(one.central_50),
        interval(one.central_90),
        _times(one.narrower),
        _times(one.narrower_than_phi),
        one.verdict,
    ]


def _times(factor: float) -> str:
    """How many times narrower, in words if it is not narrower."""
    if 0.95 < factor < 1.05:
        return "as wide"
    if factor < 1:
        return f"{_times(1 / factor)} wider"
    return f"{factor:.1f} times" if factor < 10 else f"{factor:.0f} times"
