"""The line on rounds: how many each configuration's runs made, and which posteriors still changed."""

from types import SimpleNamespace

import numpy as np

from jaxlfi.bayessim.presets import PAPER, QUICK
from jaxlfi.cli.summaries import rounds_lines


def plan(settings, *configurations: str):
    """What the function reads of a plan."""
    return SimpleNamespace(settings=settings, specs=[SimpleNamespace(configuration=name) for name in configurations])


def run(made: int, of: int, moved: float, settled: bool, rescaled: float = 1.1, turned: float = 0.1):
    """A run that made so many rounds of a batch's."""
    changes = {"moved": moved, "rescaled": rescaled, "turned": turned}
    history = {"settled": np.arange(of) >= (made - 1 if settled else of)}
    return SimpleNamespace(history=history | {name: np.full(of, value) for name, value in changes.items()})


def test_each_configuration_says_how_many_rounds_its_runs_made():
    runs = [run(12, 20, 0.3, True), run(20, 20, 0.1, True), run(14, 20, 0.2, True)]
    lines = rounds_lines(plan(QUICK, "edge", "edge", "ok"), runs)
    assert lines == [
        "rounds of edge: 12 to 20; the posterior has settled",
        "rounds of ok: 14; the posterior has settled",
    ]


def test_posteriors_that_still_changed_are_counted():
    runs = [run(12, 20, 0.3, True), run(20, 20, 1.26, False), run(20, 20, 0.9, False)]
    (line,) = rounds_lines(plan(QUICK, "edge", "edge", "edge"), runs)
    changes = "2 of 3 posteriors still changed over the last 3 rounds: means by up to 1.3 standard deviations"
    assert line == f"rounds of edge: 12 to 20; {changes} (--rounds allows for more)"


def test_widths_and_correlations_that_still_changed_are_told_apart():
    runs = [run(20, 20, 0.1, False, rescaled=5.97), run(20, 20, 0.2, False, turned=0.83)]
    (line,) = rounds_lines(plan(QUICK, "edge", "edge"), runs)
    changes = "standard deviations by factors of up to 6.0, correlations by up to 0.8"
    assert line == f"rounds of edge: 20; 2 of 2 posteriors still changed over the last 3 rounds: {changes} " + (
        "(--rounds allows for more)"
    )


def test_too_few_rounds_to_compare_are_said_to_be_so():
    (line,) = rounds_lines(
        plan(QUICK.replace(rounds=3, min_rounds=2), "edge"), [run(3, 3, np.inf, False, np.inf, np.inf)]
    )
    assert line == "rounds of edge: 3; 1 of 1 posteriors made too few rounds to have settled: they are compared over 3"


def test_nothing_is_said_where_all_rounds_are_made_anyhow():
    assert rounds_lines(plan(PAPER, "edge"), [run(10, 10, 1.0, False)]) == []
    assert rounds_lines(plan(QUICK.replace(rounds=5), "edge"), [run(5, 5, 1.0, False)]) == []
