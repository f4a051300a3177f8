"""Summaries by name, against NumPy and SciPy."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

pytest.importorskip("mujoco")

import small
from envs_mujoco import ARM, driven, recorded
from small import whole_runs  # noqa: F401

import jaxlfi
from jaxlfi.bayessim.presets import settings_for
from jaxlfi.envs.mujoco import summaries
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter

DAMPING = Parameter("joint/shoulder/damping", (0.01, 0.5))
NAMES = ("samples", "cross-correlation", "spectrum", "learnt")
NOISES = {"angle": 0.01, "velocity[0]": 0.01}
FALLING = """
<mujoco><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" damping="0.01"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
</body></worldbody><sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>
"""


def missing(log: Log, **rows) -> Log:
    """A recording without some samples."""
    signals = {name: np.array(values, float) for name, values in log.signals.items()}
    for name, own in rows.items():
        signals[name][own] = np.nan
    return Log(log.times, signals, log.name)


def task(summary, logs=None, **others):
    logs = [recorded()] if logs is None else logs
    return mujoco_task(ARM, [DAMPING], logs, list(NOISES), NOISES, summary=summary, **others)


def series(seed=0, rows=101, signals=2):
    """No reflection in time leaves this as it is."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.standard_normal((rows, signals)), axis=0) + np.geomspace(1, 20, rows)[:, None]


def correlations(values, controls):
    """The definition, in loops of double precision; constants are given as zeros."""
    count, parts = len(values), []
    scaled = lambda one: np.zeros(count) if np.ptp(one) == 0 else (one - one.mean()) / one.std()
    z, u = [scaled(one) for one in values.T], [scaled(one) for one in controls.T]
    lags = sorted({int(np.floor(fraction * count + 0.5)) for fraction in (0, 1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4)})
    follow = lambda first, second, lag: sum(first[t] * second[t + lag] for t in range(count - lag)) / count
    for lag in lags:
        parts += [follow(one, signal, lag) for one in u for signal in z]
    for lag in lags[1:]:
        parts += [follow(signal, signal, lag) for signal in z]
    return np.array([*parts, *values.mean(axis=0), *values.std(axis=0)])


