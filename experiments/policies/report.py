"""The report of a study: tables as CSV and Markdown, figures, and the text on the study's page."""

import csv
import io
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.policies import contrasts, findings, intervals, results, tables
from experiments.policies.results import Results
from experiments.policies.study import NOMINAL, ORDER
from experiments.policies.tables import Row
from jaxlfi.io import files

TABLES = {
    "posteriors": tables.posteriors,
    "trainings": tables.trainings,
    "question": tables.question,
    "contrasts": contrasts.table,
    "objects": tables.objects,
    "nominal": tables.nominal,
    "motion": tables.motion,
    "simulation": tables.simulation,
    "difficulty": tables.difficulty,
    "findings": findings.table,
}
WIDTH = 120
BEGIN, END = "<!-- policies: made by `python -m experiments.policies report` -->", "<!-- policies: end -->"


def write(out: Path, readme: Path | None = None) -> None:
    """Write tables and figures, and the text between `BEGIN` and `END` of a file.

    Raises:
        ValueError: for a file without these two lines.
    """
    from experiments.policies import figures  # which takes a while to import

    found = results.load(out)
    for name, make in TABLES.items():
        if rows := make(found):
            _write_csv(out / "tables" / f"{name}.csv", rows)
            files.write_bytes(out / "tables" / f"{name}.md", f"{tables.markdown(rows)}\n".encode())
    if readme is not None:
        whole = readme.read_text()
        if whole.count(BEGIN) != 1 or whole.count(END) != 1:
            raise ValueError(f"readme: expected the lines {BEGIN!r} and {END!r} in {readme}, each once")
        before, rest = whole.split(BEGIN)
        after = rest.split(END)[1]
        files.write_bytes(readme, f"{before}{BEGIN}\n\n{text(found)}\n\n{END}{after}".encode())
    figures.save(out, found, results.grouped(out / "stills.npz"))


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, stream.getvalue().encode())


# ------------------------------------------------------------------------------------------------------------- the text


def text(found: Results) -> str:
    """The text on the study's page, with the numbers of the results so far."""
    measures = MEASURES.format(*tables.extremes(found, found.displaced))
    parts = [
        _counts(found),
        "**Is a policy trained on an adapted posterior better on the object it came from?**",
        answer(found),
        *_table(QUESTION, tables.question(found)),
        *_table(CONTRASTS, contrasts.table(found)),
        *_table(OBJECTS, tables.objects(found)),
        *_table(measures, tables.difficulty(found)),
        *_table(FINDINGS, findings.table(found)),
        *_table(POSTERIORS, tables.posteriors(found)),
    ]
    return "\n\n".join(_wrapped(part) for part in parts if part)


QUESTION = (
    "Returns on each object of the policies trained on EDGE's posterior of that object, and how far they are ahead of "
    "other policies there: on the FEM object at displaced places, or in simulations at points of the posterior or at "
    "the truth."
)
CONTRASTS = (
    "**With objects resampled.** The same differences if objects are resampled as well as seeds and places (the "
    "hierarchical bootstrap of `jaxlfi.diagnostics.contrasts`): intervals, two-sided p-values, p-values with Holm's "
    "correction within the rows of one kind of objects, Hedges' g in standard deviations over training seeds, and A, "
    "the share of pairs in which a policy of EDGE's posterior is ahead of one of the other arm. There are only four "
    "and three objects, so these intervals are too short."
)
OBJECTS = (
    "**All policies on the FEM objects**, at displaced places: return with its interval, rate of clean hits, return at "
    "the worst place averaged over seeds, and rate of exits from the workspace."
)
MEASURES = (
    "**The paper's measures** for the six agents of a set on each DLO. Consistency is the median of the agents' "
    "returns. Difficulty is 1 - (consistency - lowest) / (highest - lowest), where lowest and highest are the extreme "
    "returns of all episodes, {:.2f} and {:.2f} at displaced places. One bad episode of one policy therefore moves the "
    "difficulty of all DLOs towards 0. If all agents do equally well or equally badly, the extremes coincide and "
    "difficulty is not defined."
)
FINDINGS = (
    "**Findings of section VII-C.** Differences at displaced places, positive if they agree with the paper, and "
    "whether their intervals confirm it."
)
POSTERIORS = (
    "**Posteriors of the objects' parameters.** Medians and 90 % intervals of the posteriors given the one recorded "
    "rollout; the Gauss-Newton estimates of `mujoco.sysid` from the same rollout, with 90 % intervals. The truth of an "
    "FEM object is the light DLO with the same sag."
)


