"""Moments by importance sampling: against closed forms, and for densities of which too few draws count."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco.importance import DRAWS, ENOUGH, TIMES, moments


def repeated(log_density, k, times=40):
    """What several runs find, so that means over them are known well."""
    return [moments(np.random.default_rng(seed), log_density, k) for seed in range(times)]


def test_a_bent_density_has_the_moments_of_its_closed_form():
    """y1 ~ N(.4, .8^2), y2 | y1 ~ N(.5 (y1 - .4)^2, .6^2), with E y2 = .5 * .64 and var y2 = .5 * .64^2 + .36."""

    def log_density(y):
        off = y[:, 0] - 0.4
        return -0.5 * (off / 0.8) ** 2 - 0.5 * ((y[:, 1] - 0.5 * off**2) / 0.6) ** 2

    found = repeated(log_density, 2)
    assert all(one.counted > ENOUGH for one in found)
    mean, covariance = (np.mean([getattr(one, name) for one in found], axis=0) for name in ("mean", "covariance"))
    np.testing.assert_allclose(mean, [0.4, 0.32], atol=0.04)  # four standard errors
    np.testing.assert_allclose(np.diagonal(covariance), [0.64, 0.5 * 0.64**2 + 0.36], rtol=0.08)
    mass = np.mean(np.exp([one.log_mass for one in found]))
    assert mass == pytest.approx(2 * np.pi * 0.8 * 0.6, rel=0.05)


def test_a_density_that_lies_elsewhere_is_found():
    (one,) = repeated(lambda y: -0.5 * np.sum(((y - [2.5, -1.0, 0.0]) / [0.4, 2.0, 1.0]) ** 2, axis=1), 3, times=1)
    assert one.counted > ENOUGH and one.draws > DRAWS
    np.testing.assert_allclose(one.mean, [2.5, -1.0, 0.0], atol=0.5)
    np.testing.assert_allclose(np.sqrt(np.diagonal(one.covariance)), [0.4, 2.0, 1.0], rtol=0.3)


def test_a_jagged_density_counts_for_little():
    jagged = lambda y: -0.5 * np.sum(y**2, axis=1) + 12 * np.random.default_rng(1).standard_normal(len(y))
    assert all(one.counted < ENOUGH and one.draws == TIMES * DRAWS for one in repeated(jagged, 3, times=5))


def test_where_there_is_no_density_nothing_counts():
    assert moments(np.random.default_rng(0), lambda y: np.full(len(y), -np.inf), 2).counted == 0.0