def powers(values, floor):
    """Means, and logarithms of SciPy's periodograms summed over bands."""
    count, parts = len(values), [values.mean(axis=0)]
    frequencies, density = scipy.signal.periodogram(values, fs=1.0, window="hann", detrend="constant", axis=0)
    edges = np.unique(np.round(np.geomspace(1, count // 2 + 1, 13)).astype(int))
    for low, high in itertools.pairwise(edges):
        inside = (frequencies * count > low - 0.5) & (frequencies * count < high - 0.5)
        parts.append(np.log(density[inside].sum(axis=0) / count + floor))
    return np.concatenate(parts)


def test_cross_correlation_is_its_definition():
    own, trajectory = task("cross-correlation"), series()
    found = own.summary(jnp.asarray(trajectory, jnp.float32))
    assert found.shape == (6 * 2 + 5 * 2 + 4,)
    expected = correlations(trajectory, driven(recorded().times)[:, None])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_signals_follow_controls_and_not_the_other_way_round():
    """A signal that is the control a quarter of the episode later correlates with it at that lag."""
    rng = np.random.default_rng(1)
    control = rng.standard_normal(100)
    late, early = np.roll(control, 25), np.roll(control, -25)
    log = Log(0.02 * np.arange(100), {"motor": control, "angle": late, "velocity[0]": early})
    found = task("cross-correlation", log).summary(jnp.asarray(np.stack([late, early], axis=1), jnp.float32))
    lags = np.asarray(found[:12]).reshape(6, 2)
    assert lags[-1, 0] > 0.6 and np.abs(np.delete(lags.ravel(), 10)).max() < 0.35


def test_cross_correlation_tells_the_direction_of_time():
    own, trajectory = task("cross-correlation"), series()
    there, back = (np.asarray(own.summary(jnp.asarray(rows, jnp.float32))) for rows in (trajectory, trajectory[::-1]))
    assert np.abs(there[:12] - back[:12]).max() > 0.1  # with the controls
    np.testing.assert_allclose(there[12:], back[12:], atol=1e-4)  # with themselves, and moments


def test_without_controls_there_are_autocorrelations():
    trajectory = series(2, 64, 1)
    log = Log(0.01 * np.arange(64), {"angle": trajectory[:, 0]})
    own = mujoco_task(FALLING, [Parameter("joint/hinge/damping", (0.01, 0.1))], log, summary="cross-correlation")
    found = own.summary(jnp.asarray(trajectory, jnp.float32))
    assert found.shape == (5 + 2,)
    np.testing.assert_allclose(found, correlations(trajectory, np.zeros((64, 0))), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rows", [100, 101])
def test_spectrum_is_scipys(rows):
    log, trajectory = recorded(count=rows), series(3, rows)
    own = task("spectrum", log)
    recording = np.stack([log.signals[name] for name in NOISES], axis=1)
    found = own.summary(jnp.asarray(trajectory, jnp.float32))
    np.testing.assert_allclose(found, powers(trajectory, 1e-8 * recording.var(axis=0)), rtol=1e-3, atol=1e-3)
    # All bands together are the variance of what the window leaves, but for the constant's leakage.
    windowed = (
        scipy.signal.detrend(trajectory, axis=0, type="constant") * scipy.signal.get_window("hann", rows)[:, None]
    )
    total = np.exp(np.asarray(found)[2:].reshape(-1, 2)).sum(axis=0) * 3 / 8
    np.testing.assert_allclose(total, windowed.var(axis=0), rtol=1e-3)


def test_a_vibration_is_in_its_band():
    """In 100 samples, 20 periods lie in the band that begins at 18, in the first signal only."""
    times, edges = np.arange(100) / 100, summaries.bands(100)
    trajectory = np.stack([np.sin(2 * np.pi * 20 * times), 0 * times], axis=1)
    found = np.asarray(task("spectrum", recorded(count=100)).summary(jnp.asarray(trajectory, jnp.float32)))
    bands = found[2:].reshape(-1, 2)
    place = np.searchsorted(edges, 20, side="right") - 1
    assert bands[:, 0].argmax() == place and np.exp(bands[place, 0]) == pytest.approx(0.5, rel=0.01)
    assert np.ptp(bands[:, 1]) == 0 and np.isfinite(found).all()


@pytest.mark.parametrize("name", ["cross-correlation", "spectrum"])
def test_missing_samples_are_interpolated(name):
    """Intervals may be unequal: the summary is that of NumPy's interpolation to equal ones."""
    log, trajectory = recorded(), series(4)
    kept = np.setdiff1d(np.arange(101), [3, 4, 5, 50, 97])
    uneven = Log(log.times[kept], {name: values[kept] for name, values in log.signals.items()})
    gaps = missing(uneven, angle=[0, 10, 11, 95], **{"velocity[0]": [20]})
    own, rows = task(name, gaps), trajectory[kept]
    rows = np.where(own.simulate.function.there, rows, 0.0)
    moments = np.linspace(0, log.times[-1], len(kept))
    present = own.simulate.function.there.T
    even = lambda values: np.stack(
        [np.interp(moments, gaps.times[on], column[on]) for column, on in zip(values.T, present, strict=True)], axis=1
    )
    if name == "spectrum":
        recording = np.stack([gaps.signals[signal] for signal in NOISES], axis=1)
        expected = powers(even(rows), 1e-8 * even(recording).var(axis=0))
    else:
        held = uneven.signals["motor"][np.searchsorted(uneven.times, moments + 1e-9, side="right") - 1]
        expected = correlations(even(rows), held[:, None])
    np.testing.assert_allclose(own.summary(jnp.asarray(rows, jnp.float32)), expected, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_constants_and_signals_that_are_missing_are_finite(name):
    whole, without = recorded(), missing(recorded(), angle=slice(1, None))
    own = task(name, [whole, without])
    for value in (0.0, 0.1, 1e6):
        constant = np.where(own.simulate.function.there, value, 0.0)
        assert np.isfinite(own.summary(jnp.asarray(constant, jnp.float32))).all()
    still = Log(whole.times, whole.signals | {"motor": np.full(101, 0.3)})
    assert np.isfinite(task(name, still).summary(jnp.asarray(series(), jnp.float32))).all()


def test_correlations_of_what_is_constant_are_none():
    constant = np.stack([np.full(101, 0.1), series()[:, 1]], axis=1)
    found = np.asarray(task("cross-correlation").summary(jnp.asarray(constant, jnp.float32)))
    np.testing.assert_array_equal(found[:22:2], 0.0)
    np.testing.assert_allclose(found, correlations(constant, driven(recorded().times)[:, None]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_episodes_are_summarised_one_after_another(name):
    logs = [recorded(), missing(recorded(count=81), angle=[7])]
    together, parts = task(name, logs), [task(name, log) for log in logs]
    trajectory = jnp.asarray(np.where(together.simulate.function.there, series(5, 182), 0.0), jnp.float32)
    expected = [part.summary(rows) for part, rows in zip(parts, (trajectory[:101], trajectory[101:]), strict=True)]
    found = together.summary(trajectory)
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_one_by_one_compiled_and_in_batches_it_is_the_same(name):
    own = task(name, missing(recorded(), angle=[5, 6]))
    trajectories = jnp.asarray(np.stack([series(seed) for seed in range(3)]), jnp.float32)
    eager = np.stack([own.summary(one) for one in trajectories])
    for found in (jax.vmap(own.summary)(trajectories), [jax.jit(own.summary)(one) for one in trajectories]):
        np.testing.assert_allclose(np.asarray(found), eager, rtol=1e-4, atol=1e-4)
    again = dataclasses.replace(task(name, missing(recorded(), angle=[5, 6])), simulate=own.simulate)
    assert own == again  # which finds its compiled programs


def test_learnt_is_the_raw_series_and_an_embedding_of_it():
    own = task("learnt")
    assert own.settings == {"embedding": "series"} and settings_for(own).estimator.embedding == "series"
    np.testing.assert_array_equal(own.summary(jnp.asarray(series(), jnp.float32)), np.float32(series()).ravel())
    assert task("learnt", settings={"embedding": "mlp", "features": 4}).settings == {"embedding": "mlp", "features": 4}
    assert "embedding" not in task("samples").settings


@pytest.mark.slow
def test_a_run_learns_its_summary_anew_in_every_round():
    own = task("learnt", [recorded(), recorded(count=81)])
    estimator = small.SETTINGS.estimator.replace(embedding="series")
    run = jaxlfi.infer(
        jax.random.key(0), own, own.observation, settings=small.settings(estimator=estimator), polish=False
    )
    assert np.isfinite(run.draws(20)).all()


def test_functions_and_the_librarys_names():
    first = functools.partial(jnp.take, indices=0, axis=0)
    assert task(first).summary is first
    assert task("identity").summary(jnp.asarray(series(), jnp.float32)).shape == (202,)


def test_unknown_names_and_recordings_that_are_too_short():
    known = "cross-correlation, identity, learnt, samples, series, spectrum"
    with pytest.raises(ValueError, match=f"^summary: expected one of {known}, got 'spectra'$"):
        task("spectra")
    short = Log(0.02 * np.arange(7), {name: values[:7] for name, values in recorded().signals.items()})
    with pytest.raises(ValueError, match=r"^summary: spectrum: expected at least 8 rows in each episode, got 7$"):
        task("spectrum", [recorded(), short])
    for name in ("samples", "cross-correlation", "learnt"):
        assert np.isfinite(task(name, short).summary(jnp.zeros((7, 2)))).all()
