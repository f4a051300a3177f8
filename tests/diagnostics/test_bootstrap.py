"""The bootstrap interval of a mean."""

import numpy as np
import pytest

from jaxlfi.diagnostics.bootstrap import bootstrap_interval


def test_bootstrap_interval_covers_the_mean():
    values = np.random.default_rng(1).normal(3.0, 1.0, 50)
    low, high = bootstrap_interval(values)
    assert low < values.mean() < high and high - low == pytest.approx(2 * 1.96 / np.sqrt(50), rel=0.3)
