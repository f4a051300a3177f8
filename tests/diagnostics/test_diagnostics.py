"""Discrepancies: distances in closed form, failures, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.diagnostics import (
    POSTERIOR_SAMPLES,
    channel_errors,
    compared,
    discrepancy,
    not_simulated,
    trajectory_distance,
)
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import truncated
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

compare = jax.jit(discrepancy, static_argnames="task")
BOX = Support([0.0, -2.0], [4.0, 6.0])
PHI = Support([-10.0, -2.0], [10.0, 10.0])
DRAWN = 50
"""Number of draws in a program."""


def belief(means=((1.0, 0.0), (3.5, 1.0)), scales=((0.5, 1.0), (0.4, 0.3)), logits=(0.0, 1.0), box=BOX) -> Belief:
    tril = np.stack([np.diag(np.float32(each)) for each in scales])
    mixture = GaussianMixture(jnp.asarray(logits), jnp.asarray(means), jnp.asarray(tril))
    return Belief(mixture, box, jnp.asarray(True))


def task(simulate=lambda key, theta: theta, **changes) -> Task:
    arguments = {"names": ("mass", "drag"), "supports": {"guess": BOX}, "feasible": PHI, "truth": [1.0, 2.0]}
    return Task(simulate, **(arguments | changes))


def draws(key, task: Task, belief: Belief, n: int) -> np.ndarray:
    """Draws of a belief's posterior, in inference space: the first n of `DRAWN`."""
    posterior = truncated(belief.mixture, belief.mixture, belief.support, task.space)
    return np.asarray(posterior.sample(key, DRAWN, space="inference"))[:n]


def see(key, task: Task, belief: Belief, observed, n: int = POSTERIOR_SAMPLES):
    """The discrepancy of a belief."""
    key_draw, key_simulate = jax.random.split(key)
    return jax.device_get(compare(key_simulate, task, draws(key_draw, task, belief, n), observed))


# ------------------------------------------------------------------------------------------------ distances


def test_trajectory_distance_in_closed_form():
    """Channels of unlike spread: an offset of one spread in each is a distance of one."""
    observed = jnp.array([[0.0, 100.0], [2.0, 300.0], [4.0, 500.0]])
    spread = np.std(np.asarray(observed), axis=0)
    assert float(trajectory_distance(observed, observed)) == 0
    np.testing.assert_allclose(trajectory_distance(observed + spread, observed), 1, rtol=1e-6)
    off = observed.at[1, 0].add(3.0).at[2, 1].add(-50.0)
    expected = np.sqrt(((3 / spread[0]) ** 2 + (50 / spread[1]) ** 2) / 6)
    np.testing.assert_allclose(trajectory_distance(off, observed), expected, rtol=1e-6)
    # Units of measurement do not matter.
    units = jnp.array([1000.0, 1e-3])
    np.testing.assert_allclose(trajectory_distance(units * off, units * observed), expected, rtol=1e-5)


def test_the_mean_of_the_observed_trajectory_is_one_away():
    observed = jnp.asarray(np.random.default_rng(0).normal(5, 3, (20, 2)), jnp.float32)
    mean = jnp.broadcast_to(observed.mean(0), observed.shape)
    np.testing.assert_allclose(trajectory_distance(mean, observed), 1, rtol=1e-5)


def test_a_constant_channel_is_not_divided_by_zero():
    observed = jnp.stack([jnp.ones(4), jnp.arange(4.0)], axis=1)
    np.testing.assert_allclose(trajectory_distance(observed.at[:, 0].add(2.0), observed), np.sqrt(2.0), rtol=1e-6)


def test_trajectories_of_one_channel_may_be_vectors():
    observed = jnp.array([1.0, 2.0, 4.0])
    expected = trajectory_distance((observed + 1)[:, None], observed[:, None])
    np.testing.assert_allclose(trajectory_distance(observed + 1, observed), expected)


# -------------------------------------------------------------------------------------------- discrepancies


def moving(key, theta):
    """A trajectory of five records and two channels; it fails for small theta_1."""
    return jnp.outer(jnp.arange(5.0), theta), theta[0] > 1.0


def test_discrepancy_shapes_and_failures(key):
    observed = np.outer(np.arange(5, dtype=np.float32), np.float32([1.0, 2.0]))
    seen = see(key, task(moving), belief(), observed, n=50)
    assert seen.theta.shape == (50, 2) and seen.trajectory.shape == (50, 5, 2)
    assert bool(BOX.contains(seen.theta).all())
    np.testing.assert_allclose(seen.theta_error, np.abs(np.asarray(seen.theta) - [1.0, 2.0]), rtol=1e-5, atol=1e-6)
    failed = np.asarray(seen.theta[:, 0] <= 1.0)
    assert 0 < failed.sum() < 50
    np.testing.assert_array_equal(np.isnan(seen.trajectory_error), failed)
    ok = int(np.flatnonzero(~failed)[0])
    np.testing.assert_allclose(seen.trajectory_error[ok], trajectory_distance(seen.trajectory[ok], observed), rtol=1e-5)


