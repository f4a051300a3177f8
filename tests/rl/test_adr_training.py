"""PPO under ADR: ranges follow how the policy fares at their bounds, and episodes are drawn from them."""

import functools

import jax
import numpy as np
import pytest

pytest.importorskip("brax")

from rl.toy import SETTINGS, Line

from jaxlfi.rl.randomisation import adr_training
from jaxlfi.rl.randomisation.adr import Adr

pytestmark = pytest.mark.usefixtures("keys_of_brax")

LINE = Line()
DRAWN = SETTINGS.replace(redrawn=True)
ROUNDS = 3


@pytest.fixture(scope="module")
def train():
    start = np.array([1.0, 0.5])
    return jax.jit(
        lambda randomising: adr_training.train(
            jax.random.key(0), LINE, DRAWN, randomising, start, rounds=ROUNDS, updates=1, probes=64
        )
    )


@pytest.mark.slow
def test_ranges_grow_in_every_round_where_any_return_will_do(train):
    training, ranges, made = train(Adr(low_threshold=-2e6, high_threshold=-1e6, buffer=1, step=0.01))
    box = LINE.space.box_to_inference(LINE.feasible)
    low, high = np.asarray(made.support.low), np.asarray(made.support.high)
    assert low.shape == (ROUNDS, 2) and (np.diff(low, axis=0) < 0).all() and (np.diff(high, axis=0) > 0).all()
    assert (low >= box.low - 1e-6).all() and (high <= box.high + 1e-6).all()
    np.testing.assert_array_equal(ranges.support.low, low[-1])
    assert int(training.updates) == ROUNDS and np.isfinite(made.value).all()
    first = np.asarray(training.episodes.domain.theta)  # of the last round: the ranges after the one before
    drawn = np.asarray(LINE.space.to_inference(first))
    assert (
        first.shape == (adr_training.POOL, 2) and (drawn >= low[-2] - 1e-5).all() and (drawn <= high[-2] + 1e-5).all()
    )
    assert (np.ptp(drawn, axis=0) > 0.8 * (high[-2] - low[-2])).all()


@pytest.mark.slow
def test_ranges_stay_a_point_where_no_return_will_do(train):
    _, ranges, _ = train(Adr(low_threshold=-1e6, high_threshold=1e6, buffer=1, step=0.01))
    np.testing.assert_allclose(ranges.support.low, [0.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(ranges.support.low, ranges.support.high)


def test_settings_that_keep_theta_are_refused():
    call = functools.partial(adr_training.train, rounds=1, updates=1, probes=1)
    with pytest.raises(ValueError, match="redrawn: expected True"):
        call(jax.random.key(0), LINE, SETTINGS, Adr(), np.array([1.0, 0.5]))
