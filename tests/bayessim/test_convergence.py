"""Rounds until the posterior settles: the rule against NumPy, and runs that end by themselves when they settle."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.batch import BatchEngine, RunSpec, stack_inputs
from jaxlfi.bayessim.convergence import LAG, SAME_CORRELATION, SAME_WIDTH, STILL, advanced, not_begun
from jaxlfi.bayessim.host import HostEngine
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.diagnostics import POSTERIOR_SAMPLES
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.heuristics import Edge
from jaxlfi.io.formats import RUN
from jaxlfi.runs import execute as executing
from jaxlfi.runs.describe import settings_from_json, settings_to_json
from jaxlfi.tasks.host import HostSimulator
from tests.small import TASK, gaussian, settings, whole_runs  # noqa: F401 - a fixture
from tests.tasks.test_host import Counting

SETTINGS = settings(predictive=False, rounds=8, min_rounds=4, inflation=2.0, restriction="reject")
OBSERVED = np.array([0.8, -0.6], np.float32)
SEEDS = range(6)
advance = jax.jit(advanced, static_argnames="min_rounds")
start = functools.cache(not_begun)


def gaussians(means, factors) -> GaussianMixture:
    """A mixture of equally weighted Gaussians."""
    return GaussianMixture(np.zeros(len(means), np.float32), np.float32(means), np.float32(factors))


def narrow(mean, sd) -> GaussianMixture:
    """One Gaussian."""
    return gaussians([mean], [np.diag(sd)])


def test_movement_is_that_of_the_mean_in_standard_deviations_over_the_last_rounds():
    rng = np.random.default_rng(0)
    means, sd = rng.normal(size=(9, 3)).cumsum(axis=0), np.array([0.5, 2.0, 7.0])
    progress, moved = start(3), []
    for mean in means:
        progress = advance(progress, narrow(mean, sd), min_rounds=1)
        moved.append(float(progress.moved))
        assert bool(progress.settled) == (moved[-1] < STILL)
    expected = [np.max(np.abs(means[i] - means[i - LAG]) / sd) if i >= LAG else np.inf for i in range(len(means))]
    np.testing.assert_allclose(moved, expected, rtol=1e-5)
    assert int(progress.rounds) == 9


def mixtures(rounds: int, dim: int, rng: np.random.Generator) -> list[GaussianMixture]:
    """Random mixtures of two Gaussians."""
    parts = lambda *shape: rng.normal(size=shape).astype(np.float32)
    tril = lambda: np.tril(parts(2, dim, dim), -1) + np.eye(dim, dtype=np.float32) * (0.2 + np.abs(parts(2, dim, dim)))
    return [GaussianMixture(parts(2), parts(2, dim), tril()) for _ in range(rounds)]


def test_widths_and_correlations_are_those_of_draws():
    """Compared with NumPy's for 200,000 draws of each posterior."""
    posteriors = mixtures(5, 3, np.random.default_rng(1))
    many = jax.jit(lambda key, one: one.sample(key, 200_000))
    draws = [np.asarray(many(jax.random.key(i), one)) for i, one in enumerate(posteriors)]
    progress, found = start(3), []
    for posterior in posteriors:
        progress = advance(progress, posterior, min_rounds=1)
        found.append([float(progress.moved), float(progress.rescaled), float(progress.turned)])
    assert np.all(np.isinf(found[:LAG]))
    for i in (3, 4):
        now, then = draws[i], draws[i - LAG]
        ratio = now.std(axis=0) / then.std(axis=0)
        expected = [
            np.max(np.abs(now.mean(axis=0) - then.mean(axis=0)) / now.std(axis=0)),
            np.max(np.maximum(ratio, 1 / ratio)),
            np.max(np.abs(np.corrcoef(now.T) - np.corrcoef(then.T))),
        ]
        np.testing.assert_allclose(found[i], expected, atol=0.03)


def correlated(sd, correlation: float) -> GaussianMixture:
    covariance = np.outer(sd, sd) * [[1, correlation], [correlation, 1]]
    return gaussians(np.zeros((1, 2)), np.linalg.cholesky(covariance)[None])


@pytest.mark.parametrize(
    ("last", "settled"),
    [
        (correlated([1.0, 1.0], 0.2), True),
        (correlated([1.0, 1 / 6], 0.2), False),  # it has narrowed sixfold about the same mean
        (correlated([6.0, 1.0], 0.2), False),
        (correlated([1.0, 1.0 / SAME_WIDTH + 0.05], 0.2), True),
        (correlated([1.0, 1.0], 0.25 + SAME_CORRELATION), False),
        (correlated([1.0, 1.0], 0.15 + SAME_CORRELATION), True),
        (correlated([1.0, 1.0], 0.15 - SAME_CORRELATION), False),
    ],
)
def test_a_posterior_settles_once_its_widths_and_correlations_have(last, settled):
    progress = start(2)
    for posterior in [correlated([1.0, 1.0], 0.2)] * LAG + [last]:
        progress = advance(progress, posterior, min_rounds=1)
    assert float(progress.moved) == 0 and bool(progress.settled) is settled


def test_the_unit_of_a_parameter_does_not_matter():
    posteriors, unit = mixtures(4, 3, np.random.default_rng(2)), np.float32([1e-6, 1.0, 1e5])
    one = other = start(3)
    scaled = jax.jit(GaussianMixture.affine)
    for posterior in posteriors:
        one = advance(one, posterior, min_rounds=1)
        other = advance(other, scaled(posterior, unit, np.zeros(3, np.float32)), min_rounds=1)
    for name in ("moved", "rescaled", "turned"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-3)


