"""The examples: their script makes their recordings, and truths outside the first guess are found."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import jax

import jaxlfi
from jaxlfi.envs.mujoco.least_squares import best_fits
from jaxlfi.envs.mujoco.logs import read
from jaxlfi.registry import TASKS

FOLDER = Path(__file__).parents[3] / "examples/mujoco"
NAMES = ("furuta", "arm", "puck", "finger", "shuffle", "servo")
SETTINGS = jaxlfi.QUICK.replace(
    rounds=6,
    min_rounds=6,
    simulations_per_round=60,
    simulation_budget=75,
    predictive=False,
    estimator=jaxlfi.QUICK.estimator.replace(ensemble_size=2),
)


def example(name):
    return TASKS.load(f"mujoco,config={FOLDER / name}.toml")


@pytest.mark.parametrize("name", NAMES)
def test_the_recording_is_made_by_its_script(name):
    """Compared to the digits on which processors agree: none of the motions is chaotic."""
    spec = importlib.util.spec_from_file_location("record", FOLDER / "record.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    made, kept = script.recorded(name), read(FOLDER / f"{name}.csv")
    assert set(made.signals) == set(kept.signals)
    np.testing.assert_allclose(made.times, kept.times, atol=1e-6)
    for signal, values in kept.signals.items():
        np.testing.assert_allclose(made.signals[signal], values, atol=2e-4, err_msg=signal)


@pytest.mark.parametrize("name", NAMES)
def test_one_first_guess_holds_the_truth_and_one_does_not(name):
    task = example(name)
    truth = np.asarray(task.truth)
    inside = {label: (box.low <= truth) & (truth <= box.high) for label, box in task.supports.items()}
    assert inside["right"].all() and inside["feasible"].all()
    assert not inside["initial"][0] and inside["initial"][1:].all()


@pytest.mark.slow
def test_a_damping_that_the_first_guess_leaves_out_is_found():
    task = example("furuta")
    truth = np.asarray(task.truth)
    run = jaxlfi.infer(jax.random.key(0), task, heuristic=jaxlfi.Edge(), settings=SETTINGS, polish=False)
    assert run.final_support().low[0] < truth[0]
    error = np.median(run.draws(), axis=0) / truth - 1
    np.testing.assert_array_less(np.abs(error), [0.4, 0.3, 0.1])


@pytest.mark.slow
def test_an_arm_of_a_posterior_and_a_point():
    """A heavier payload than the first guess allows; from the posterior's draws, least squares ends within 3 %."""
    task = example("arm")
    truth = np.asarray(task.truth)
    run = jaxlfi.infer(jax.random.key(1), task, heuristic=jaxlfi.Edge(), settings=SETTINGS, polish=False)
    assert run.final_support().high[0] > truth[0]
    best, *_ = best_fits(task, np.asarray(run.draws(32)), keep=2)
    np.testing.assert_allclose(best.theta, truth, rtol=0.03)
    assert ((best.interval[:, 0] < truth) & (truth < best.interval[:, 1])).sum() >= 4


def test_the_puck_has_two_points():
    """The left and right of the post are exactly alike."""
    task = example("puck")
    simulator, truth = task.simulate.function, np.asarray(task.truth, float)
    rows, outcome = simulator.clean(np.stack([truth, truth * [1, 1, -1]]))
    assert not outcome.any()
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-3)
    near = truth * np.array([[1.02, 0.97, 1.03], [0.98, 1.03, -0.97]])
    fits = best_fits(task, near, keep=2)
    assert sorted(np.sign(one.theta[2]) for one in fits) == [-1, 1]
    for one in fits:
        np.testing.assert_allclose(np.abs(one.theta), truth, rtol=0.1)


@pytest.mark.slow
def test_the_fingers_numbers_lie_along_a_ridge():
    task = example("finger")
    truth = np.asarray(task.truth, float)
    simulator = task.simulate.function
    ridge = simulator.clean(np.stack([0.7 * truth, truth, 1.5 * truth]))[0]
    across = simulator.clean((truth * [1.5, 1, 1])[None])[0][0]
    along = np.sqrt(np.mean((ridge[[0, 2]] - ridge[1]) ** 2))
    assert along < 0.01 < 0.1 < np.sqrt(np.mean((across - ridge[1]) ** 2))
    best, *_ = best_fits(task, truth[None] * 1.1, keep=1)
    deviation = np.sqrt(np.diagonal(best.covariance))
    assert (best.covariance / np.outer(deviation, deviation) > 0.9).all()
