"""Intervals: SciPy's binomial intervals, synthetic posteriors of known faults, and one statement in two forms."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.diagnostics import check_intervals, check_regions
from jaxlfi.diagnostics import intervals as module

SEEDS = range(20)
LEVEL = 0.9


def case(seed: int, scale: float, shift: float, truths: int = 100, dim: int = 2):
    """Truths, and draws of normal posteriors of another width and place than theirs."""
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=(truths, dim))
    draws = centre[:, None] + shift + scale * rng.normal(size=(truths, 200, dim))
    return centre + rng.normal(size=(truths, dim)), draws


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n))), st.sampled_from([0.05, 0.01]))
def test_the_interval_of_a_fraction_is_scipys(counts, error):
    trials, count = counts
    exact = scipy.stats.binomtest(count, trials).proportion_ci(1 - error, "exact")
    np.testing.assert_allclose(module.binomial_interval(count, trials, error), exact, atol=1e-9)


def test_the_interval_of_a_quantile_holds_it_as_often_as_it_says():
    rng = np.random.default_rng(0)
    values = rng.exponential(size=(2000, 100))
    ends = np.array([module.quantile_interval(row, LEVEL, 0.05) for row in values])
    right = np.log(10)  # the 90 % quantile
    held = np.mean((ends[:, 0] <= right) & (right <= ends[:, 1]))
    # Its own probability, by the binomial numbers of values below the quantile.
    ranks = 1 + np.searchsorted(np.sort(values[0]), ends[0])
    binomial = scipy.stats.binom(100, LEVEL)
    expected = binomial.cdf(ranks[1] - 1) - binomial.cdf(ranks[0] - 1)
    assert expected >= 0.95 and abs(held - expected) < 4 * np.sqrt(expected * (1 - expected) / 2000)


@given(st.integers(1, 200), st.integers(0, 10_000))
def test_fraction_and_factor_are_one_statement(truths, seed):
    """The factor's interval excludes 1 just where the fraction's excludes 90 %."""
    rng = np.random.default_rng(seed)
    distances = rng.exponential(rng.uniform(0.1, 1.5), truths)
    low, high = module.quantile_interval(distances, LEVEL, 0.05)
    exact = scipy.stats.binomtest(int(np.sum(distances <= 1)), truths).proportion_ci(0.95, "exact")
    assert (low > 1) == (exact.high < LEVEL) and (high < 1) == (exact.low > LEVEL)


@pytest.mark.parametrize(
    ("scale", "shift", "verdict"),
    [
        (1.0, 0.0, "calibrated"),
        (0.5, 0.0, "too narrow"),
        (2.0, 0.0, "too wide"),
        (1.0, 1.2, "biased high"),
        (1.0, -1.2, "biased low"),
        (0.5, 0.8, "too narrow, biased high"),
        (2.0, -0.9, "too wide, biased low"),
    ],
)
def test_faults_are_called_by_name(scale, shift, verdict):
    """This holds for all but a few of many seeds, as the confidence level promises."""
    found = [check_intervals(*case(seed, scale, shift, 200, 1))[0] for seed in SEEDS]
    assert sum(one.verdict == verdict for one in found) >= 17
    if shift == 0:  # stretched by the right factor, intervals hold what they should
        covered = sum(one.factor.low <= 1 / scale <= one.factor.high for one in found)
        assert covered >= 17
        np.testing.assert_allclose(np.median([one.factor.value for one in found]), 1 / scale, rtol=0.12)
        inside = 2 * scipy.stats.norm.cdf(scale * scipy.stats.norm.ppf(0.95)) - 1
        np.testing.assert_allclose(np.mean([one.held[1].value for one in found]), inside, atol=0.03)


@pytest.mark.slow
def test_calibrated_posteriors_are_rarely_called_wrong():
    """None of 4 parameters, with a probability of 94 % at least; most are calibrated with 100 truths, few with 40."""
    found = {count: [check_intervals(*case(seed, 1.0, 0.0, count, 4)) for seed in range(50)] for count in (40, 100)}
    words = {count: [[one.verdict for one in four] for four in of_seeds] for count, of_seeds in found.items()}
    for of_seeds in words.values():
        right = sum(set(four) <= {"calibrated", "undecided"} for four in of_seeds)
        assert right >= scipy.stats.binom.ppf(0.001, 50, 0.94)
    share = {
        count: np.mean([word == "calibrated" for four in of_seeds for word in four])
        for count, of_seeds in words.items()
    }
    assert share[40] < 0.2 and share[100] > 0.6


def test_no_width_is_honest_that_may_be_off():
    """Calibrated means known to be right to within a factor: widths off by twice that are never found so."""
    for scale in (1 / 3, 3.0):
        for truths in (20, 40, 100):
            assert all(check_intervals(*case(seed, scale, 0.0, truths))[0].verdict != "calibrated" for seed in SEEDS)
    for seed in SEEDS:
        (one,) = check_intervals(*case(seed, 1.0, 0.0, 100, 1))
        assert (one.verdict == "calibrated") <= (one.factor.low >= 1 / 1.5 and one.factor.high <= 1.5)


def test_a_factor_is_what_the_intervals_lacked():
    """Skewed posteriors, exact but for a stretch about their medians, which the factor undoes in each direction."""
    rng = np.random.default_rng(1)
    truths, draws = rng.exponential(size=(4000, 1)), rng.exponential(size=(4000, 200, 1))
    middle = np.median(draws, axis=1, keepdims=True)
    (found,) = check_intervals(truths, middle + (draws - middle) / 3)
    assert found.factor.low < 3 < found.factor.high and found.factor.high / found.factor.low < 1.2
    (exact,) = check_intervals(truths, draws)
    assert exact.verdict == "calibrated"


def test_few_draws_do_not_make_intervals_narrow():
    """Quantiles of 20 draws are those of the next draw."""
    held = [check_intervals(t, d[:, :20])[0].held[1].value for t, d in (case(seed, 1.0, 0.0, 400, 1) for seed in SEEDS)]
    np.testing.assert_allclose(np.mean(held), 0.9, atol=0.015)


def test_too_few_truths_leave_it_undecided():
    few = [check_intervals(*case(seed, 1.0, 0.0, 20, 1))[0] for seed in SEEDS]
    assert sum(one.verdict == "undecided" for one in few) >= 17
    assert {one.factor.high for one in few} == {np.inf}
    assert check_regions(np.repeat([10, 50], [18, 2]), 50).verdict == "undecided"
    # But not what even they show.
    assert check_intervals(*case(0, 0.2, 0.0, 20, 1))[0].verdict == "too narrow"


def test_posteriors_without_width_and_truths_far_away():
    truths, _ = case(0, 1.0, 0.0, 60, 1)
    points = np.repeat(np.linspace(-3, 3, 60)[:, None, None], 50, axis=1)
    (point,) = check_intervals(truths, points)
    assert point.verdict == "too narrow" and point.factor.low == np.inf and point.held[1].value == 0


def whole_numbers(rng, kinds, truths=400, draws=200):
    """Exact posteriors of whole numbers: truths and draws from the same distribution, another for each truth."""
    probability = rng.dirichlet(np.full(kinds, 0.7), truths)
    pick = lambda size: np.array([rng.choice(kinds, size, p=own) for own in probability], float)
    return pick(1), pick(draws)[..., None]


def clipped(rng, kinds, truths=400, draws=200):
    """Exact posteriors, partly clipped to a bound, as the truths are."""
    centre = rng.normal(size=(truths, 1))
    clip = lambda values: np.clip(values, -0.7, 1.5)
    return clip(centre + rng.normal(size=(truths, 1))), clip(centre[:, None] + rng.normal(size=(truths, draws, 1)))


@pytest.mark.parametrize("make", [whole_numbers, clipped])
@pytest.mark.parametrize("kinds", [2, 3, 5, 12])
def test_ties_are_shared_out(make, kinds):
    """Exact posteriors of discrete parameters are neither narrow nor wide, and lie on no side of their truths."""
    found = [check_intervals(*make(np.random.default_rng([kinds, seed]), kinds))[0] for seed in range(8)]
    truths = sum(one.truths for one in found)
    for estimates, share in (
        ([one.above for one in found], 0.5),
        ([one.held[0] for one in found], 0.5),
        ([one.held[1] for one in found], 0.9),
    ):
        count = round(sum(one.value * 400 for one in estimates))
        assert scipy.stats.binomtest(count, truths, share).pvalue > 1e-3
    assert sum(one.verdict in ("calibrated", "undecided") for one in found) >= 7


def test_whole_numbers_that_are_off_are_called_so():
    rng = np.random.default_rng(0)
    truths, draws = rng.integers(1, 6, (400, 1)), rng.integers(1, 6, (400, 200, 1))
    assert check_intervals(truths, draws)[0].verdict == "calibrated"
    assert "biased high" in check_intervals(truths, np.minimum(draws + 1, 6))[0].verdict
    assert "biased low" in check_intervals(truths + 1, draws)[0].verdict
    assert "too narrow" in check_intervals(truths, np.where(draws == 3, draws, 3 + (draws > 4)))[0].verdict
    # What does not depend on ties does not depend on a chance either.
    again = [check_intervals(truths, draws)[0] for _ in range(2)]
    assert again[0] == again[1]


NOTHING = {
    "NaN": lambda truths, draws: (truths, np.where(draws > 3, np.nan, draws)),
    "NaN truth": lambda truths, draws: (np.where(truths > 1, np.nan, truths), draws),
    "infinite": lambda truths, draws: (truths, np.where(draws > 3, np.inf, draws)),
    "one row": lambda truths, draws: (truths[:1], draws[:1]),
    "few draws": lambda truths, draws: (truths, draws[:, :18]),
    "no draws": lambda truths, draws: (truths, draws[:, :0]),
    "no rows": lambda truths, draws: (truths[:0], draws[:0]),
    "constants": lambda truths, draws: (np.ones_like(truths), np.ones_like(draws)),
    "one constant parameter": lambda truths, draws: (truths, draws * [1.0, 0.0]),
    "exact": lambda truths, draws: (truths, np.repeat(truths[:, None], 200, axis=1)),
}


@pytest.mark.parametrize("change", NOTHING)
def test_what_says_nothing_is_refused(change):
    with pytest.raises(ValueError, match="expected") as refused:
        check_intervals(*NOTHING[change](*case(0, 1.0, 0.0)))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("rank", "draws"),
    [([1, 60], 50), ([1], 50), ([], 50), ([1, 2], 10), ([0.5, 2], 50), ([np.nan, 2], 50), ([1, 2], 50.5)],
)
def test_ranks_that_are_none_are_refused(rank, draws):
    with pytest.raises(Exception, match=r"expected|Int"):
        check_regions(np.array(rank), draws)


def test_regions():
    rng = np.random.default_rng(0)
    uniform = rng.integers(0, 201, 2000)
    exact = check_regions(uniform, 200)
    assert exact.verdict == "calibrated" and exact.factor is None and abs(exact.held[0].value - 0.5) < 0.04
    assert check_regions(200 - uniform // 2, 200).verdict == "too narrow"
    assert check_regions(uniform // 2, 200).verdict == "too wide"


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(Exception, match=r"expected shapes|beartype|Float"):
        check_intervals(np.zeros((3, 2)), np.zeros((3, 4)))
