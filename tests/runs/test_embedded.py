"""Runs on raw observations, by an embedding: saved, loaded, gone on with, and refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.cli import commands
from jaxlfi.envs.gaussian_linear import posterior
from jaxlfi.registry import TASKS
from jaxlfi.tasks import summaries
from jaxlfi.tasks.trials import repeated
from tests.small import command, gaussian, settings, whole_runs  # noqa: F401

BOX = jaxlfi.Support([-1.0, 0.5], [1.0, 2.0])
TRUTH = np.array([0.4, 1.2])


def simulate(key, theta):
    """Nine records of two channels of different size."""
    place, spread = theta
    return jnp.array([1.0, 30.0]) * (place + spread * jax.random.normal(key, (9, 2)))


TASK = jaxlfi.Task(simulate, ("place", "spread"), {"own": BOX}, BOX, truth=TRUTH, name="own")
FLOW = jaxlfi.MaskedFlow(
    hidden=(6,), transforms=1, components=2, epochs=0, steps=50, batch_size=10, embedding="series", features=3
)
SERIES = settings(estimator=FLOW, predictive=False)
"""A flow: its network is kept in the folder, and read from there."""


class Killed(BaseException):
    """The process dies here."""


def die(index, row):
    raise Killed


@pytest.mark.slow
def test_a_run_on_a_raw_series_goes_on_to_the_same_bits_and_is_loaded_without_its_task(tmp_path):
    key = jax.random.key(4)
    infer = lambda **more: jaxlfi.infer(key, TASK, heuristic=jaxlfi.Fixed(), settings=SERIES, **more)
    run = infer(out=tmp_path / "whole")
    with pytest.raises(Killed):
        infer(out=tmp_path / "killed", callback=die)
    resumed = infer(out=tmp_path / "killed")
    loaded = jaxlfi.load(tmp_path / "whole")
    assert loaded.task is None and run.network.estimator.record_size == loaded.network.estimator.record_size == 2
    assert loaded.settings == SERIES  # as they were given: 0, the task's
    for other in (resumed, loaded):
        jax.tree.map(np.testing.assert_array_equal, other.network, run.network)
        np.testing.assert_array_equal(other.posterior.log_prob(TRUTH), run.posterior.log_prob(TRUTH))
    mean = np.asarray(run.network.normaliser.mean)
    np.testing.assert_array_equal(mean, np.tile(mean[:2], 9))


def test_a_traced_run_reads_the_same_records():
    traced = lambda key: jaxlfi.infer(key, TASK, settings=SERIES).network
    assert jax.eval_shape(traced, jax.random.key(0)).estimator.record_size == 2


def test_a_series_of_other_channels_is_refused_before_anything_is_simulated(tmp_path):
    wrong = SERIES.replace(estimator=FLOW.replace(record_size=4))
    said = r"^record_size: expected a divisor of the summary's 18 numbers, got 4"
    with pytest.raises(ValueError, match=f"{said}$"):
        jaxlfi.infer(jax.random.key(0), TASK, settings=wrong, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match=said):
        jax.eval_shape(lambda key: jaxlfi.infer(key, TASK, settings=wrong).belief, jax.random.key(0))


def test_the_command_line_says_so_in_one_line(tmp_path, capsys):
    words = ("--embedding", "series", "--record-size", "3", "--out", tmp_path / "run")
    assert command("infer", "gaussian_linear", *words) == 2
    assert "record_size: expected a divisor of the summary's 2 numbers, got 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("task", "embedding", "asked"),
    [
        ("own:task", "trials", "own:task,trials=2,pooling=all"),
        ("own:task,pooling=mean", "trials", "own:task,pooling=mean,trials=2"),
        ("own:task", "series", "own:task,trials=2"),
    ],
)
def test_files_of_several_trials_are_pooled_by_the_embedding_of_trials(task, embedding, asked, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setitem(commands.COMMANDS, "infer", lambda arguments, console: seen.append(arguments.task))
    command("infer", task, "--observation", "a.csv", "b.csv", "--embedding", embedding, "--out", tmp_path / "run")
    assert seen == [asked]


def test_layouts_are_the_shapes_that_summaries_flatten():
    own, shape = lambda trajectory: trajectory[0], (12, 3)
    assert summaries.layout(summaries.identity, shape, 36) == (12, 3)
    assert summaries.layout(summaries.identity, (12,), 12) == (12, 1)
    assert summaries.layout(own, shape, 3) == (3, 1)
    for task, expected in ((TASK, (2, 9, 2)), (gaussian(), (2, 2, 1))):
        both = repeated(task, 2, "all")
        trajectory = jax.eval_shape(both.simulate, jax.random.key(0), jnp.asarray(task.truth))
        trajectory = trajectory[0] if isinstance(trajectory, tuple) else trajectory
        assert summaries.layout(both.summary, trajectory.shape, int(np.prod(expected))) == expected
    assert summaries.layout(repeated(TASK, 2).summary, (18, 2), 36) == (36, 1)


def test_all_trials_summaries_lie_one_after_another(key):
    task = jaxlfi.Task(simulate, TASK.names, {"own": BOX}, BOX, summary=lambda t: t[-1], summary_names=("a", "b"))
    both = repeated(task, 3, "all")
    trials = np.asarray(jax.random.normal(key, (3, 9, 2)))
    np.testing.assert_array_equal(both.summary(jnp.asarray(trials.reshape(27, 2))), trials[:, -1].ravel())
    assert both.named_summaries(6)[1:3] == ("b of trial 1", "a of trial 2")
    assert both.settings == {"embedding": "trials"} and both == repeated(task, 3, "all") != repeated(task, 3)
    assert TASKS.load("gaussian_linear,trials=3,pooling=all") == repeated(TASKS.load("gaussian_linear"), 3, "all")


@pytest.mark.slow
def test_the_posterior_of_four_trials_is_found_without_a_word_on_how_to_pool_them():
    trials = np.array([[1.3, -0.2], [0.6, -0.9], [0.9, -0.6], [1.1, 0.1]], np.float32)
    network = settings().estimator.replace(
        hidden=(32,), components=1, embedding="trials", features=4, learning_rate=3e-3, steps=1500, batch_size=100
    )
    numbers = settings(estimator=network, rounds=1, simulations_per_round=2000, simulation_budget=2000)
    numbers = numbers.replace(predictive=False)
    run = jaxlfi.infer(
        jax.random.key(6), gaussian(), list(trials), support="ok", heuristic=jaxlfi.Fixed(), settings=numbers
    )
    exact = posterior(trials.mean(axis=0))
    deviation = np.sqrt(np.diag(np.asarray(exact.covariance)) / 4)
    found = run.posterior.mixture
    np.testing.assert_allclose(found.mean, exact.mean, atol=1.5 * deviation.min())
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), deviation, rtol=0.35)
    assert run.task == repeated(gaussian(), 4, "all") and run.network.estimator.record_size == 2
    swapped = run.posterior_of(run.x.reshape(4, 2)[::-1].ravel()).mixture
    np.testing.assert_allclose(swapped.mean, found.mean, atol=1e-4)
