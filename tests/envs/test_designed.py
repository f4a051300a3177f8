"""Built-in tasks with experiments to choose: they simulate what their designs say."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from jaxlfi.envs import mg1_repetitions
from jaxlfi.envs.lotka_volterra import designed
from jaxlfi.tasks.experiments import at
from jaxlfi.tasks.simulation import simulate


def test_counts_are_those_of_the_equations():
    r = designed.TRUTH
    slope = lambda t, s: [r[0] * s[0] * s[1] - r[1] * s[0], r[2] * s[1] - r[3] * s[0] * s[1]]
    times = np.array([3.3, 31.9, 77.7])
    exact = solve_ivp(slope, (0, 100), [20.0, 30.0], t_eval=times, rtol=1e-9, atol=1e-9).y.T
    found = designed.log_counts(jnp.asarray(r), jnp.array([20.0, 30.0]), jnp.asarray(times))
    np.testing.assert_allclose(found, np.log(exact), atol=0.1 * designed.NOISE)


def test_the_order_of_times_makes_no_difference():
    task, theta = designed.times(), designed.times().inference.truth[None]
    once, again = (
        simulate(jax.random.key(0), at(task, order), theta)[0] for order in (np.arange(10.0), np.arange(9.0, -1.0, -1))
    )
    np.testing.assert_allclose(once, again)


def test_repetitions_of_a_queue_cost_the_same():
    task = mg1_repetitions.task()
    theta = jnp.asarray(task.truth)
    for jobs, served, begun in ((60, 60, 1), (1, 15, 15), (10, 40, 4)):
        times, kind = at(task, [jobs]).simulate(jax.random.key(1), theta)
        assert (int((kind > 0).sum()), int((kind > 1).sum())) == (served, begun)
        assert begun * mg1_repetitions.SETUP + served <= mg1_repetitions.COST + mg1_repetitions.SETUP
        assert (np.asarray(times)[np.asarray(kind) > 0] >= theta[0]).all()


def test_summaries_of_a_queue_are_percentiles():
    task = mg1_repetitions.task()
    times, kind = trajectory = at(task, [7.0]).simulate(jax.random.key(1), jnp.asarray(task.truth))
    own = np.asarray(times)[np.asarray(kind) > 0]
    expected = [*np.percentile(own, [0, 25, 50, 75, 100]), np.asarray(times)[np.asarray(kind) > 1].mean()]
    np.testing.assert_allclose(task.summary(trajectory), expected, rtol=1e-5)


def test_jobs_of_a_queue_that_is_empty_come_after_a_gap_and_a_service():
    """One job at a time: the mean time is 1 / rate + min + width / 2."""
    task = at(mg1_repetitions.task(), [1.0])
    times, kind = jax.vmap(task.simulate, (0, None))(
        jax.random.split(jax.random.key(0), 4000), jnp.asarray(task.truth)
    ).swapaxes(0, 1)
    mean = float(times.sum() / (kind > 0).sum())
    assert abs(mean - (5.0 + 1.0 + 2.0)) < 0.1  # standard error 0.02
