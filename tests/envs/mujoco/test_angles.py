"""Angles of encoders that wrap, compared with the angles they were made from."""

import numpy as np
import pytest

from jaxlfi.envs.mujoco.angles import TURN, jumps, unwrapped

TIMES = 0.01 * np.arange(400)
ANGLE = 3 * np.sin(2 * TIMES) + 2 * TIMES
SWING = 1.5 * np.sin(3 * TIMES)


def encoder(angles, begin, period=TURN):
    """Readings that start at `begin` and wrap after one period."""
    return (angles - begin) % period + begin


@pytest.mark.parametrize("begin", [-np.pi, 0.0, -1.0, 2.0])
@pytest.mark.parametrize("period", [TURN / 2, TURN, 2 * TURN])
def test_an_encoder_is_made_continuous_and_begins_where_the_model_does(begin, period):
    found = unwrapped(TIMES, encoder(2 * ANGLE, begin, period), start=0.0)
    np.testing.assert_allclose(found.values, 2 * ANGLE, atol=1e-9)
    assert found.count and found.period == pytest.approx(period) and not found.ambiguous


def test_noise_about_the_place_where_it_begins_anew():
    noise = np.random.default_rng(0).normal(size=(2, 400))
    for angles, begin in ((ANGLE, -np.pi), (0.0 * ANGLE, 0.0)):
        noisy = angles + 0.03 * noise[0]
        np.testing.assert_allclose(unwrapped(TIMES, encoder(noisy, begin), 0.0).values, noisy, atol=1e-9)
        electric = encoder(angles, begin) + 0.03 * noise[1]  # beyond the encoder's readings
        np.testing.assert_allclose(unwrapped(TIMES, electric, 0.0).values, angles + 0.03 * noise[1], atol=1e-9)


def test_times_need_not_be_equally_far_apart():
    times = np.sort(np.random.default_rng(1).uniform(0, 4, 400))
    angles = 3 * np.sin(2 * times) + 2 * times
    np.testing.assert_allclose(unwrapped(times, encoder(angles, -np.pi), angles[0]).values, angles, atol=1e-9)


def test_a_joint_within_its_limits_is_left_alone_and_one_beyond_them_is_brought_back():
    limits = (-1.6, 1.6)
    assert not unwrapped(TIMES, SWING, 0.0, limits).count
    assert not unwrapped(TIMES[::80], SWING[::80], 0.0, limits).count
    for begin in (0.0, 0.3):
        found = unwrapped(TIMES, encoder(SWING, begin), 0.0, limits)
        np.testing.assert_allclose(found.values, SWING, atol=1e-9)
    other = encoder(3 * SWING, -np.pi)
    np.testing.assert_array_equal(unwrapped(TIMES, other, 0.0, limits).values, other)  # neither fits the limits


@pytest.mark.parametrize(
    "angles",
    [
        ANGLE,  # several turns, counted
        3.1 * np.sin(1.3 * np.arange(400)),  # few samples of a large swing
        2 * np.sign(np.sin(2 * TIMES) + 1e-9),
        np.pi / 2 * np.sign(np.sin(2 * TIMES) + 1e-9),  # from pose to pose
        np.where(np.arange(400) == 100, 0.0, 4.0),  # a reading that was lost
        np.where(np.arange(400) == 100, 20.0, np.sin(TIMES)),
        np.zeros(400),
    ],
)
def test_other_jumps_are_no_encoders(angles):
    found = unwrapped(TIMES, angles, 0.0)
    assert not found.count
    np.testing.assert_array_equal(found.values, angles)


def test_an_encoder_of_which_some_readings_are_lost():
    readings = encoder(4 * ANGLE, -np.pi)
    readings[250] = 0.0
    found = unwrapped(TIMES, readings, 0.0)
    kept = np.arange(400) != 250
    np.testing.assert_allclose(found.values[kept], 4 * ANGLE[kept], atol=1e-9)


def test_jumps_that_are_left_as_they_are_can_be_told():
    """The period of an encoder behind a gear is not known."""
    assert jumps(encoder(ANGLE, 0.0, TURN / 7)) == np.sum(np.abs(np.diff(encoder(ANGLE, 0.0, TURN / 7))) > 0.5)
    for angles in (ANGLE, SWING, 3.1 * np.sin(1.3 * np.arange(400)), np.zeros(400), np.arange(400) < 100):
        assert jumps(np.asarray(angles, float)) == 0


def test_of_fast_turns_it_is_said_that_they_are_hardly_told():
    assert not unwrapped(TIMES, encoder(2.0 * np.arange(400), 0.0), 0.0).ambiguous
    assert unwrapped(TIMES, encoder(2.8 * np.arange(400), 0.0), 0.0).ambiguous
