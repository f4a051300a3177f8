"""The noise of a recorded signal is found out from the signal."""

import numpy as np
import pytest

from jaxlfi.envs.mujoco.noise import standard_deviation


@pytest.mark.parametrize("deviation", [0.001, 0.05])
def test_white_noise_on_a_smooth_signal_that_jumps(deviation):
    rng, times = np.random.default_rng(3), np.arange(4000) * 0.01
    clean = np.sin(2 * times) + 3 * (times > 20)
    found = standard_deviation(clean + deviation * rng.standard_normal(4000))
    # The median of n absolute differences has a standard deviation of about 1.2 / sqrt(n); neighbours are correlated.
    assert found == pytest.approx(deviation, rel=4 * 2 * 1.2 / np.sqrt(4000))


def test_a_polynomial_of_third_degree_has_none():
    times = np.linspace(-1, 1, 50)
    assert standard_deviation(3 * times**3 - times**2 + 1) == pytest.approx(0.0, abs=1e-14)


def test_too_few_samples_are_refused():
    with pytest.raises(ValueError, match="expected at least 20 samples to estimate its noise from, got 19"):
        standard_deviation(np.r_[np.arange(19.0), np.nan])