def _wrapped(part: str) -> str:
    """A paragraph or a list in lines of the usual width; tables stay as they are."""
    if part.startswith("|"):
        return part
    fill = lambda line: textwrap.fill(
        line, WIDTH, subsequent_indent="  " * line.startswith("- "), break_on_hyphens=False, break_long_words=False
    )
    return "\n".join(fill(line) for line in part.splitlines())


def _table(heading: str, rows: Sequence[Row]) -> list[str]:
    """A table below its heading; nothing if it is empty."""
    return [heading, tables.markdown(rows)] if rows else []


def _counts(found: Results) -> str:
    """The number of trainings, policies and places."""
    seeds = max((len(own["return"]) for own in found.trainings.values()), default=0)
    places = max((rows["value"].shape[1] for rows in found.objects.values()), default=NOMINAL)
    kinds, displaced = len(found.policies), places - NOMINAL
    return (
        f"Policies were trained on {len(found.trainings)} of {len(ORDER)} domains, with {seeds} seeds each. {kinds} "
        f"kinds of policies and baselines were tested on the FEM objects, at {displaced} displaced places and "
        f"{NOMINAL} times at the nominal one. Intervals are 95 % bootstrap intervals over training seeds and places "
        "jointly; with so few seeds they are too short rather than too long."
    )


RIVALS = {
    "uniform": "PPO-U",
    "fixed": "PPO on the fixed support's posterior",
    "mean": "PPO at the posterior mean",
    "sysid": "PPO at the point of least squares",
    "true": "PPO at the true parameters",
}
PLACES = {
    "FEM object": "FEM objects",
    "posterior": "simulations of their posteriors",
    "truth": "simulated objects with known parameters",
}


def answer(found: Results) -> str:
    """The answer to the main question in words, one line for each rival."""
    lines = []
    for kind, name in RIVALS.items():
        clauses = [_clause(found, word, kind) for word in PLACES]
        if any(clauses):
            lines.append(f"- Against {name}: {'; '.join(clause for clause in clauses if clause)}.")
    return "\n".join(lines)


def _clause(found: Results, word: str, kind: str) -> str:
    """How policies on EDGE's posteriors compare with a rival, over all places of one kind and at each of them."""
    plus, minus, differences = [], [], {}
    for place in tables.places(found):
        own = tables.found(place.values, f"{place.dlo}-edge")
        other = tables.found(place.values, tables.rival(place.dlo, kind))
        if word in place.what and own is not None and other is not None:
            plus.append(own)
            minus.append(other)
            differences[place.dlo] = intervals.difference(own, other)
    if not differences:
        return ""
    # PPO-U is the same policies everywhere.
    whole = intervals.contrast(plus, [np.mean(minus, axis=0)] if kind == "uniform" else minus)
    signs = {"better": lambda low, _: low > 0, "worse": lambda _, high: high < 0}
    which = {sign: [dlo for dlo, (_, *ends) in differences.items() if holds(*ends)] for sign, holds in signs.items()}
    verdicts = " and ".join(f"{sign} on {', '.join(names)}" for sign, names in which.items() if names)
    return f"on {PLACES[word]} ({', '.join(differences)}) {intervals.text(whole)}, {verdicts or 'no clear difference'}"
