"""The page: one self-contained HTML file with the table of results and the pictures."""

import base64
import dataclasses
import html
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import statistics, style
from jaxlfi.figures.collection import Collection, all_of, first_of, seed_count
from jaxlfi.figures.history import heuristic_name
from jaxlfi.figures.style import looks, natural, unit_label
from jaxlfi.io import files, web_page
from jaxlfi.io.run_summary import RunSummary
from jaxlfi.io.web_page import prose, wide


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture on the page."""

    path: Path  # path of the png
    title: str  # heading above it
    caption: str  # text below it
    width: float  # width in inches, as in a paper


Drawing = tuple[str, Figure, str, str]
"""The name of a picture's file, its figure, title and caption."""


def write(
    folder: Path, drawings: Iterable[Drawing], render: Callable[[Sequence[Picture]], str], dpi: float
) -> list[Path]:
    """Save pictures in this package's style as they are drawn, then the page; return their paths, the page's first."""
    pictures = []
    with style.context():
        for name, figure, title, caption in drawings:
            path = style.save(figure, folder / "figures" / f"{name}.png", dpi)
            pictures.append(Picture(path, title, caption, float(figure.get_size_inches()[0])))
    index = folder / "report.html"
    files.write_bytes(index, render(pictures).encode(errors="replace"))
    return [index, *(picture.path for picture in pictures)]


_COLUMNS = {
    "theta_error": "parameter error",
    "trajectory_error": "trajectory error",
    "success_rate": "success rate [%]",
    "seconds": "time [s]",
}


UNMEASURED = "not measured"
"""How a run's text on its widths begins. Earlier versions had a number instead, which was never measured."""


def render(collection: Collection, pictures: Sequence[Picture]) -> str:
    """The page of a collection of runs as text."""
    config = collection.config
    first = first_of(collection.runs)
    task = _short(
        config.get("task") or first.config.get("task") or first.config.get("task_name") or collection.folder.name
    )
    title = f"{task}: {len(collection.table)} run{'s' if len(collection.table) != 1 else ''} of jaxlfi"
    return _document(
        title,
        [
            _answer(collection),
            _widths(collection),
            _facts(collection),
            _notes(collection),
            f"<h2>Results</h2>{_table(collection)}",
        ],
        pictures,
        config,
    )


