"""Densities learnt by weighted draws: against closed forms, and those of which too few draws count."""

import itertools

import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import weighted
from jaxlfi.envs.mujoco.weighted import BATCHES, DRAWS, ENOUGH, learnt


def found(log_density, correlation, seed=0):
    one = learnt(np.random.default_rng(seed), log_density, np.asarray(correlation, float))
    return one, np.asarray(one.mixture.mean, float), np.asarray(one.mixture.covariance, float)


def test_a_narrow_ridge_beside_what_is_known_has_the_moments_of_its_closed_form():
    """N((1.2, -0.8, 0.3), S) with deviations .3, .6, .2 and a correlation of .98 that is not known."""
    deviations, mean = np.array([0.3, 0.6, 0.2]), np.array([1.2, -0.8, 0.3])
    true = np.array([[1, 0.98, 0], [0.98, 1, 0.1], [0, 0.1, 1]]) * np.outer(deviations, deviations)
    inverse = np.linalg.inv(true)
    one, centre, covariance = found(lambda y: -0.5 * np.einsum("ni,ij,nj->n", y - mean, inverse, y - mean), np.eye(3))
    assert one.size >= ENOUGH and one.draws % DRAWS == 0
    np.testing.assert_allclose(centre, mean, atol=4 / np.sqrt(ENOUGH) * deviations.max())
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), deviations, rtol=0.15)
    assert covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) == pytest.approx(0.98, abs=0.01)


def test_a_jagged_bent_density_has_the_moments_of_its_closed_form():
    """y1 ~ N(.4, .8^2), y2 | y1 ~ N(.5 (y1 - .4)^2, .2^2), times a ripple whose mean is everywhere the same."""

    def log_density(y):
        off = y[:, 0] - 0.4
        ripple = np.log1p(0.9 * np.sin(300 * y[:, 0]) * np.sin(300 * y[:, 1]))
        return ripple - 0.5 * (off / 0.8) ** 2 - 0.5 * ((y[:, 1] - 0.5 * off**2) / 0.2) ** 2

    several = [found(log_density, np.eye(2), seed) for seed in range(6)]
    assert all(one.size >= ENOUGH for one, *_ in several)
    mean, covariance = (np.mean([each[place] for each in several], axis=0) for place in (1, 2))
    np.testing.assert_allclose(mean, [0.4, 0.32], atol=0.08)  # four standard errors
    np.testing.assert_allclose(np.diagonal(covariance), [0.64, 0.5 * 0.64**2 + 0.04], rtol=0.2)


def test_both_of_two_modes_are_found_with_their_weights():
    def log_density(y):
        parts = [-0.5 * np.sum(((y - centre) / 0.2) ** 2, axis=1) for centre in ([-1.0, 0.5], [1.0, -0.5])]
        return np.logaddexp(np.log(3) + parts[0], parts[1])

    one, mean, _ = found(log_density, np.eye(2))
    assert one.size >= ENOUGH
    np.testing.assert_allclose(mean, [-0.5, 0.25], atol=0.2)
    low, high = sorted(np.asarray(one.mixture.means, float).tolist())
    np.testing.assert_allclose([low, high], [[-1.0, 0.5], [1.0, -0.5]], atol=0.1)


def test_nothing_outside_of_where_the_density_is():
    """An exponential that ends at 0, which the draws before did not know."""
    one, mean, covariance = found(lambda y: np.where(y[:, 0] > 0, -y[:, 0], -np.inf), np.eye(1))
    assert one.size >= ENOUGH
    np.testing.assert_allclose([mean[0], covariance[0, 0]], [1.0, 1.0], atol=0.3)


def test_a_density_without_shape_is_given_up_after_half_of_the_batches():
    noise = np.random.default_rng(1)
    one, *_ = found(lambda y: 30 * noise.standard_normal(len(y)), np.eye(2))
    assert one.size < ENOUGH and one.draws == (BATCHES // 2 + 1) * DRAWS


def test_a_density_that_is_nowhere_is_given_up_at_once():
    one, *_ = found(lambda y: np.full(len(y), -np.inf), np.eye(2))
    assert one.size == 0 and one.draws == DRAWS


def test_all_batches_are_drawn_where_that_is_needed(monkeypatch):
    monkeypatch.setattr(weighted, "ENOUGH", 10**9)
    seen = []

    def counted(batches):
        for batch in batches:
            seen.append(batch)
            yield batch

    one = learnt(np.random.default_rng(0), lambda y: -0.5 * np.sum(y**2, axis=1), np.eye(1), counted)
    assert seen == list(range(BATCHES)) and one.draws == BATCHES * DRAWS


def test_draws_have_the_density_that_they_say():
    """By the integral of the density over a fine grid, and the share of draws in a half-plane."""
    factors = np.array([[[0.5, 0.0], [0.3, 0.4]], [[1.0, 0.0], [0.0, 0.2]]])
    proposal = weighted._Proposal(np.log([0.3, 0.7]), np.array([[1.0, 0.0], [-1.0, 0.5]]), factors)
    axis = np.linspace(-15, 15, 601)
    grid = np.array(list(itertools.product(axis, axis)))
    density = np.exp(proposal.log_prob(grid)) * (axis[1] - axis[0]) ** 2
    assert density.sum() == pytest.approx(1.0, abs=0.005)
    drawn = proposal.draws(np.random.default_rng(0), 20_000)
    for side in (lambda y: y[:, 0] + y[:, 1] > 0.4, lambda y: np.sum(y**2, axis=1) > 4):
        share = density[side(grid)].sum()
        assert abs(side(drawn).mean() - share) < 4 * np.sqrt(share * (1 - share) / 20_000) + 0.005
