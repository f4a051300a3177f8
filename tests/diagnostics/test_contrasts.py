"""Contrasts against closed forms: variances of nested and crossed designs, coverage, Holm by hand, effect sizes."""

import numpy as np
import pytest

from jaxlfi.diagnostics.contrasts import Arm, contrast, holm, resampled, standardised, superiority

RESAMPLES = 40_000
GATE = 5 * (2 / RESAMPLES) ** 0.5
"""Five standard errors of a variance, relative to it."""
NOTHING = Arm(np.zeros((5, 1, 7)))


def test_the_variance_of_policies_nested_in_objects():
    """Var = (variance of objects' means + mean variance of policies within objects / S) / O, all by division by n."""
    means = np.random.default_rng(0).normal(size=(5, 3)) * [[1.0], [2.0], [0.5], [4.0], [0.1]] + np.arange(5)[:, None]
    values = np.repeat(means[:, :, None], 7, axis=2)
    between, within = np.var(means.mean(axis=1)), np.var(means, axis=1).mean()
    drawn = resampled(Arm(values), NOTHING, RESAMPLES, 0)
    np.testing.assert_allclose(drawn.var(), (between + within / 3) / 5, rtol=GATE)
    np.testing.assert_allclose(drawn.mean(), means.mean(), atol=5 * drawn.std() / RESAMPLES**0.5)


def test_the_variance_of_policies_shared_by_objects():
    """What varies with the seed alone does not average out over objects: Var = variance of seeds / S."""
    values = np.broadcast_to(np.array([0.3, -1.0, 2.0])[None, :, None], (5, 3, 7))
    expected = np.var([0.3, -1.0, 2.0]) / 3
    np.testing.assert_allclose(resampled(Arm(values, shared=True), NOTHING, RESAMPLES, 0).var(), expected, rtol=GATE)
    np.testing.assert_allclose(resampled(Arm(values), NOTHING, RESAMPLES, 0).var(), expected / 5, rtol=GATE)


def test_places_and_objects_that_both_arms_met_cancel():
    """Effects of an object and of a place are in both: what is left is the seeds' variance of either arm."""
    rng = np.random.default_rng(1)
    met = 3 * rng.normal(size=(5, 1, 1)) + 2 * rng.normal(size=(1, 1, 7))
    ours, theirs = rng.normal(size=(5, 3, 1)), rng.normal(size=(5, 4, 1))
    gap = (ours.mean(axis=1) - theirs.mean(axis=1))[:, 0]
    within = np.var(ours, axis=1).mean() / 3 + np.var(theirs, axis=1).mean() / 4
    drawn = resampled(Arm(met + ours), Arm(met + theirs), RESAMPLES, 0)
    np.testing.assert_allclose(drawn.var(), (np.var(gap) + within) / 5, rtol=GATE)
    alone = resampled(Arm(np.broadcast_to(met, (5, 3, 7))), NOTHING, RESAMPLES, 0)
    expected = np.var(met.mean(axis=2)) / 5 + np.var(met.mean(axis=0)) / 7
    np.testing.assert_allclose(alone.var(), expected, rtol=GATE)


def test_intervals_hold_the_difference_of_the_population():
    """Twelve objects, four policies each, sixteen places: 95 % intervals hold in 90 to 99 % of studies."""
    rng, held, truth, repetitions = np.random.default_rng(2), 0, 0.4, 300
    for _ in range(repetitions):
        shared = rng.normal(size=(12, 1, 1)) + rng.normal(size=(1, 1, 16))
        effects = lambda: sum(
            size * rng.normal(size=shape)
            for size, shape in ((0.5, (12, 1, 1)), (0.7, (12, 4, 1)), (0.4, (1, 1, 16)), (1.0, (12, 4, 16)))
        )
        arms = [Arm(shared + truth + effects()), Arm(shared + effects())]
        found = contrast(*arms, resamples=400)
        held += found.low <= truth <= found.high
        assert found.low <= found.difference <= found.high
    assert 0.90 <= held / repetitions <= 0.99


def test_p_is_below_the_level_where_the_interval_leaves_out_zero():
    rng = np.random.default_rng(3)
    for shift in (0.0, 0.3, 0.6, 3.0):
        found = contrast(Arm(rng.normal(shift, 1, (6, 4, 8))), Arm(rng.normal(0, 1, (6, 4, 8))))
        if not 0.045 < found.p < 0.055:  # between quantiles
            assert (found.p < 0.05) == (not found.low <= 0 <= found.high)
        assert 0 < found.p <= 1
    assert found.p == pytest.approx(2 / 4001)  # no resample on the other side


def test_holm_by_hand():
    """Sorted 0.005, 0.011, 0.02, 0.04, 0.5 times 5, 4, 3, 2, 1, each at least as large as the one before."""
    np.testing.assert_allclose(holm([0.02, 0.5, 0.005, 0.04, 0.011]), [0.06, 0.5, 0.025, 0.08, 0.044], rtol=1e-12)
    np.testing.assert_allclose(holm([0.03, 0.02, 0.021]), [0.06, 0.06, 0.06])  # 0.021 times 2 is less than 0.02 times 3
    np.testing.assert_allclose(holm([0.9, 0.6]), [1.0, 1.0])
    assert holm([]).tolist() == []
    with pytest.raises(ValueError, match="numbers from 0 to 1"):
        holm([0.1, 1.2])


def test_effect_sizes_by_hand():
    """Policies' means of 1, 3 and 2, 2 on one object, and of 5, 7 and 4, 4 on the other."""
    one, other = (
        np.repeat(np.array(means, float)[:, :, None], 3, axis=2) for means in ([[1, 3], [5, 7]], [[2, 2], [4, 4]])
    )
    # Variance within: 2 + 2 over four degrees of freedom; difference of the means 1; correction 1 - 3 / 15.
    assert standardised(Arm(one), Arm(other)) == pytest.approx(0.8)
    assert superiority(Arm(one), Arm(other)) == pytest.approx((0.5 + 1.0) / 2)
    assert superiority(Arm(other), Arm(other)) == 0.5
    assert np.isnan(standardised(Arm(other), Arm(other)))


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"expected finite numbers \[objects, seeds, places\], got shape \(3, 2\)"):
        Arm(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="expected finite numbers"):
        Arm(np.full((1, 1, 1), np.nan))
    with pytest.raises(ValueError, match=r"expected objects and places \[5, 7\], got \[5, 6\]"):
        contrast(NOTHING, Arm(np.zeros((5, 1, 6))))
