"""Every example runs, and prints results near the truth.

All run in this process, so that what they have in common is compiled once, with fewer training steps than a reader's.
"""

import importlib.util
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
STEPS = 400


@pytest.fixture(autouse=True, scope="module")
def no_key_checker():
    """The key-reuse checker mistakes a vmapped scan over keys for a reuse (jax 0.9.2)."""
    with jax.debug_key_reuse(False):
        yield


def ran(name: str):
    """What an example's `main` returns, with a shorter training."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES[name])
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if hasattr(module, "SETTINGS"):
        module.SETTINGS = module.SETTINGS.replace(estimator=module.SETTINGS.estimator.replace(epochs=0, steps=STEPS))
    return module.main()


def far(draws, truth) -> np.ndarray:
    """How far the draws' mean is from a truth, in their standard deviations and a tenth of the truth."""
    draws, truth = np.asarray(draws), np.asarray(truth)
    return np.abs(draws.mean(0) - truth) / (draws.std(0) + 0.1 * np.abs(truth))


def near_exact(exact, draws) -> None:
    """The mean is within 0.8 standard deviations of the exact posterior's, the width 0.4 to 2.5 times its width."""
    sd = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_array_less(np.abs(np.mean(draws, axis=0) - exact.mean) / sd, 0.8)
    np.testing.assert_array_less(0.4 * sd, np.std(draws, axis=0))
    np.testing.assert_array_less(np.std(draws, axis=0), 2.5 * sd)


@pytest.mark.slow
def test_an_own_simulator_is_inferred_from_a_wrong_guess(capsys):
    draws = ran("own_simulator")
    np.testing.assert_array_less(far(draws, [6.0, 0.5]), 3.0)
    assert "stiffness" in capsys.readouterr().out


@pytest.mark.slow
def test_a_host_simulator_is_inferred(capsys):
    draws = ran("host_simulator")
    np.testing.assert_array_less(far(draws, [0.5, 0.2]), 3.0)
    assert "without an outbreak" in capsys.readouterr().out


@pytest.mark.slow
def test_an_own_heuristic_finds_the_exact_posterior():
    exact, draws = ran("own_heuristic")
    sd = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_array_less(np.abs(np.mean(draws, axis=0) - exact.mean) / sd, 2.0)


@pytest.mark.slow
def test_an_own_estimator_finds_the_exact_posterior():
    near_exact(*ran("own_estimator"))


@pytest.mark.slow
def test_a_prior_over_logarithms_gives_the_posterior_on_a_grid():
    mean, sd, draws = ran("prior_and_log")
    np.testing.assert_array_less(np.abs(np.mean(draws, axis=0) - mean) / sd, 1.5)
    np.testing.assert_array_less(np.std(draws, axis=0) / sd, 2.5)


@pytest.mark.slow
def test_an_amortised_posterior_holds_the_truths():
    held = ran("amortised")
    assert np.all(held > 0.8)


@pytest.mark.slow
def test_a_raw_series_is_enough():
    draws = ran("raw_series")
    np.testing.assert_array_less(far(draws, [4.0, 0.3]), 3.0)
    np.testing.assert_array_less(draws.std(axis=0), [0.4, 0.1])  # a quarter of the prior's


@pytest.mark.slow
def test_simulations_made_before_give_the_exact_posterior():
    near_exact(*ran("presimulated"))


@pytest.mark.slow
def test_a_loaded_run_is_the_same_and_arviz_summarises_it():
    pytest.importorskip("arviz")
    run, loaded, summary = ran("loaded_run_in_arviz")
    np.testing.assert_allclose(run.mixture.means, loaded.mixture.means, rtol=1e-5)
    assert list(summary.index) == ["first", "second"]


def test_a_driver_is_controlled_within_its_limits():
    log = ran("robot_driver")
    assert log.stopped == "" and log.over == 7 and log.missed == 0  # 3 cm a step from 0.40 to 0.60 m
    np.testing.assert_allclose(log.targets[[0, 5, 15], 0], [0.43, 0.58, 0.60])
    np.testing.assert_allclose(log.observations[1:, 0], log.targets[:, 0], rtol=1e-6)


def test_a_robot_of_four_methods_is_driven_to_where_its_policy_leads():
    log = ran("any_robot")
    assert log.stopped == "" and log.missed == 0 and len(log.targets) == 150
    assert log.observations[0, 0] > 0.79 and abs(log.observations[-1, 0]) < 0.01
    assert np.abs(log.targets).max() == 0.008 and np.abs(np.diff(log.targets[:, 0])).max() <= 0.5 * 0.02 + 1e-12


def test_every_example_has_a_test():
    source = Path(__file__).read_text()
    assert EXAMPLES and all(f'ran("{name}")' in source for name in EXAMPLES)
