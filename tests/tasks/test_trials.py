"""Several observations of the same parameters: simulated, summarised and inferred together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.distributions.support import Support
from jaxlfi.envs.gaussian_linear import posterior
from jaxlfi.registry import TASKS
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.observation import read_for, simulator_shapes, trials_of
from jaxlfi.tasks.simulation import simulate_batch, trajectory_and_outcome
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated, together
from tests.small import TASK, command, gaussian, settings, whole_runs  # noqa: F401

BOX = Support([-1.0, -1.0], [1.0, 1.0])


def series_task(simulate, **more) -> Task:
    return Task(simulate, ("a", "b"), {"own": BOX}, BOX, failures=("slow", "fell"), **more)


def noisy(key, theta):
    """Five records of two channels; the second channel is wider."""
    return theta + jnp.array([0.1, 3.0]) * jax.random.normal(key, (5, 2))


def last(trajectory):
    """Two numbers that are not symmetric in the records."""
    return jnp.stack([trajectory[-1, 0], jnp.sum(trajectory[:, 1])])


def test_the_summary_of_trials_against_numpy(key):
    task = series_task(noisy, summary=last, summary_names=("end", "sum"))
    trials = np.asarray(jax.random.normal(key, (3, 5, 2)))
    each = np.array([[trial[-1, 0], trial[:, 1].sum()] for trial in trials], np.float64)
    pooled = repeated(task, 3)
    found = pooled.summary(jnp.asarray(together(list(trials))))
    np.testing.assert_allclose(found, [*each.mean(axis=0), *each.std(axis=0, ddof=1)], rtol=1e-4, atol=1e-5)
    swapped = pooled.summary(jnp.asarray(together(trials[[2, 0, 1]])))
    np.testing.assert_allclose(swapped, found, rtol=1e-5, atol=1e-6)
    assert pooled.named_summaries(4) == ("mean of end", "mean of sum", "sd of end", "sd of sum")
    means = repeated(task, 3, "mean").summary(jnp.asarray(together(list(trials))))
    np.testing.assert_allclose(means, each.mean(axis=0), rtol=1e-5, atol=1e-6)


def test_one_trial_is_the_task_itself():
    assert repeated(gaussian(), 1) is gaussian()
    assert repeated(gaussian(), 3) == repeated(gaussian(), 3) != repeated(gaussian(), 2)


def test_trials_have_noise_of_their_own(key):
    task = repeated(series_task(noisy, summary=last), 400)
    trajectory, failure = jax.jit(lambda key: trajectory_and_outcome(task, key, jnp.array([0.5, -0.5])))(key)
    ends = np.asarray(trajectory).reshape(400, 5, 2)[:, -1]
    assert trajectory.shape == (2000, 2) and int(failure) == 0
    np.testing.assert_allclose(ends.mean(axis=0), [0.5, -0.5], atol=5 * 3.0 / 20)  # five standard errors
    np.testing.assert_allclose(ends.std(axis=0), [0.1, 3.0], rtol=0.2)


def test_a_simulation_fails_as_its_first_failing_trial(key):
    def failing(key, theta):
        number = jax.random.uniform(key)
        return theta, jnp.where(number < 0.2, 1, jnp.where(number < 0.4, 2, 0))

    task = repeated(series_task(failing), 3)
    _, _, failure = simulate_batch(key, task, jnp.zeros((2000, 2)), simulator_shapes(task).trajectory)
    # A success needs three, each of probability 0.6; the reasons are equally likely. Five standard errors.
    np.testing.assert_allclose(np.mean(failure == 0), 0.6**3, atol=5 * np.sqrt(0.2 / 2000))
    np.testing.assert_allclose(np.mean(failure == 1), np.mean(failure == 2), atol=5 * np.sqrt(0.8 / 2000))


def test_a_host_simulator_makes_all_trials_in_one_call():
    called = []

    def function(rng, theta):
        called.append(len(theta))
        return theta[:, None] + rng.normal(size=(len(theta), 4, 1)), np.arange(len(theta)) % 3

    task = repeated(series_task(HostSimulator(function)), 2)
    trajectory, outcome = task.simulate.batch(jax.random.key(0), np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]))
    assert called == [6] and trajectory.shape == (3, 8, 2)
    assert outcome.tolist() == [1, 2, 1]  # of the codes 0 1, 2 0, 1 2
    between = trajectory[:, :, 1] - trajectory[:, :, 0]  # the noise is common to both channels
    np.testing.assert_allclose(between, 0.1 * np.ones((3, 8)), atol=1e-6)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: repeated(gaussian(), 0), "trials: expected a whole number from 1 to 1000, got 0"),
        (
            lambda: repeated(gaussian(), 2, "median"),
            r"pooling: expected one of \['all', 'mean', 'moments'\], got 'median'",
        ),
        (
            lambda: together([np.zeros((3, 2)), np.zeros((5, 2))], 4),
            "observation: expected trials of at most 4 records each, got one of 5",
        ),
        (lambda: TASKS.load(f"{TASK},trials=two"), "trials: expected a value of type int, got 'two'"),
        (
            lambda: together([np.zeros((3, 2)), np.zeros((3, 1))]),
            r"observation: expected trials of one shape .*\[3, 1\], \[3, 2\]",
        ),
    ],
)
def test_what_is_refused(call, said):
    with pytest.raises(ValueError, match=said):
        call()


def test_a_list_of_trajectories_is_of_trials_and_a_nested_list_is_one():
    one = [0.5, -0.5]
    assert trials_of(gaussian(), one)[0] is gaussian()
    task, observed = trials_of(gaussian(), [np.array(one), np.array([0.1, 0.2])])
    assert task == repeated(gaussian(), 2)
    np.testing.assert_allclose(observed, [0.5, -0.5, 0.1, 0.2])
    table = series_task(noisy)
    assert trials_of(table, [[0.0, 1.0]] * 5)[0] is table
    assert trials_of(table, [[[0.0, 1.0]] * 5] * 2)[0] == repeated(table, 2)


def test_files_of_trials_lie_one_after_another(tmp_path):
    for name, value in (("a", 1.0), ("b", 2.0)):
        np.savetxt(tmp_path / f"{name}.csv", np.full((2, 1), value), header="x", comments="")
    observed = read_for(repeated(gaussian(), 2), tmp_path / "a.csv", tmp_path / "b.csv")
    np.testing.assert_allclose(observed, [1.0, 1.0, 2.0, 2.0])


@pytest.mark.slow
def test_the_posterior_of_four_trials_in_closed_form(key):
    """A network that learns from the mean of four observations finds half the standard deviation of one's posterior."""
    trials = np.array([[1.3, -0.2], [0.6, -0.9], [0.9, -0.6], [1.1, 0.1]], np.float32)
    network = settings().estimator.replace(hidden=(32, 32), steps=1500, batch_size=100, components=1)
    numbers = settings(estimator=network, rounds=1, simulations_per_round=2000, simulation_budget=2000)
    run = jaxlfi.infer(key, gaussian(), list(trials), support="ok", heuristic=jaxlfi.Fixed(), settings=numbers)
    exact = posterior(trials.mean(axis=0))
    deviation = np.sqrt(np.diag(np.asarray(exact.covariance)) / 4)
    found = run.posterior.mixture
    np.testing.assert_allclose(found.mean, exact.mean, atol=0.8 * deviation.min())
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), deviation, rtol=0.35)
    assert run.observed.shape == (8,) and run.task == repeated(gaussian(), 4)


@pytest.mark.slow
def test_the_command_line_takes_several_files_and_the_run_is_loaded_again(tmp_path):
    for number in range(2):
        np.savez(tmp_path / f"{number}.npz", trajectory=np.array([0.5 + number, -0.5]))
    files = [str(tmp_path / f"{number}.npz") for number in range(2)]
    flags = "--hidden 16 --steps 100 --rounds 2 --simulations-per-round 20 --simulation-budget 25 --no-figures".split()
    out = tmp_path / "run"
    assert command("infer", "gaussian_linear", "--observation", *files, *flags, "--out", out) == 0
    run = jaxlfi.load(out)
    np.testing.assert_allclose(run.observed, [0.5, -0.5, 1.5, -0.5])
    assert run.task == repeated(TASKS.load("gaussian_linear"), 2)
    assert command("infer", f"{TASK},trials=3", "--observation", *files, *flags, "--out", tmp_path / "other") == 2
