"""What the settings let expect of widths: one case each, and the Gaussian fixed point that the number comes from."""

import numpy as np
import pytest

from jaxlfi.bayessim.presets import PAPER, QUICK, apt, npe, snle
from jaxlfi.bayessim.widths import expected_widths
from jaxlfi.heuristics import Edge, Fixed, Truncate
from tests.small import settings

PLAIN = settings(correction="none", inflation=1.0, defensive=0.0)
ATOMIC = PLAIN.replace(estimator=PLAIN.estimator.replace(loss="atomic"))


@pytest.mark.parametrize(
    ("settings", "heuristic", "expected"),
    [
        (PLAIN, Edge(), "too narrow as a rule, as every round counts the observation again"),
        (PLAIN.replace(inflation=2.0), Edge(), "about 87 % of the right ones, as proposals are 2 times as wide"),
        (PLAIN.replace(inflation=3.0), Fixed(), "about 94 % of the right ones, as proposals are 3 times as wide"),
        (PLAIN.replace(inflation=2.0, correction="quotient"), Edge(), "right in principle, as proposals 2 times as"),
        (PLAIN.replace(correction="quotient"), Edge(), "uncertain, as the correction 'quotient' divides by proposals"),
        (PLAIN.replace(correction="paper"), Edge(), "too narrow as a rule, as the correction 'paper' multiplies"),
        (PLAIN.replace(correction="importance"), Edge(), "right in principle, by importance weights"),
        (PLAIN.replace(rounds=1), Edge(), "right in principle, as all simulations are drawn from the prior"),
        (PLAIN.replace(rounds=1, inflation=2.0), Edge(), "right in principle, as all simulations are drawn from the"),
        (PLAIN.replace(defensive=1.0), Edge(), "right in principle, as every round draws from the prior"),
        (PLAIN.replace(defensive=0.5), Edge(), "too narrow as a rule"),
        (PLAIN, Truncate(), "right in principle, as every round draws from the prior"),
        (ATOMIC, Edge(), "right in principle, as the atomic loss allows for the proposals"),
        (ATOMIC.replace(correction="importance"), Edge(), "uncertain, as the atomic loss allows for the proposals and"),
        (PAPER, Edge(), "too narrow as a rule"),
        (apt(QUICK), Edge(), "right in principle, as the combined loss allows for the proposals"),
        (snle(QUICK), Edge(), "right in principle, as a likelihood does not depend on the proposals"),
        (npe(QUICK), Fixed(), "right in principle, as all simulations are drawn from the prior"),
    ],
)  # fmt: skip
def test_each_case_is_one_line_that_says_how_it_is_known(settings, heuristic, expected):
    line = expected_widths(settings, heuristic)
    assert line.startswith(expected) and "\n" not in line
    assert line.endswith("(expected from the settings; `jaxlfi diagnose` measures it)")


@pytest.mark.parametrize("inflation", [1.2, 2.0, 3.0])
def test_the_number_is_the_fixed_point_of_gaussian_rounds(inflation):
    """1 / q = 1 / L + 1 / (s^2 q), iterated; L, the right variance, is 1."""
    variance = 10.0
    for _ in range(200):
        variance = 1 / (1 + 1 / (inflation**2 * variance))
    line = expected_widths(PLAIN.replace(inflation=inflation), Edge())
    assert f"about {100 * np.sqrt(variance):.0f} %" in line
