"""Observations unlike all simulations: how often those of the model itself are reported, and which others are."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from jaxlfi.diagnostics import misspecification, unlike

CHANNELS = ("position", "velocity")


def gaussian(rng, count):
    theta = rng.uniform(-3, 3, (count, 2))
    return theta @ [[1.0, -0.2], [0.4, 0.8]] + rng.normal(size=(count, 2)) * [0.3, 0.5]


def heavy(rng, count):
    return rng.uniform(-5, 5, (count, 1)) + rng.standard_t(1.5, (count, 6))


def counts(rng, count):
    """Summaries that tie, of which one is nearly always 0."""
    rate = rng.uniform(1, 5, (count, 1))
    return np.concatenate([rng.poisson(rate, (count, 3)), rng.poisson(rate / 200)], axis=1)


def orders(rng, count):
    """Positive summaries of several orders of magnitude that go together."""
    size = rng.normal(0, 3, (count, 1))
    return np.exp(size + rng.normal(0, [0.1, 0.3, 1.0], (count, 3)))


def oscillator(rng, count):
    """Position and velocity of damped oscillators, [count, 25, 2] with noise."""
    frequency, damping = rng.uniform([[1.0], [0.0]], [[5.0], [1.0]], (2, count))[..., None]
    time = 0.2 * np.arange(25)
    fall = np.exp(-damping * time)
    states = np.stack([fall * np.cos(frequency * time), -frequency * fall * np.sin(frequency * time)], axis=2)
    return states + rng.normal(size=states.shape) * [0.05, 0.15]


def flat(states):
    return states.reshape(len(states), -1)


MODELS = {
    "gaussian": gaussian,
    "heavy": heavy,
    "counts": counts,
    "orders": orders,
    "oscillator": lambda rng, count: flat(oscillator(rng, count)),
}


@pytest.mark.slow
@pytest.mark.parametrize("simulations", [30, 100, 1000])
def test_few_observations_of_the_model_itself_are_reported(simulations):
    """At most one in a hundred is reported, over five simulators; the study in experiments/ has more."""
    rng = np.random.default_rng(simulations)
    total, cases = 0, 100 if simulations < 1000 else 10
    for name, simulate in MODELS.items():
        channels = CHANNELS if name == "oscillator" else ()
        reported = 0
        for _ in range(cases):
            x, *others = simulate(rng, 1 + simulations)
            reported += bool(unlike(x, np.array(others), channels=channels))
        assert reported <= 3, name
        total += reported
    assert total <= 0.01 * cases * len(MODELS)


@pytest.mark.parametrize("simulations", [100, 1000])
def test_other_units_order_and_places_are_reported(simulations):
    rng = np.random.default_rng(1)
    found = dict.fromkeys(("moved", "larger", "smaller", "degrees", "shuffled", "delayed"), 0)
    for _ in range(10):
        own, *others = oscillator(rng, 1 + simulations)
        observed = {
            "moved": own + np.array([10.0, 0.0]),
            "larger": own * 1000,
            "smaller": own * [0.001, 1.0],
            "degrees": own * [1.0, 180 / np.pi],
            "shuffled": rng.permutation(own),
            "delayed": np.stack([own[:, 0], np.roll(own[:, 1], 8)], axis=1),
        }
        for kind, states in observed.items():
            found[kind] += bool(unlike(states.ravel(), flat(np.array(others)), channels=CHANNELS))
    assert found.pop("delayed") >= 3  # what falls quickly leaves little to delay
    assert all(hits >= 9 for hits in found.values()), found


def test_a_shuffled_series_is_told_by_summaries_that_go_together():
    """Each of two summaries is in its range, but in all simulations they are nearly equal."""
    rng = np.random.default_rng(2)
    simulations = rng.uniform(0, 1, (1000, 1)) + 0.01 * rng.normal(size=(1000, 2))
    (finding,) = unlike([0.2, 0.8], simulations, ["first", "second"])
    assert finding.kind == "joint" and finding.p_value < 0.001
    assert "unlike all 1,000 simulations taken together (p < 0.001), though no number is by itself" in str(finding)
    assert unlike([0.5, 0.5], simulations) == []


def test_the_finding_names_the_summary_and_both_ranges():
    rng = np.random.default_rng(3)
    simulations = np.stack([rng.normal(size=500), rng.uniform(1.0, 2.0, 500)], axis=1)
    (finding,) = unlike([0.1, 1500.0], simulations, ["angle", "force"])
    low, high = simulations[:, 1].min(), simulations[:, 1].max()
    assert (finding.name, finding.kind, finding.observed) == ("force", "range", (1500.0, 1500.0))
    assert (finding.low, finding.high) == (low, high)
    assert str(finding) == (
        f"force is 1500, all 500 simulations lie between {low:.4g} and {high:.4g}: {misspecification.UNITS}"
    )


def test_of_many_summaries_outside_the_clearest_are_named():
    simulations = np.random.default_rng(4).normal(size=(200, 6))
    found = unlike([1e3, 1e4, 1e5, 1e6, 1e7, 0.0], simulations, list("abcdef"))
    assert len({finding.name for finding in found} & set("abcde")) == 3
    assert found == sorted(found, key=lambda finding: finding.p_value)
    assert str(found[-1]).endswith("(2 others lie outside, too)")


def test_a_channel_is_named_once_with_its_range_or_what_is_wrong_with_it():
    rng = np.random.default_rng(5)
    own, *others = oscillator(rng, 1001)
    simulations = flat(np.array(others))
    (finding,) = unlike((own * [1.0, 1000.0]).ravel(), simulations, channels=CHANNELS)
    assert finding.name == "velocity" and str(finding).startswith("velocity goes from -")
    np.testing.assert_allclose([finding.low, finding.high], [f(np.array(others)[..., 1]) for f in (np.min, np.max)])
    (finding,) = unlike((own * [1.0, 0.001]).ravel(), simulations, channels=CHANNELS)
    assert finding.name == "the standard deviation of velocity over time"
    np.testing.assert_allclose(finding.observed[0], np.std(own[:, 1]) * 0.001)
    np.testing.assert_allclose(finding.low, np.array(others)[..., 1].std(axis=1).min())
    first = own.copy()
    first[0, 0] = -0.5  # one record, in the range of the others
    (finding,) = unlike(first.ravel(), simulations, channels=CHANNELS)
    assert finding.name == "position at record 1" and "does it begin as simulations do" in str(finding)


def test_steps_tell_a_shuffled_series_of_any_level_and_size():
    """Random walks share only their smoothness: the mean square step over the variance."""
    rng = np.random.default_rng(6)
    walks = 10 ** rng.uniform(-2, 2, (400, 1)) * np.cumsum(rng.normal(size=(400, 60)), axis=1)
    (finding,) = unlike(rng.permutation(walks[0]), walks[1:], channels=["height"])
    assert finding.name == "the mean square step of height, over its variance,"
    steps = np.mean(np.diff(walks[1:]) ** 2, axis=1) / np.var(walks[1:], axis=1)
    np.testing.assert_allclose([finding.low, finding.high], [steps.min(), steps.max()])
    assert unlike(walks[0], walks[1:], channels=["height"]) == []


@pytest.mark.parametrize("value", [1.0, 0.0, -3e8, 1e-9])
def test_a_constant_seen_at_another_value_is_reported_and_its_rounding_is_not(value):
    rng = np.random.default_rng(7)
    simulations = np.stack([rng.normal(size=50), np.full(50, value)], axis=1).astype(np.float32)
    assert unlike(np.float32([0.1, value]), simulations) == []
    assert unlike(np.float32([0.1, value * (1 + 2e-7)]), simulations) == []
    (finding,) = unlike([0.1, value * 1.001 if value else 1e-12], simulations, ["mass", "g"])
    assert (finding.name, finding.kind) == ("g", "constant")
    assert "all 50 simulations have" in str(finding)


def test_what_only_later_rounds_cover_is_covered():
    """The support was wrong and has moved to the observation, which is one more simulation among those around it."""
    rng = np.random.default_rng(8)
    first, last = rng.normal(0, 1, (100, 3)), rng.normal(40, 1, (100, 3))
    between = rng.normal(0, 1, (300, 3)) + rng.uniform(0, 40, (300, 1))
    assert unlike(rng.normal(40, 1, 3), np.concatenate([first, between, last])) == []
    assert unlike(rng.normal(40, 1, 3), first)


@hypothesis.given(st.integers(-12, 12), st.floats(-1e3, 1e3), st.booleans())
def test_findings_do_not_depend_on_the_unit(power, offset, foreign):
    """Units and offsets of summaries do not matter, as far as double precision resolves the offsets."""
    rng = np.random.default_rng(9)
    simulations = gaussian(rng, 200)
    x = np.array([0.5, 40.0]) if foreign else np.array([0.5, 0.4])
    plain, scaled = (
        unlike(*(factor * (values + offset * (factor != 1.0)) for values in (x, simulations)))
        for factor in (1.0, 10.0**power)
    )
    assert [(one.name, one.kind) for one in plain] == [(one.name, one.kind) for one in scaled]
    np.testing.assert_allclose(*([one.p_value for one in found] for found in (plain, scaled)), rtol=1e-4)
    assert bool(plain) == foreign


def test_the_probability_of_a_gap_is_that_of_exponential_tails():
    """Compared with draws: how far the largest of 50 is ahead, relative to the spread of the next five."""
    rng = np.random.default_rng(10)
    top = -np.sort(-rng.exponential(size=(60_000, 50)), axis=1)[:, :7]
    for gap in (0.5, 2.0, 5.0):
        ratio = (top[:, 0] - top[:, 1]) / (top[:, 1] - top[:, 6])
        # that the newest of 50 is the largest, and by so much
        expected = np.mean(ratio > gap) / 50
        found = misspecification._extrapolated(np.array([gap]), np.array([1.0]), 5, 49)[0]
        np.testing.assert_allclose(found, expected, rtol=0.2, atol=1e-5)


def test_whitened_ranks_are_the_same_by_either_decomposition():
    """Distances with more or fewer columns than rows, compared with the inverse of the shrunk correlations."""
    rng = np.random.default_rng(11)
    for size in (5, 80):
        both = rng.normal(size=(40, size)) @ rng.normal(size=(size, size))
        points = misspecification._whitened_ranks(both)
        ranks = both.argsort(axis=0).argsort(axis=0)
        z = np.vectorize(misspecification.statistics.NormalDist().inv_cdf)((ranks + 0.5) / 40)
        z /= np.sqrt(np.mean(z**2, axis=0))
        shrinkage = size / (size + 40)
        precision = np.linalg.inv((1 - shrinkage) * z.T @ z / 40 + shrinkage * np.eye(size))
        away = z[0] - z[7]
        np.testing.assert_allclose(np.sum((points[0] - points[7]) ** 2), away @ precision @ away, rtol=1e-6)


def test_rows_that_are_not_finite_are_left_out_and_too_few_say_nothing():
    simulations = np.random.default_rng(12).normal(size=(60, 2))
    simulations[::3, 0] = np.nan
    assert [finding.kind for finding in unlike([100.0, 0.0], simulations)] == ["range"]
    assert "all 40 simulations" in str(unlike([100.0, 0.0], simulations)[0])
    assert unlike([100.0, 0.0], simulations[1:20]) == []
    assert unlike([100.0, 0.0], np.zeros((0, 2))) == []
    assert unlike([5.0], np.ones((2, 1)))[0].kind == "constant"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0, 1.0], np.zeros((9, 3))), r"got \[2\] and \[9, 3\]"),
        (([np.nan], np.zeros((9, 1))), "finite observation"),
        (([0.0, 1.0], np.zeros((9, 2)), ["one"]), "names: expected one for each of the 2 summaries, got 1"),
        (([0.0, 1.0, 2.0], np.zeros((9, 3)), None, ["a", "b"]), "channels: expected"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        unlike(*arguments)
