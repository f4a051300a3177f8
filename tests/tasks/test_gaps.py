"""Recordings with gaps: summaries against NumPy, posteriors against closed forms, folders and tables."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxlfi
from jaxlfi.diagnostics.discrepancy import compared, trajectory_distance
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.gaps import gaps_of, with_gaps
from jaxlfi.tasks.observation import read, trials_of, with_gaps_of
from jaxlfi.tasks.summaries import series, series_of
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated
from tests.small import settings, whole_runs  # noqa: F401 - a fixture

BOX = Support([-3.0, -3.0], [3.0, 3.0])
RECORDING = np.random.default_rng(0).normal([5.0, -200.0], [1.0, 30.0], (40, 2)).cumsum(0)[::2]


def recording(summary="identity", channels=2, count=20, **more) -> Task:
    """Twenty records of two channels, each about its own parameter."""

    def simulate(key, theta):
        return theta + 0.5 * jax.random.normal(key, (count, channels))

    return Task(simulate, ("a", "b"), {"own": BOX}, BOX, summary=summary, **more)


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_series_without_gaps_has_the_same_summary(channels):
    x = jnp.asarray(np.random.default_rng(1).normal(3.0, 2.0, (17, channels)), jnp.float32)
    np.testing.assert_allclose(series_of(x, np.ones((17, channels), bool)), series(x), rtol=1e-5, atol=1e-5)


@given(seed=st.integers(0, 1000), share=st.floats(0.0, 0.6))
def test_the_summary_of_a_series_with_gaps_against_numpy(seed, share):
    rng = np.random.default_rng(seed)
    there = rng.random((20, 2)) >= share
    there[:4] = True  # of each product there is a pair
    x = RECORDING + rng.normal(0, 1, RECORDING.shape)
    found = np.asarray(series_of(jnp.asarray(np.where(there, x, -7e3), jnp.float32), there))
    gappy = np.where(there, x, np.nan)
    mean, variance = np.nanmean(gappy, axis=0), np.nanvar(gappy, axis=0, ddof=1)
    z = (gappy - mean) / np.sqrt(variance)
    memory = [[np.nanmean(z[lag:, c] * z[:-lag, c]) * (20 - lag) / 19 for lag in (1, 2)] for c in range(2)]
    coupling = np.nanmean(z[:, 0] * z[:, 1]) * 20 / 19
    np.testing.assert_allclose(found, [*mean, *np.log1p(variance), *np.ravel(memory), coupling], rtol=2e-3, atol=2e-3)


def test_a_channel_that_never_changes_between_its_gaps_has_no_correlations():
    x = np.column_stack([np.full(9, 4.0), np.arange(9.0) ** 2])
    found = np.asarray(series_of(jnp.asarray(x, jnp.float32), np.arange(18).reshape(9, 2) % 5 != 1))
    assert found[0] == 4.0 and (found[[2, 4, 5, 8]] == 0).all() and np.isfinite(found).all()


def test_what_is_missing_changes_no_summary():
    missing = np.zeros((20, 2), bool)
    missing[3:9, 0] = missing[17:, 1] = True
    one, other = (jnp.asarray(np.where(missing, value, RECORDING), jnp.float32) for value in (0.0, -1e4))
    for summary in ("identity", "series", lambda x: jnp.nanmean(x, axis=0)):
        for task in (recording(summary), repeated(recording(summary, count=10), 2, "all")):
            gappy = with_gaps(task, missing)
            np.testing.assert_array_equal(gappy.summary(one), gappy.summary(other))
            assert np.isfinite(gappy.summary(one)).all()
    assert with_gaps(recording(), missing).summary(one).shape == (31,)
    assert with_gaps(recording(), missing, keep_places=True).summary(one).shape == (40,)


def test_names_of_summaries_follow_their_numbers():
    names = [f"{c}{t}" for t in range(20) for c in "ab"]
    missing = np.zeros((20, 2), bool)
    missing[1, 0] = True
    assert with_gaps(recording(summary_names=names), missing).summary_names == (*names[:2], *names[3:])


def test_distances_are_over_what_is_there():
    missing = np.zeros((20, 2), bool)
    missing[5:, 1] = missing[7, 0] = True
    task = with_gaps(recording(), missing)
    observed = np.where(missing, np.nan, RECORDING).astype(np.float32)
    trajectory = jnp.asarray(RECORDING[None] + np.array([1.0, 50.0]), jnp.float32)
    found = compared(task, jnp.zeros((1, 2)), trajectory, jnp.zeros((1, 31)), jnp.zeros(1, int), jnp.asarray(observed))
    z = np.array([1.0, 50.0]) / np.nanstd(observed, axis=0)
    expected = np.sqrt(np.mean(np.broadcast_to(z**2, (20, 2))[~missing]))
    np.testing.assert_allclose(found.trajectory_error, expected, rtol=1e-4)
    whole = compared(recording(), jnp.zeros((1, 2)), trajectory, jnp.zeros((1, 40)), jnp.zeros(1, int), RECORDING)
    np.testing.assert_allclose(whole.trajectory_error, trajectory_distance(trajectory[0], RECORDING), rtol=1e-5)


def test_what_is_left_of_a_series_is_named_by_channel_and_record():
    missing = np.zeros((20, 2), bool)
    missing[1], missing[2, 0] = True, True
    names = with_gaps(dataclasses.replace(recording(), channels=("a", "b")), missing).summary_names
    assert names[:3] == ("a at record 1", "b at record 1", "b at record 3") and len(names) == 37
    assert with_gaps(recording(), missing).summary_names == ()


TRAINED = settings(
    estimator=settings().estimator.replace(components=1, learning_rate=5e-3, steps=1500, batch_size=100),
    rounds=1,
    simulations_per_round=1000,
    simulation_budget=1000,
    predictive=False,
)
"""Enough for a posterior that is Gaussian."""
EMBEDDED = TRAINED.replace(
    estimator=TRAINED.estimator.replace(embedding="series", schedule="cosine"),
    simulations_per_round=4000,
    simulation_budget=4000,
)
"""For an embedding, which on a thousand simulations is overconfident: widths of a half, means 1.4 deviations away."""


def exact_sd(counts):
    """Standard deviation of the mean of so many records with a standard deviation of 0.5 and a wide prior."""
    return 0.5 / np.sqrt(np.asarray(counts))


@pytest.mark.slow
@pytest.mark.parametrize("chosen", [TRAINED, EMBEDDED], ids=["none", "series"])
def test_posteriors_are_those_given_what_was_recorded(chosen):
    """Most of the second channel is missing, so that its parameter is known half as well.

    Means of different seeds scatter by half a standard deviation; with gaps taken for zeros the second is off by 3.6.
    """
    observed = np.random.default_rng(2).normal([1.0, -1.0], 0.5, (20, 2))
    observed[4:, 1] = np.nan
    run = jaxlfi.infer(3, recording(), observed, heuristic="none", settings=chosen)
    draws = np.asarray(run.posterior.sample(jax.random.key(1), 4000))
    expected = np.nanmean(observed, axis=0)
    np.testing.assert_array_less(np.abs(draws.mean(0) - expected), 1.5 * exact_sd([20, 4]))
    np.testing.assert_allclose(draws.std(0) / exact_sd([20, 4]), 1.0, atol=0.5)


def lengths() -> list[np.ndarray]:
    """Trials of different lengths."""
    rng = np.random.default_rng(4)
    return [rng.normal([1.0, -1.0], 0.5, (length, 2)) for length in (20, 8, 4)]


def test_trials_of_different_lengths_are_one_recording_with_gaps():
    task, joined = trials_of(recording("series"), lengths())
    assert joined.shape == (60, 2) and np.isnan(joined).sum() == 2 * 28
    assert with_gaps_of(task, joined).summary(jnp.asarray(joined, jnp.float32)).shape == (18,)


@pytest.mark.slow
def test_trials_of_different_lengths_are_one_posterior():
    trials = lengths()
    run = jaxlfi.infer(
        0, recording("series"), trials, heuristic="none", settings=jaxlfi.QUICK.replace(rounds=6, min_rounds=0)
    )
    mean = np.mean([trial.mean(0) for trial in trials], axis=0)  # of the trials' means: its sd is known, too
    sd = 0.5 * np.sqrt(sum(1 / len(trial) for trial in trials)) / 3
    draws = np.asarray(run.posterior.sample(jax.random.key(1), 4000))
    np.testing.assert_array_less(np.abs(draws.mean(0) - mean), 1.5 * sd)


@pytest.mark.slow
def test_a_run_with_gaps_is_saved_resumed_and_loaded(tmp_path):
    numbers = np.random.default_rng(3).normal(0.0, 0.5, (20, 2))
    observed = np.ma.masked_array(numbers, mask=np.arange(40).reshape(20, 2) % 7 == 3)
    whole = jaxlfi.infer(0, recording(), observed, settings=settings(rounds=1), out=tmp_path / "run")
    again = jaxlfi.load(tmp_path / "run", task=recording())
    np.testing.assert_array_equal(whole.x, again.x)
    assert np.isnan(again.observed).sum() == 6 and gaps_of(again.task).sum() == 6
    of_another = again.posterior_of(observed + 0.1)
    of_summary = again.posterior_of(np.asarray(again.x) + 0.1)
    np.testing.assert_allclose(of_another.mean(), of_summary.mean(), atol=1e-4)
    jaxlfi.infer(0, recording(), observed, settings=settings(rounds=1), out=tmp_path / "run")
    other = observed.copy()
    other[0, 0] = np.ma.masked
    with pytest.raises(ValueError, match="another observation"):
        jaxlfi.infer(0, recording(), other, settings=settings(rounds=1), out=tmp_path / "run")


def test_empty_cells_of_a_table_are_missing(tmp_path):
    (tmp_path / "x.csv").write_text("a,b\n1,2\n,3\nNA,nan\n")
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), [[1, 2], [np.nan, 3], [np.nan, np.nan]])


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.full((20, 2), np.nan), "all are missing"),
        (np.where(np.eye(20, 2), np.inf, 0.0), "NaN where one is missing"),
        (np.where(np.eye(20, 2), np.nan, np.inf), "NaN where one is missing"),
    ],
)
def test_what_is_no_recording_is_refused(observation, message):
    with pytest.raises(ValueError, match=message):
        jaxlfi.infer(0, recording(), observation, settings=settings(rounds=1))


def test_moments_of_trials_with_different_gaps_are_refused():
    trials = [np.where(np.arange(40).reshape(20, 2) == place, np.nan, 0.0) for place in (1, 2)]
    trials[1][0, 0] = np.nan
    with pytest.raises(ValueError, match="same gaps"):
        jaxlfi.infer(0, recording(), trials, settings=settings(rounds=1))


def test_a_summary_that_does_not_know_of_gaps_is_named():
    with pytest.raises(ValueError, match="finite summary"):
        jaxlfi.infer(0, recording(lambda x: jnp.mean(x, axis=0)), np.where(np.eye(20, 2), np.nan, 0.0))
