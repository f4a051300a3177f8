"""infer: the library call, its purity, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi import Support
from jaxlfi.heuristics import Edge, Fixed
from jaxlfi.io import files as atomic
from jaxlfi.runs import inference
from jaxlfi.runs.folder import read_belief
from jaxlfi.tasks.observation import SimulatorError
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, settings, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([0.8, -0.6], np.float32)


def infer(key=0, task=None, observation=OBSERVED, **arguments):
    """`jaxlfi.infer` with the small settings."""
    arguments = {"support": "misspecified", "settings": SETTINGS} | arguments
    return jaxlfi.infer(jax.random.key(key), task or gaussian(), observation, **arguments)


def test_a_second_call_does_not_compile_again():
    infer(0)
    before = inference._run._cache_size()
    infer(1, heuristic=Edge(mass_threshold=0.3), observation=OBSERVED + 1)
    infer(2, support=Support([-2.0, -2.0], [1.0, 1.0]))
    assert inference._run._cache_size() == before


def test_vmap_over_anything_equals_a_loop():
    edges = [Edge(mass_threshold=tau) for tau in (0.005, 0.2, 0.9)]
    observations = OBSERVED + np.array([[0.0], [0.5], [1.0]], np.float32)
    low = np.array([[-3.0, -3.0], [-2.0, -2.0], [-1.0, -3.0]], np.float32)
    high = jnp.array([0.0, 3.0])
    together = jax.vmap(lambda h, o, low: infer(heuristic=h, observation=o, support=Support(low, high)))(
        jaxlfi.stack(edges), jnp.asarray(observations), jnp.asarray(low)
    )
    for i, edge in enumerate(edges):
        alone = infer(heuristic=edge, observation=observations[i], support=Support(low[i], np.asarray(high)))
        for a, b in zip(jax.tree.leaves(together.belief), jax.tree.leaves(alone.belief), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=2e-3, atol=2e-3)


def test_the_command_line_and_the_library_agree(tmp_path):
    assert command("infer", TASK, "--support", "misspecified", *FLAGS, "--out", tmp_path / "cli") == 0
    run = infer(0, observation=None)
    theirs = read_belief(tmp_path / "cli")
    for a, b in zip(jax.tree.leaves(run.belief), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-3)
    run.save(tmp_path / "library")
    files = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("cli", "library")]
    assert files[0] == files[1]
    for name in ("posterior.npz", "dataset.npz", "history.npz", "observation.npz"):
        ours, same = (atomic.read_arrays(tmp_path / folder / name) for folder in ("library", "cli"))
        assert {key: value.shape for key, value in ours.items()} == {key: value.shape for key, value in same.items()}
    history, same = (atomic.read_arrays(tmp_path / folder / "history.npz") for folder in ("library", "cli"))
    # The two programs round differently, and a draw on the edge between two components may fall to either.
    near = np.isclose(history["sample_theta"], same["sample_theta"], rtol=5e-3, atol=5e-3).all(axis=-1)
    assert np.mean(near) > 0.9
    assert command("resume", tmp_path / "library") == 0  # complete: nothing to do
    with pytest.raises(ValueError, match="holds something"):
        run.save(tmp_path / "library")


def test_draws_lie_in_the_support():
    run = infer(heuristic=Fixed(), support="ok")
    draws = run.sample(jax.random.key(1), 500)
    assert draws.shape == (500, 2) and bool(run.belief.support.contains(draws).all())


def test_a_fixed_support_that_is_wrong_warns():
    # Hardly trained, the posterior is nearly as wide as Phi: far wider than this support.
    narrow = Support([-0.2, -0.2], [0.2, 0.2])
    with pytest.warns(jaxlfi.SupportWarning, match="first: .* upper bound 0.2"):
        run = infer(support=narrow, heuristic=Fixed())
    assert any("widen the support" in text for text in run.warnings)


def test_without_an_observation_one_is_simulated_at_the_truth():
    a, b, c = infer(0, observation=None), infer(0, observation=None), infer(1, observation=None)
    np.testing.assert_array_equal(a.observed, b.observed)
    assert not np.allclose(a.observed, c.observed)
    fixed = dataclasses.replace(gaussian(), observation=OBSERVED)
    np.testing.assert_array_equal(infer(0, fixed, observation=None).observed, OBSERVED)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"observation": np.zeros(3)},
            r"observation: expected the shape the simulator produces, \[2\], got \[3\]",
        ),
        ({"observation": np.array([np.nan, 0])}, "observation: expected finite"),
        ({"support": "unknown"}, "support: expected one of"),
        ({"support": Support([0.0], [1.0])}, "support: expected bounds for 2 parameters, got 1"),
        ({"support": Support([0.0, 0.0], [1.0, 11.0])}, "inside the feasible domain Phi"),
        ({"heuristic": "edge"}, "heuristic: expected an instance such as"),
        ({"heuristic": Edge(expansion=np.ones(3))}, r"scalars or 2 values, got shape \(3,\)"),
        ({"settings": settings(simulation_budget=5)}, "attempts: expected at least"),
        (
            {"task": dataclasses.replace(gaussian(), truth=None), "observation": None},
            "observation: expected one",
        ),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        infer(**arguments)


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda key, theta: np.asarray(theta), "JAX can trace"),
        (lambda key, theta: theta[0], r"expected one array"),
        (lambda key, theta: (theta, theta, theta), r"expected one array"),
        (lambda key, theta: (theta, theta > 0), "expected a scalar outcome"),
        (lambda key, theta: (theta, False), r"got none \(failed: 25, non_finite: 0\)"),
    ],
)
def test_a_simulator_that_breaks_its_contract_is_told(simulate, message):
    with pytest.raises(SimulatorError, match=message):
        infer(task=dataclasses.replace(gaussian(), simulate=simulate, summary=lambda trajectory: trajectory))
