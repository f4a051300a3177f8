"""Shared by tests of rollouts in files."""

import numpy as np

from jaxlfi.io.rollout import Rollout


def same(back: Rollout, one: Rollout) -> None:
    """Assert that all signals and metadata are equal, to the last bit."""
    assert (back.metadata, back.task, set(back.signals)) == (one.metadata, one.task, set(one.signals))
    for name, signal in one.signals.items():
        other = back.signals[name]
        assert (other.names, other.unit, other.duration) == (signal.names, signal.unit, signal.duration)
        assert other.values.dtype == signal.values.dtype
        np.testing.assert_array_equal(other.times, signal.times)
        np.testing.assert_array_equal(other.values, signal.values)
