"""The note on widths that were not measured: one line for each case, and never a figure."""

import re

import pytest

from jaxlfi.bayessim.presets import METHODS, PAPER, QUICK, apt, npe, snle, tsnpe
from jaxlfi.bayessim.widths import widths_note
from jaxlfi.heuristics import Edge, Fixed, Truncate
from tests.small import settings

PLAIN = settings(correction="none", inflation=1.0, defensive=0.0)
ATOMIC = PLAIN.replace(estimator=PLAIN.estimator.replace(loss="atomic"))
SINGLE = "a single round needs no correction"


@pytest.mark.parametrize(
    ("settings", "heuristic", "expected"),
    [
        (PLAIN, Edge(), "nothing corrects for the proposals"),
        (PLAIN.replace(inflation=2.0), Edge(), "nothing corrects for the proposals"),
        (PLAIN.replace(inflation=2.0, correction="quotient"), Edge(), "the correction 'quotient' divides by the prop"),
        (PLAIN.replace(correction="paper"), Edge(), "the correction 'paper' multiplies posteriors, which counts the"),
        (PLAIN.replace(correction="importance"), Edge(), "importance weights correct for the proposals"),
        (PLAIN.replace(rounds=1), Edge(), SINGLE),
        (PLAIN.replace(rounds=1, inflation=2.0), Edge(), SINGLE),
        (PLAIN.replace(defensive=1.0), Edge(), "every round drew from the prior over its support"),
        (PLAIN.replace(defensive=0.5), Edge(), "nothing corrects for the proposals"),
        (PLAIN, Truncate(), "every round drew from the prior over its support"),
        (ATOMIC, Edge(), "the atomic loss corrects for the proposals"),
        (ATOMIC.replace(correction="importance"), Edge(), "the atomic loss corrects for the proposals, and the corr"),
        (PAPER, Edge(), "nothing corrects for the proposals"),
        (apt(QUICK), Edge(), "the combined loss corrects for the proposals"),
        (tsnpe(QUICK), Edge(), "every round drew from the prior, where the posterior's density was highest"),
        (snle(QUICK), Edge(), "a likelihood needs no correction for the proposals"),
        (npe(QUICK), Fixed(), SINGLE),
    ],
)  # fmt: skip
def test_each_case_is_one_line_that_says_that_nothing_was_measured(settings, heuristic, expected):
    line = widths_note(settings, heuristic)
    assert line.startswith(f"not measured; {expected}") and "\n" not in line
    assert line.endswith("(run `jaxlfi diagnose` to measure them)")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("inflation", [1.0, 2.0, 3.0])
def test_no_figure_is_given_that_was_not_measured(method, inflation):
    """Figures implied by the settings alone were wrong by factors on real simulators."""
    for preset in (QUICK, PAPER):
        for heuristic in (Fixed(), Edge(), Truncate()):
            line = widths_note(METHODS[method](preset).replace(inflation=inflation), heuristic)
            assert not re.search(r"\d|%|right|narrow", line)