def test_a_channel_at_rest_does_not_dominate_the_trajectory_error(key):
    """A cube that moves by 0.0007 where the detector errs by 0.005, as the simulations do."""
    rng = np.random.default_rng(0)
    observed = np.stack([np.sin(np.arange(16.0)), 0.5 + 0.0007 * rng.normal(size=16)], axis=1).astype(np.float32)
    simulated = observed + np.float32([0.05, 0.005]) * np.resize([-1, 1], 16)[:, None]
    plain, noise = channel_errors(simulated, observed), np.float32([0.0, 0.005])
    assert plain[1] > 5 > 0.1 > plain[0] > 0.05
    own = channel_errors(simulated, observed, noise)
    np.testing.assert_allclose(own, [plain[0], 1.0], rtol=1e-4)
    distance = trajectory_distance(simulated, observed, noise)
    assert distance == pytest.approx(np.sqrt(np.mean(np.square(own))), rel=1e-5) and distance < 0.8
    # And so it is for a task that knows its noise.
    known = task(lambda key, theta: jnp.asarray(simulated), channel_noise=noise)
    np.testing.assert_allclose(see(key, known, belief(), observed, n=3).trajectory_error, distance, rtol=1e-5)
    with pytest.raises(ValueError, match="channel_noise: expected standard deviations of at least 0"):
        task(moving, channel_noise=[-1.0, 0.0])


def test_summaries_are_those_of_the_trajectories_and_nan_where_there_are_none(key):
    """The first that fail have a trajectory too, and one that is finite can have a summary that is not."""

    def total(trajectory):
        return jnp.append(jnp.sum(trajectory, axis=0), jnp.where(trajectory[1, 0] > 3.0, jnp.inf, 7.0))

    seen = see(key, task(moving, summary=total), belief(), jnp.zeros((5, 2)), n=50)
    usable = np.asarray((seen.theta[:, 0] > 1.0) & (seen.theta[:, 0] <= 3.0))
    assert 0 < usable.sum() < np.sum(seen.theta[:, 0] > 1.0) < 50
    expected = np.column_stack([10 * np.asarray(seen.theta), np.full(50, 7.0)])
    np.testing.assert_allclose(seen.x[usable], expected[usable], rtol=1e-5)
    assert np.isnan(seen.x[~usable]).all() and seen.x.shape == (50, 3)


def test_summaries_of_a_host_simulator(key):
    def simulate(rng, theta):
        return np.arange(5.0)[:, None] * theta[:, None], theta[:, 0] > 1.0

    problem = task(jaxlfi.HostSimulator(simulate), summary=lambda trajectory: jnp.sum(trajectory, axis=0))
    theta = jnp.asarray(np.random.default_rng(0).uniform(0, 3, (20, 2)), jnp.float32)
    seen = compared(problem, theta, *simulate_batch(key, problem, theta, (5, 2)), jnp.zeros((5, 2)))
    failed = np.asarray(theta[:, 0] <= 1.0)
    assert seen.x.shape == (20, 2) and 0 < failed.sum() < 20
    np.testing.assert_allclose(seen.x[~failed], 10 * seen.theta[~failed], rtol=1e-5)
    assert bool(jnp.isnan(seen.x[failed]).all()) and bool(jnp.isnan(seen.trajectory_error[failed]).all())
    assert bool(jnp.isfinite(seen.trajectory_error[~failed]).all()) and int(seen.simulated) == 20


def test_trajectories_that_are_not_finite_have_no_distance(key):
    broken = lambda key, theta: jnp.where(theta[0] > 1.0, jnp.nan, 1.0) * jnp.outer(jnp.arange(5.0), theta)
    seen = see(key, task(broken), belief(), jnp.ones((5, 2)))
    assert seen.theta.shape == (20, 2)  # section V: twenty posterior samples
    np.testing.assert_array_equal(np.isnan(seen.trajectory_error), np.asarray(seen.theta[:, 0] > 1.0))
    assert bool(jnp.isfinite(seen.theta_error).all())


def test_without_a_truth_parameters_have_no_error(key):
    seen = see(key, task(truth=None), belief(), jnp.array([1.0, 2.0]), n=3)
    assert seen.theta_error.shape == (3, 2) and bool(jnp.isnan(seen.theta_error).all())
    assert bool(jnp.isfinite(seen.trajectory_error).all())


def test_errors_are_in_inference_space_and_trajectories_in_natural_units(key):
    log_task = task(
        log=("drag",),
        supports={"guess": Support([0.0, 0.5], [4.0, 6.0])},
        feasible=Support([-10.0, 0.1], [10.0, 10.0]),
    )
    seen = see(key, log_task, belief(box=log_task.support()), jnp.array([1.0, 2.0]), n=4)
    np.testing.assert_allclose(seen.trajectory[:, 1], np.exp(seen.theta[:, 1]), rtol=1e-5)
    np.testing.assert_allclose(seen.theta_error[:, 1], np.abs(seen.theta[:, 1] - np.log(2.0)), rtol=1e-4, atol=1e-6)


def test_without_simulations_only_the_truth_is_compared_with(key):
    theta, observed = draws(key, task(), belief(), 6), np.outer(np.arange(5), [1.0, 2.0]).astype(np.float32)
    seen = not_simulated(task(moving), jnp.asarray(theta), jnp.asarray(observed), obs=3)
    np.testing.assert_allclose(seen.theta_error, np.abs(np.asarray(theta) - [1.0, 2.0]), rtol=1e-5, atol=1e-6)
    assert (seen.trajectory_error.shape, seen.trajectory.shape, seen.x.shape) == ((6,), (6, 5, 2), (6, 3))
    for unknown in (seen.trajectory_error, seen.trajectory, seen.x):
        assert bool(jnp.isnan(unknown).all())
    assert int(seen.simulated) == 0


@pytest.mark.slow
def test_draws_outside_of_the_box_are_neither_kept_nor_moved_to_its_bound(key):
    """Nearly all of the mixture lies above the box."""
    far = belief(means=((1.0, 20.0), (1.0, 20.0)))
    theta = see(key, task(), far, jnp.array([1.0, 2.0]), n=10).theta
    assert (np.asarray(theta[:, 1]) < 6.0).all() and bool(BOX.contains(theta).all())
