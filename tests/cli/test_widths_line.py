"""The line on widths that a run ends with: one for all its configurations, or one for each kind of correction."""

import types

import numpy as np

from jaxlfi.cli.summaries import widths_lines
from jaxlfi.heuristics import Edge, Fixed, Truncate
from tests.small import SETTINGS


def lines_of(rules, correction="none", polished=(), **history):
    """The lines of two seeds of each configuration."""
    specs = [types.SimpleNamespace(configuration=name, heuristic=rule) for name, rule in rules.items()] * 2
    runs = [
        types.SimpleNamespace(
            history={k: np.array(v[i]) for k, v in history.items()},
            unpolished=object() if spec.configuration in polished else None,
        )
        for i, spec in enumerate(specs)
    ]
    return widths_lines(types.SimpleNamespace(settings=SETTINGS.replace(correction=correction), specs=specs), runs)


def test_configurations_corrected_in_the_same_way_share_a_line():
    (line,) = lines_of({"ok": Fixed(), "edge": Edge()})
    assert line.startswith("widths: not measured; nothing corrects for the proposals") and "\n" not in line


def test_configurations_corrected_in_other_ways_are_named():
    lines = lines_of({"ok": Fixed(), "truncate": Truncate(), "edge": Edge()})
    assert [line.partition(":")[0] for line in lines] == ["widths of ok, edge", "widths of truncate"]
    assert "every round drew from the prior" in lines[1]


def test_of_polished_posteriors_nothing_is_said():
    assert lines_of({"ok": Fixed()}, polished=["ok"]) == []
    (line,) = lines_of({"ok": Fixed(), "edge": Edge()}, polished=["ok"])
    assert line == lines_of({"edge": Edge()})[0]


def test_the_share_of_draws_that_weights_leave_is_that_of_the_last_rounds():
    (line,) = lines_of({"ok": Fixed()}, correction="pooled", effective_share=[[0.2, 0.84], [0.3, 0.91]])
    assert line.endswith("; effective sample size 84% to 91% of the draws")
    (line,) = lines_of({"ok": Fixed()}, correction="pooled", effective_share=[[0.3, 0.91], [0.2, 0.002]])
    assert line.endswith("; effective sample size under 1% to 91% of the draws")
    (line,) = lines_of({"ok": Fixed()}, correction="pooled", effective_share=[[0.912], [0.91]])
    assert line.endswith("; effective sample size 91% of the draws")
    (line,) = lines_of({"ok": Fixed()}, effective_share=[[1.0], [1.0]])
    assert "draws" not in line