def test_a_run_does_not_settle_before_its_least_rounds():
    progress = start(1)
    settled = []
    for _ in range(7):
        progress = advance(progress, narrow([1.0], [1.0]), min_rounds=6)
        settled.append(bool(progress.settled))
    assert settled == [False] * 5 + [True] * 2  # it stands still from the fourth round on


def batch(engine=BatchEngine, task=None, seeds=SEEDS, settings=SETTINGS):
    """Runs on a wrong support, stepped together: the last states, and the records of all rounds, [rounds, runs]."""
    task = task or gaussian()
    specs = [RunSpec("", "misspecified", task.support("misspecified"), Edge(), seed) for seed in seeds]
    observed = np.tile(OBSERVED, (len(specs), 1))
    inputs, _ = stack_inputs(specs, observed, observed)
    one, rows = engine(task, settings, inputs), []
    state = run_rounds(one, one.start(), range(settings.rounds), lambda i, state, row, s: rows.append(row))
    return one.fetch(state), {name: np.stack([row[name] for row in rows]) for name in rows[0]}


@pytest.fixture(scope="module")
def together(whole_runs):  # noqa: F811 - the fixture
    """Six runs, stepped until all have settled."""
    return batch()


def test_runs_end_one_by_one_and_stay_as_they_are(together):
    state, rows = together
    own = np.asarray(state.progress.rounds)
    assert np.all(own >= SETTINGS.min_rounds) and len(set(own.tolist())) > 1, "expected runs of different lengths"
    made = np.arange(len(rows["settled"]))[:, None] < own
    assert np.array_equal(rows["attempted"] > 0, made)
    assert np.array_equal(rows["settled"], np.arange(len(made))[:, None] >= np.where(rows["settled"][-1], own - 1, 99))
    assert np.array_equal(np.asarray(state.dataset.size), rows["succeeded"].sum(axis=0))
    for run, rounds in enumerate(own):
        for name in ("means", "scale_tril", "support_low", "support_high", "moved", "sample_theta_error"):
            after = rows[name][rounds - 1 :, run]
            assert np.array_equal(after, np.broadcast_to(after[:1], after.shape)), name
        assert not np.any(rows["low_shift"][rounds:, run])


@pytest.mark.slow
def test_a_run_by_itself_makes_the_same_rounds(together):
    state, rows = together
    run = jaxlfi.infer(
        jax.random.key(2), gaussian(), OBSERVED, support="misspecified", heuristic=Edge(), settings=SETTINGS
    )
    rounds = int(state.progress.rounds[2])
    assert len(run.history["attempted"]) == rounds and run.history["settled"][-1]
    np.testing.assert_allclose(run.history["means"], rows["means"][:rounds, 2], atol=2e-3)


@pytest.mark.slow
def test_a_traced_run_makes_the_same_rounds(together):
    state, rows = together
    infer = lambda key: jaxlfi.infer(
        key, gaussian(), OBSERVED, support="misspecified", heuristic=Edge(), settings=SETTINGS
    )
    runs = jax.jit(jax.vmap(infer))(jax.vmap(jax.random.key)(jnp.arange(2)))
    assert runs.history["attempted"].shape == (2, SETTINGS.rounds)
    made = np.sum(np.asarray(runs.history["attempted"]) > 0, axis=1)
    assert np.array_equal(made, np.asarray(state.progress.rounds)[:2])
    np.testing.assert_allclose(runs.belief.mixture.means, rows["means"][-1, :2], atol=2e-3)


@pytest.mark.slow
def test_a_host_simulator_is_not_called_for_runs_at_their_end(whole_runs):  # noqa: F811 - the fixture
    counting = Counting()
    task = dataclasses.replace(gaussian(), simulate=HostSimulator(counting))
    state, rows = batch(HostEngine, task, seeds=range(3), settings=SETTINGS.replace(predictive=True))
    own = np.asarray(state.progress.rounds)
    assert len(set(own.tolist())) > 1, "expected runs of different lengths"
    made = np.arange(len(rows["settled"]))[:, None] < own
    np.testing.assert_array_equal(rows["predictive_simulations"], POSTERIOR_SAMPLES * made)
    assert sum(counting.calls) == rows["attempted"].sum() + rows["predictive_simulations"].sum()
    assert np.all(np.isfinite(rows["sample_trajectory_error"]))  # of runs at their end, as was seen before


@pytest.mark.slow
def test_a_run_that_settled_before_it_was_killed_resumes_to_the_same_bits(tmp_path, whole_runs):  # noqa: F811
    rule = Edge()
    spec = RunSpec("misspecified+edge", "misspecified", gaussian().support("misspecified"), rule, 9)  # settles early
    plan = executing.BatchPlan(RUN, TASK, gaussian(), None, SETTINGS, (spec,), True)
    observed = executing.prepare(plan, OBSERVED)
    executing.begin(tmp_path / "run", plan, observed)
    (first,) = executing.execute(plan, observed, tmp_path / "run")  # killed before its results are written
    seen = []
    plan, observed = executing.reopen(tmp_path / "run")
    (again,) = executing.execute(plan, observed, tmp_path / "run", lambda index, row: seen.append(index))
    assert seen == [] and len(again.history["attempted"]) == len(first.history["attempted"]) < SETTINGS.rounds
    for was, now in zip(jax.tree.leaves(first.belief), jax.tree.leaves(again.belief), strict=True):
        assert np.asarray(was).tobytes() == np.asarray(now).tobytes()
    executing.finish(tmp_path / "run", plan, [again])
    loaded = jaxlfi.load(tmp_path / "run", gaussian())
    assert loaded.settings == SETTINGS and len(loaded.history["settled"]) == len(first.history["settled"])


def test_settings_from_before_runs_could_settle_make_all_rounds():
    described = settings_to_json(SETTINGS)
    del described["min_rounds"]
    assert settings_from_json(described) == SETTINGS.replace(min_rounds=0)
