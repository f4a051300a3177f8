"""The line on widths that a run ends with: one for all its configurations, or one for each kind of correction."""

import types

from jaxlfi.cli.summaries import widths_lines
from jaxlfi.heuristics import Edge, Fixed, Truncate
from tests.small import SETTINGS


def plan_of(**rules):
    """What the lines are made from: the heuristic of each configuration, with two seeds."""
    specs = [types.SimpleNamespace(configuration=name, heuristic=rule) for name, rule in rules.items()]
    return types.SimpleNamespace(settings=SETTINGS.replace(correction="none", inflation=1.0), specs=specs * 2)


def test_configurations_corrected_in_the_same_way_share_a_line():
    (line,) = widths_lines(plan_of(ok=Fixed(), edge=Edge()))
    assert line.startswith("widths: not measured; nothing corrects for the proposals") and "\n" not in line


def test_configurations_corrected_in_other_ways_are_named():
    lines = widths_lines(plan_of(ok=Fixed(), truncate=Truncate(), edge=Edge()))
    assert [line.partition(":")[0] for line in lines] == ["widths of ok, edge", "widths of truncate"]
    assert "every round drew from the prior" in lines[1]
