"""The command `jaxlfi mujoco inspect`, whose arguments `jaxlfi.envs.mujoco.cli` parses."""

import argparse
import dataclasses
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxlfi.cli import tables
from jaxlfi.envs.mujoco import config, first_file, inspection, log_files
from jaxlfi.envs.mujoco.inspection import Inspected, Signal
from jaxlfi.envs.mujoco.model_task import compile_spec, specification

SHOWN = 3
"""Largest number of lines on one signal, if several recordings have more."""


def inspect(arguments: argparse.Namespace) -> None:
    """Print the signals of recordings and their counterparts in a model, and write a first version of a task's file.

    Raises:
        ValueError: for recordings and models that cannot be read, and a file that already exists.
    """
    out = arguments.out
    if out is not None and out.exists():
        raise ValueError(f"--out: expected a new file, got {out}")
    spec = specification(arguments.model)
    model = compile_spec(spec)
    recorded = [one for path in arguments.logs for one in log_files.recorded(path)]
    several = inspection.inspect_all(spec, model, recorded)
    on = tables.Output.of(json=arguments.json)
    if arguments.json:
        print(json.dumps(plain(str(arguments.model), several), indent=2))
    else:
        show(several, on.results)
    if out is not None:
        logs = [path for path in arguments.logs if _usable(path, several)] or arguments.logs
        text = first_file.text(out, spec, Path(arguments.model), logs, several)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text)
        for line in _next(out):
            on.notes.print(line, markup=False, highlight=False, soft_wrap=True)


def show(several: Sequence[Inspected], console: Console) -> None:
    """Print the table of all signals, and the anomalies below it."""
    table = Table(title=_title(several))
    for heading in ("signal", "unit", "rate", "gaps", "range", "in the model", "odd"):
        table.add_column(heading)
    lines = _lines({one.name: one.odd for one in several})
    for signal in inspection.together(several).values():
        own = {one.name: one.signals[signal.name].odd for one in several if signal.name in one.signals}
        texts = _some(_lines(own) if len(several) > 1 else list(signal.odd))
        numbers = [str(len(lines) + 1 + place) for place in range(len(texts))]
        lines += [f"{signal.name}: {text}" for text in texts]
        table.add_row(*(escape(cell) for cell in (*_cells(signal), ", ".join(numbers))))
    tables.show(table, console)
    for number, line in enumerate(lines, start=1):
        console.print(f"{number}. {line}", markup=False, highlight=False, soft_wrap=True)


def plain(model: str, several: Sequence[Inspected]) -> dict[str, Any]:
    """The same as data for JSON; unknown numbers are null."""
    recordings = [
        {
            **{"file": one.name, "rows": one.rows, "duration": one.duration, "usable": one.usable},
            **{"odd": list(one.odd), "time_unit": one.time.unit if one.time else None},
            "signals": {name: _plain(signal) for name, signal in one.signals.items()},
        }
        for one in several
    ]
    return {"model": model, "recordings": recordings}


def _plain(signal: Signal) -> dict[str, Any]:
    found = dataclasses.asdict(signal)
    del found["name"]
    for key in ("place", "called"):
        value = getattr(signal, key)
        found[key] = value._asdict() if value else None
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in found.items()}


def _some(texts: list[str]) -> list[str]:
    """The first of many lines on one signal, and how many more there are."""
    if len(texts) <= SHOWN + 1:
        return texts
    return [*texts[:SHOWN], f"and {len(texts) - SHOWN} more lines, which --json has"]


def _cells(signal: Signal) -> Iterator[str]:
    yield signal.name
    yield signal.unit
    yield f"{signal.rate:.4g} Hz" if signal.samples > 1 else ""
    yield f"{signal.gaps}, up to {signal.longest:.3g} s" if signal.gaps else ""
    yield f"{signal.low:.4g} to {signal.high:.4g}" if signal.samples else "no samples"
    if signal.place is not None:
        yield signal.place.what if signal.place.sure else f"probably {signal.place.what}"
    else:
        yield f"nothing; nearest: {', '.join(signal.nearest)}" if signal.nearest else "nothing"


def _title(several: Sequence[Inspected]) -> str:
    what = several[0].name if len(several) == 1 else f"{len(several)} recordings"
    return escape(f"{what}: {sum(one.rows for one in several)} rows in {sum(one.duration for one in several):.4g} s")


def _lines(odd: Mapping[str, Sequence[str]]) -> list[str]:
    """The distinct lines about recordings, with the recording or their number."""
    found: dict[str, list[str]] = {}
    for name, texts in odd.items():
        for text in texts:
            found.setdefault(text, []).append(Path(name).name)
    if len(odd) == 1:
        return list(found)
    return [f"{text} ({of[0] if len(of) == 1 else f'{len(of)} recordings'})" for text, of in found.items()]


def _usable(path: Path, several: Sequence[Inspected]) -> bool:
    """Whether a task can read what a path names."""
    folder = str(path).partition("#")[0]
    own = [one for one in several if one.name.partition("#")[0] == folder]
    return all(one.usable for one in own)


def _next(out: Path) -> Iterator[str]:
    """What to do next with a file, depending on whether it is a task already."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the table shows them
            task = config.read(out)
    except ValueError as error:
        yield f"{out}: written; it is not a task yet: {str(error).removeprefix(f'{out}: ')}"
        return
    yield f"{out}: written, a task with the parameters {', '.join(task.names)}; choose others in it, then"
    yield f"  jaxlfi infer mujoco,config={out} --heuristic edge --out runs/{out.stem}"