def render_grid(config: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    """The page of a sensitivity grid as text, from its config.json."""
    heuristic = heuristic_name(config["heuristic"])
    task = _short(config["task"] or config["task_name"])
    title = f"{task}: sensitivity of {heuristic} in {config['runs']} runs of jaxlfi"
    varied = [f"{axis['name']}: {', '.join(f'{v:g}' for v in axis['values'])}" for axis in config["axes"]]
    facts = {
        "Hyperparameters": "; ".join(varied),
        "Support": config["support"]["name"],
        "Rounds": config["settings"]["rounds"],
        "Seeds": len(config["seeds"]),
        **_provenance(config.get),
    }
    note = "<p>table.csv has one line for each run; grid.npz has these and further results as arrays.</p>"
    return _document(title, [_definitions(facts), note], pictures, config)


def render_diagnostics(found: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    """The page of a diagnostics.json as text; it begins with how far the widths can be trusted, in plain words."""
    run = found["run"]
    title = f"{_short(run['task'] or run['configuration'])}: can its widths be trusted?"
    way = {
        "amortised": "the run's network gave the posterior of each simulation",
        "repeated": "the whole inference was repeated for each simulation",
    }[found["way"]]
    boxes = [one["name"] for one in found["references"] if "low" in one]
    intro = (
        "<p>Parameters were drawn, simulated, and inferred again from their simulations alone: "
        f"{html.escape(way)}. 90 % intervals are calibrated if they cover nine of ten of these truths.</p>"
    )
    verdicts = "".join(
        f'<h3>{html.escape(one["heading"])}</h3><ul class="verdicts">'
        + "".join(f'<li class="{_tone(row["verdict"])}">{prose(row["sentence"])}</li>' for row in one["found"])
        + "</ul>"
        for one in found["widths"]
    )
    questions = (
        "<p>At this run's posterior: is the method calibrated near this run's result? Over a support: is it calibrated "
        "for all kinds of objects? Most truths over a support are unlike this run's. In brackets are 95 % "
        "confidence intervals, for all parameters together.</p>"
    )
    parts = [intro, verdicts, questions, f"<h2>Side by side</h2>{_widths_table(found)}"]
    over = f" over the support {boxes[0]}, and of this run's own posterior" if boxes else " of this run's own posterior"
    parts.append(f"<h2>Checks{html.escape(over)}</h2>{_checks_table(found['checks'])}")
    shown = {name: value for name, value in found.items() if name not in ("widths", "checks")}
    return _document(title, parts, pictures, shown, "diagnostics.json")


def _tone(verdict: str) -> str:
    return {"calibrated": "good", "honest": "good", "ok": "good", "": "soft", "undecided": "soft"}.get(verdict, "bad")


def _widths_table(found: Mapping[str, Any]) -> str:
    """Coverage, width factor and verdict of each parameter, with the references side by side."""
    levels = found["widths"][0]["levels"]
    columns = [*(f"{100 * level:.0f} % covered" for level in levels), "right width", "verdict"]
    head = "".join(
        f'<th class="first" colspan="{len(columns)}">{html.escape(one["heading"])}</th>' for one in found["widths"]
    )
    below = "".join(f'<th class="{"first" * (i == 0)}">{name}</th>' for i, name in enumerate(columns))
    lines = []
    for rows in zip(*(one["found"] for one in found["widths"]), strict=True):
        cells = ""
        for row in rows:
            held = [_estimate(fraction, lambda x: f"{100 * x:.0f}") for fraction in row["held"]]
            values = [*held, _estimate(row["factor"], lambda x: f"{x:.2f}"), row["verdict"]]
            cells += "".join(f'<td class="{"first" * (i == 0)}">{html.escape(v)}</td>' for i, v in enumerate(values))
        lines.append(f"<tr><td>{html.escape(rows[0]['name'])}</td>{cells}</tr>")
    below = "<th>parameter</th>" + below * len(found["widths"])
    return wide(
        f"<table><thead><tr><th></th>{head}</tr><tr>{below}</tr></thead><tbody>{''.join(lines)}</tbody>"
        "<caption>Covered: percentage of the truths inside intervals of that level (all together: densest regions). "
        "Right width: how many times as wide 90 % intervals would have to be to cover 90 %.</caption></table>"
    )


def _estimate(found: Mapping[str, float | None] | None, words: Callable[[float], str]) -> str:
    if found is None:
        return "–"
    numbers = (found[name] for name in ("value", "low", "high"))
    value, low, high = ("∞" if number is None else words(number) for number in numbers)
    return f"{value} [{low}, {high}]"


def _checks_table(checks: Sequence[Mapping[str, Any]]) -> str:
    lines = []
    for check in checks:
        p_value = "" if check["p_value"] is None else f"{check['p_value']:.2g}"
        cells = (check["name"], check["statistic"], check["expected"], p_value)
        row = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        lines.append(f'<tr>{row}<td class="{_tone(check["verdict"])}">{html.escape(check["verdict"])}</td></tr>')
    head = "".join(f"<th>{name}</th>" for name in ("check", "statistic", "expected", "p-value", "verdict"))
    return wide(f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>")


def _document(
    title: str,
    parts: Sequence[str],
    pictures: Sequence[Picture],
    config: Mapping[str, Any],
    name_of_config: str = "config.json",
) -> str:
    """A whole page: a heading, these parts, the pictures with links to them, and the configuration."""
    shown = [(f"picture-{i}", picture) for i, picture in enumerate(pictures, 1)]
    shown_config = html.escape(json.dumps(config, indent=2, ensure_ascii=False))
    links = "".join(f'<a href="#{name}">{html.escape(picture.title)}</a>' for name, picture in shown)
    return web_page.document(
        title,
        [
            *parts,
            f"<nav>{links}</nav>",
            *(_figure(name, picture) for name, picture in shown),
            f"<h2>Configuration</h2><details><summary>{name_of_config}</summary><pre>{shown_config}</pre></details>",
        ],
    )


def _answer(collection: Collection) -> str:
    """The stated result of a single run; empty if its folder has none."""
    found = RunSummary.read(collection.folder)
    return f"<h2>Answer</h2>{found.to_html()}" if found else ""


def _widths(collection: Collection) -> str:
    """How far the widths can be trusted, as measured in a run's folder, or that they were not measured."""
    lines: dict[str, list[str]] = {}
    for name, histories in collection.runs.items():
        for history in histories:
            measured = history.measured_widths
            if history.polished and not measured:
                continue  # the answer covers this; the configured text is about correcting for the rounds' proposals
            said = str(history.config.get("widths") or "")
            text = measured or (said if said.startswith(UNMEASURED) or not said else UNMEASURED)
            own = f"{name}, seed {history.seed}" if measured and len(histories) > 1 else name
            if text and own not in lines.setdefault(str(text), []):
                lines[str(text)].append(own)
    of = {text: html.escape(" of " + ", ".join(names)) if len(lines) > 1 else "" for text, names in lines.items()}
    return "".join(f"<p><strong>Widths{of[text]}</strong>: {prose(text)}.</p>" for text in lines)


def _facts(collection: Collection) -> str:
    """Parameters and provenance of the runs, from config.json of the folder or of the first run."""
    first = first_of(collection.runs)
    configs = (collection.config, first.config)

    def get(*names: str) -> Any:
        return next((config[name] for config in configs for name in names if config.get(name)), None)

    facts = {
        "Parameters": ", ".join(_labels(first.config.get("parameters") or first.names, first.units)),
        "Rounds": first.rounds,
        "Seeds": max(len(histories) for histories in collection.runs.values()),
        **_provenance(get),
    }
    return _definitions(facts)


def _provenance(get: Callable[..., Any]) -> dict[str, Any]:
    """Settings and environment of a run, each looked up by its names in config.json."""
    return {
        "Preset": get("preset"),
        "Command": get("command_line") or get("command"),
        "Versions": get("versions"),
        "Platform": get("platform"),
        "Started": get("started"),
    }


def _definitions(facts: Mapping[str, Any]) -> str:
    """A list of names and values, without empty values."""
    lines = []
    for name, value in facts.items():
        if value in (None, "", {}):
            continue
        text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, Mapping) else _short(value)
        text = html.escape(text)
        lines.append(f"<dt>{name}</dt><dd>{f'<code>{text}</code>' if name == 'Command' else text}</dd>")
    return f"<dl>{''.join(lines)}</dl>"


def _notes(collection: Collection) -> str:
    """Warnings of the run, missing results, and runs that are left out of the pictures."""
    notes = [str(text) for text in collection.config.get("warnings") or []]
    if collection.unfinished:
        names = ", ".join(str(Path(p).relative_to(collection.folder)) for p in collection.unfinished)
        notes.append(f"Not finished, and left out of the pictures: {names}.")
    if all(history.trajectory_error is None for history in all_of(collection.runs)):
        notes.append(
            "There are no simulated trajectories of posterior samples: none were simulated, or all simulations failed. "
            "Trajectory errors and the posterior predictive are left out."
        )
    return "".join(f'<p class="note">{prose(note)}</p>' for note in notes)


_MEANING = {
    "theta_error": "Parameter error: |θ − θ<sub>gt</sub>| summed over parameters, mean over posterior samples.",
    "trajectory_error": "Trajectory error: distance per record from the observed trajectory in its standard deviations,"
    " mean over the posterior samples whose simulation succeeded.",
    "success_rate": "Success rate: percentage of all simulations that succeeded.",
    "seconds": "Time: without compiling.",
}


def _table(collection: Collection) -> str:
    """Every known measure, one row per configuration; for several seeds, mean, median and standard deviation."""
    look = looks(list(collection.values("seed")))
    columns = {measure: collection.values(measure) for measure in _COLUMNS}
    columns = {
        measure: values for measure, values in columns.items() if any(np.isfinite(own).any() for own in values.values())
    }
    several = seed_count(collection.runs) > 1
    span = ' colspan="3"' * several
    head = "".join(f'<th class="first"{span}>{_COLUMNS[measure]}</th>' for measure in columns)
    head = f"<tr><th>{'' if several else 'configuration'}</th>{'<th></th>' * several}{head}</tr>"
    if several:
        below = '<th class="first">mean</th><th>median</th><th>sd</th>' * len(columns)
        head += f"<tr><th>configuration</th><th>seeds</th>{below}</tr>"
    lines = []
    for name, own in look.items():
        cells = []
        for measure, values in columns.items():
            scaled = values[name] * (100 if measure == "success_rate" else 1)
            shown = [float(statistics.mean(scaled))]
            if several:
                deviation = float(statistics.sd(scaled)) if len(scaled) > 1 else float("nan")
                shown += [float(statistics.median(scaled)), deviation]
            first, *others = map(_number, shown)
            cells.append(f'<td class="first">{first}</td>{"".join(f"<td>{one}</td>" for one in others)}')
        seeds = f"<td>{len(collection.values('seed')[name])}</td>" * several
        label = html.escape(_without_escapes(own.label))
        swatch = f'<i class="swatch" style="background:{own.colour}"></i>{label}'
        lines.append(f"<tr><td>{swatch}</td>{seeds}{''.join(cells)}</tr>")
    words = [_MEANING[measure] for measure in columns]
    words += ["Mean, median and standard deviation (sd) are over seeds."] * several
    return wide(
        f"<table><thead>{head}</thead><tbody>{''.join(lines)}</tbody><caption>{' '.join(words)}</caption></table>"
    )


def _labels(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Names of parameters with their units in brackets."""
    brackets = [_without_escapes(unit_label(units, d)) for d in range(len(names))]
    return [f"{natural(name)} {bracket}".strip() for name, bracket in zip(names, brackets, strict=True)]


def _without_escapes(label: str) -> str:
    """A label written for matplotlib, without its backslashes before dollar signs."""
    return label.replace(r"\$", "$")


def _figure(name: str, picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode("ascii")
    # A third larger than in print (96 pixels an inch), for reading on a screen.
    pixels = round(picture.width * 128)
    source = f"data:image/png;base64,{data}"
    alternative = f"{picture.title}. {picture.caption.partition('. ')[0]}"
    return f'<h2 id="{name}">{html.escape(picture.title)}</h2>' + web_page.figure(
        source, alternative, picture.caption, pixels
    )


def _number(x: float) -> str:
    if not np.isfinite(x):
        return "–"
    return f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}"


def _short(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
