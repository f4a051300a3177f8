"""The line on rounds: how many each configuration's runs made, and which posteriors still moved."""

from types import SimpleNamespace

import numpy as np

from jaxlfi.bayessim.presets import PAPER, QUICK
from jaxlfi.cli.summaries import rounds_lines


def plan(settings, *configurations: str):
    """What the function reads of a plan."""
    return SimpleNamespace(settings=settings, specs=[SimpleNamespace(configuration=name) for name in configurations])


def run(made: int, of: int, moved: float, settled: bool):
    """A run that made so many rounds of a batch's."""
    history = {"settled": np.arange(of) >= (made - 1 if settled else of), "moved": np.full(of, moved)}
    return SimpleNamespace(history=history)


def test_each_configuration_says_how_many_rounds_its_runs_made():
    runs = [run(12, 20, 0.3, True), run(20, 20, 0.1, True), run(14, 20, 0.2, True)]
    lines = rounds_lines(plan(QUICK, "edge", "edge", "ok"), runs)
    assert lines == [
        "rounds of edge: 12 to 20; the posterior has settled",
        "rounds of ok: 14; the posterior has settled",
    ]


def test_posteriors_that_still_moved_are_counted():
    runs = [run(12, 20, 0.3, True), run(20, 20, 1.26, False), run(20, 20, 0.9, False)]
    (line,) = rounds_lines(plan(QUICK, "edge", "edge", "edge"), runs)
    assert line.startswith("rounds of edge: 12 to 20; 2 of 3 posteriors still moved, by up to 1.3 of their")


def test_nothing_is_said_where_all_rounds_are_made_anyhow():
    assert rounds_lines(plan(PAPER, "edge"), [run(10, 10, 1.0, False)]) == []
    assert rounds_lines(plan(QUICK.replace(rounds=5), "edge"), [run(5, 5, 1.0, False)]) == []
