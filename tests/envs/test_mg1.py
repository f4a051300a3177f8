"""The M/G/1 queue against an event-by-event oracle, queueing theory and published numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import mg1 as oracle
from scipy import stats

from jaxlfi.diagnostics import trajectory_distance
from jaxlfi.envs.mg1 import (
    FEASIBLE,
    ORDERS,
    PERCENTILES,
    RATE_FLOOR,
    SUPPORTS,
    WHITENINGS,
    draw_jobs,
    interdeparture_times,
    pca,
    percentiles_of,
    pilot,
    task,
    waiting_times,
    zscore,
)
from jaxlfi.tasks.simulation import simulate

TRUTH = np.array([1.0, 5.0, 0.2])


@functools.cache
def batched(jobs: int, floor: float = RATE_FLOOR):
    """Service times, gaps, waits and inter-departure times of one queue for each key and theta."""

    def one(key, theta):
        service, gaps = draw_jobs(key, theta, jobs, floor)
        return service, gaps, waiting_times(service, gaps), interdeparture_times(service, gaps)

    return jax.jit(jax.vmap(one))


def queues(key, theta, count: int, jobs: int = 50):
    """The same theta many times over; float64 NumPy arrays [count, jobs]."""
    theta = jnp.broadcast_to(jnp.asarray(theta, jnp.float32), (count, 3))
    return [np.asarray(part, np.float64) for part in batched(jobs)(jax.random.split(key, count), theta)]


# -------------------------------------------------------------------------------------------------- the queue


# Idle most of the time, in balance, saturated, at the slowest rate there is, and with bounds that coincide.
LOADS = [(1.0, 5.0, 0.2), (5.0, 1.0, 0.2), (4.0, 9.0, 0.35), (2.0, 3.0, 0.02), (0.0, 20.0, 0.0), (3.0, 3.0, 0.33)]


def test_the_queue_against_events_one_by_one(key):
    """Same service and arrival times in, same waits and departures out."""
    waited, idled = 0, 0
    for theta in LOADS:
        key, key_queues = jax.random.split(key)
        for service, gaps, waits, idts in zip(*queues(key_queues, theta, 20), strict=True):
            expected_idts, expected_waits = oracle.run_queue(service, gaps)
            np.testing.assert_allclose(waits, expected_waits, rtol=1e-5, atol=2e-4)
            np.testing.assert_allclose(idts, expected_idts, rtol=1e-5, atol=2e-4)
            assert (idts >= service).all()
            waited += np.sum(expected_waits > 0)
            idled += np.sum(expected_idts > service + 1e-3)
    assert waited > 1000 and idled > 1000


@pytest.mark.parametrize(
    ("service", "gaps", "waits", "idts"),
    [
        ([2.0], [3.0], [0.0], [5.0]),
        ([2.0, 1.0, 4.0], [1.0, 0.5, 10.0], [0.0, 1.5, 0.0], [3.0, 1.0, 11.5]),
        ([2.0, 1.0], [0.0, 2.0], [0.0, 0.0], [2.0, 1.0]),  # the second comes when the first leaves
    ],
)
def test_the_queue_by_hand(service, gaps, waits, idts):
    service, gaps = jnp.array(service), jnp.array(gaps)
    np.testing.assert_array_equal(waiting_times(service, gaps), waits)
    np.testing.assert_array_equal(interdeparture_times(service, gaps), idts)


def test_a_later_opening_delays_the_first_departure_only(key):
    service, gaps = draw_jobs(key, jnp.asarray(TRUTH), 50)
    before = np.asarray(interdeparture_times(service, gaps))
    after = np.asarray(interdeparture_times(service, gaps.at[0].add(16.0)))
    np.testing.assert_array_equal(before[1:], after[1:])
    np.testing.assert_allclose(after[0] - before[0], 16.0, rtol=1e-5)


def test_the_unit_of_time_does_not_matter(key):
    """Times by four, the rate by a quarter: every time is four times as long, to the last bit."""
    keys = jax.random.split(key, 16)
    one = batched(50)(jax.random.clone(keys), jnp.tile(jnp.asarray(TRUTH, jnp.float32), (16, 1)))
    four = batched(50)(keys, jnp.tile(jnp.array([4.0, 20.0, 0.05]), (16, 1)))
    for short, long in zip(one, four, strict=True):
        np.testing.assert_array_equal(4 * np.asarray(short), long)


def test_swapped_bounds_are_the_same_queue(key):
    problem = task()
    theta = jnp.array([[1.0, 5.0, 0.2], [5.0, 1.0, 0.2], [2.0, 5.0, 0.2]])
    one, swapped, other = jax.jit(jax.vmap(problem.simulate, in_axes=(None, 0)))(key, theta)
    np.testing.assert_array_equal(one, swapped)
    assert not np.array_equal(one, other)


# ------------------------------------------------------------------------------------------------ distributions


@pytest.mark.parametrize("theta", [(1.0, 5.0, 0.2), (12.0, 3.0, 0.45)])
def test_draws(theta, key):
    service, gaps, _, _ = queues(key, theta, 200)
    low, high = sorted(theta[:2])
    assert stats.kstest(service.ravel(), stats.uniform(low, high - low).cdf).pvalue > 1e-3
    assert stats.kstest(gaps.ravel(), stats.expon(scale=1 / theta[2]).cdf).pvalue > 1e-3
    for first, second in [(service, gaps), (service[:, 1:], service[:, :-1]), (gaps[:, 1:], gaps[:, :-1])]:
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 5 / np.sqrt(first.size)


@pytest.mark.parametrize("theta", [TRUTH, (4.0, 9.0, 0.15)])
def test_percentiles_are_distributed_as_the_oracles(theta, key):
    """Each of the five, by two-sample Kolmogorov-Smirnov."""
    rng = np.random.default_rng(7)
    expected = np.percentile([oracle.simulate(rng, theta) for _ in range(1000)], PERCENTILES, axis=1)
    got = np.percentile(queues(key, theta, 2000)[3], PERCENTILES, axis=1)
    for ours, theirs in zip(got, expected, strict=True):
        assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


MANY = 8_000
"""Jobs of a long run; the first tenth, while the queue fills, is left out."""


def within(samples: np.ndarray, expected: float, sigmas: float = 4.5) -> None:
    """The mean of independent replicates is the expected one, with an error small enough to say something."""
    error = samples.std(ddof=1) / np.sqrt(len(samples))
    assert error < 0.03 * expected
    assert abs(samples.mean() - expected) < sigmas * error, (samples.mean(), expected, error)


@pytest.mark.parametrize("theta", [(1.0, 5.0, 0.2), (0.0, 4.0, 0.1), (2.0, 2.0, 0.3)])
def test_an_unsaturated_queue_in_the_long_run(theta, key):
    """Jobs leave at the rate they come, and wait as Pollaczek and Khinchine say: lambda E[S^2] / (2 (1 - rho))."""
    low, high, rate = theta
    mean, square = (low + high) / 2, (low**2 + low * high + high**2) / 3
    load = rate * mean
    assert load < 1
    _, _, waits, idts = (part[:, MANY // 10 :] for part in queues(key, theta, 32, MANY))
    within(idts.mean(axis=1), 1 / rate)
    within(waits.mean(axis=1), rate * square / (2 * (1 - load)))


@pytest.mark.parametrize("theta", [(4.0, 10.0, 0.3), (3.0, 20.0, 0.5)])
def test_a_saturated_queue_in_the_long_run(theta, key):
    """The server never idles: jobs leave as fast as it works, and the line grows at the rate of the surplus."""
    low, high, rate = theta
    assert rate * (low + high) / 2 > 1.5
    _, _, waits, idts = queues(key, theta, 32, MANY)
    within(idts[:, MANY // 10 :].mean(axis=1), (low + high) / 2)
    within(waits[:, -1] / MANY, (low + high) / 2 - 1 / rate)


def test_exponential_service(key):
    """M/M/1: a wait is 0 with probability 1 - rho, else exponential with rate mu - lambda; departures are Poisson."""
    arrivals, services, replicas = 0.5, 1.0, 3000
    key_service, key_gaps = jax.random.split(key)
    service = jax.random.exponential(key_service, (replicas, 200)) / services
    gaps = jax.random.exponential(key_gaps, (replicas, 200)) / arrivals
    waits = np.asarray(jax.jit(jax.vmap(waiting_times))(service, gaps))[:, -1]
    idts = np.asarray(jax.jit(jax.vmap(interdeparture_times))(service, gaps))[:, -1]
    assert stats.binomtest(int(np.sum(waits == 0)), replicas, 1 - arrivals / services).pvalue > 1e-3
    assert stats.kstest(waits[waits > 0], stats.expon(scale=1 / (services - arrivals)).cdf).pvalue > 1e-3
    assert stats.kstest(idts, stats.expon(scale=1 / arrivals).cdf).pvalue > 1e-3


# ------------------------------------------------------------------------------------------- published numbers


PUBLISHED = np.array([5.603234, 16.107032, 32.502898, 57.740358, 185.078851])
"""Means of the five percentiles over 1e5 prior simulations, as shipped with Papamakarios and Murray (2016)."""


def test_pilot_means_of_papamakarios_and_murray(key):
    """Their prior is p1, p2 - p1 ~ U[0, 10] and p3 ~ U[0, 1/3], and it has no floor on the rate.

    The largest time then has no mean (its tail is that of 1 / p3), and a mean over 1e5 of them has a distribution far
    from normal. It is found here as that of a normal bulk (rates above `split`) plus a tail that is simulated anew for
    each of 100 pilots. The published means, one more pilot, must lie in the central 95 % of them.
    """
    split, block = 1 / 300, 20_000
    fraction, replicates = 3 * split, 100
    run = batched(50, floor=1e-12)

    def percentiles(key, low, high, blocks):
        rows = []
        for key_block in jax.random.split(key, blocks):
            key_theta, key_run = jax.random.split(key_block)
            first, extra, rate = np.asarray(jax.random.uniform(key_theta, (3, block), minval=1e-6))
            theta = np.stack([10 * first, 10 * (first + extra), low + (high - low) * rate], axis=1)
            idts = run(jax.random.split(key_run, block), jnp.asarray(theta, jnp.float32))[3]
            rows.append(np.percentile(np.asarray(idts), PERCENTILES, axis=1).T)
        return np.concatenate(rows).astype(np.float64)

    key_bulk, key_tail, key_normal = jax.random.split(key, 3)
    bulk = percentiles(key_bulk, split, 1 / 3, 3)
    tail = percentiles(key_tail, 0.0, split, 5).reshape(replicates, round(1e5 * fraction), 5)
    normal = np.asarray(jax.random.normal(key_normal, (replicates, 5)), np.float64)
    deviation = np.linalg.cholesky(np.cov(bulk.T) / (1e5 * (1 - fraction)))
    pilots = (1 - fraction) * (bulk.mean(axis=0) + normal @ deviation.T) + fraction * tail.mean(axis=1)
    low, high = np.percentile(pilots, [2.5, 97.5], axis=0)
    assert ((low < PUBLISHED) & (high > PUBLISHED)).all(), (low, high)
    # From below the band is tight: the tail can only add.
    assert (low > 0.6 * PUBLISHED).all()


# -------------------------------------------------------------------------------------------------- summaries


@pytest.mark.parametrize(
    ("jobs", "percentiles"), [(50, PERCENTILES), (7, (0.0, 10.0, 33.3, 100.0)), (1, (50.0,)), (5, (99.0, 99.5, 100.0))]
)
def test_percentiles_against_numpy(jobs, percentiles):
    values = np.random.default_rng(3).exponential(5, jobs).astype(np.float32)
    got = percentiles_of(jnp.asarray(values), percentiles)
    np.testing.assert_allclose(got, np.percentile(values.astype(np.float64), percentiles), rtol=1e-6)


def test_the_summary_does_not_depend_on_the_order(key):
    by_departure, ascending = task(order="departure"), task(order="sorted")
    raw, ordered = (
        np.asarray(problem.simulate(jax.random.clone(key), problem.truth)) for problem in (by_departure, ascending)
    )
    assert not np.array_equal(raw, ordered)
    np.testing.assert_array_equal(np.sort(raw), ordered)
    np.testing.assert_array_equal(by_departure.summary(raw), ascending.summary(ordered))
    np.testing.assert_allclose(ascending.summary(raw), np.percentile(raw, PERCENTILES), rtol=1e-6)
    assert {"sorted", "departure"} == set(ORDERS)


def test_sorted_trajectories_are_nearest_at_the_truth_and_unsorted_ones_are_not(key):
    """What the docstring of `task` says of the two orders."""
    key_seen, key_own, *keys = jax.random.split(key, 5)
    seen, own = queues(key_seen, TRUTH, 300)[3], queues(key_own, TRUTH, 300)[3]
    distance = jax.jit(jax.vmap(trajectory_distance))
    mean = np.broadcast_to(seen.mean(axis=1, keepdims=True), seen.shape)
    assert np.mean(distance(own, seen)) > 1.2 * np.mean(distance(mean, seen))
    seen, own = np.sort(seen), np.sort(own)
    nearest = np.mean(distance(own, seen))
    assert nearest < 0.7 * np.mean(distance(mean, seen))
    for other, theta in zip(keys, [(1.0, 5.0, 0.08), (4.0, 5.0, 0.2), (1.0, 12.0, 0.2)], strict=True):
        assert np.mean(distance(np.sort(queues(other, theta, 300)[3]), seen)) > 1.1 * nearest


# -------------------------------------------------------------------------------------------------- whitening


def test_the_pilots_are_simulations_of_the_ok_support():
    """The same each time; distributed as the oracle's, which puts the same floor under the rate."""
    pilots = pilot()
    assert pilots.shape == (10_000, 5) and np.isfinite(pilots).all() and pilot() is pilots
    pilot.cache_clear()
    np.testing.assert_array_equal(pilot(), pilots)
    rng = np.random.default_rng(11)
    low, high = np.asarray(SUPPORTS["ok"].low), np.asarray(SUPPORTS["ok"].high)
    theta = np.maximum(rng.uniform(low, high, (1500, 3)), [0.0, 0.0, RATE_FLOOR])
    expected = np.percentile([oracle.simulate(rng, row) for row in theta], PERCENTILES, axis=1)
    for ours, theirs in zip(pilots.T, expected, strict=True):
        assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


def test_the_pilots_floor_is_the_tasks():
    longest = [pilot(10, (100.0,), floor, 500).max() for floor in (RATE_FLOOR, 0.3)]
    assert longest[0] > 100 > longest[1]  # a rate of 0.3 makes no gap of more than 16 / 0.3 in single precision


def test_whitened_pilots():
    """Mean 0 and deviation 1 by both; uncorrelated by the second, which differs from the first by a rotation only."""
    pilots = pilot()
    by_scale, by_axes = np.asarray(zscore(pilots)(pilots)), np.asarray(pca(pilots)(pilots))
    for whitened in (by_scale, by_axes):
        np.testing.assert_allclose(whitened.mean(axis=0), 0.0, atol=2e-3)
        np.testing.assert_allclose(whitened.std(axis=0), 1.0, atol=2e-3)
    np.testing.assert_allclose(by_scale, stats.zscore(pilots.astype(np.float64)), atol=1e-3)
    assert np.corrcoef(by_scale.T)[0, 1] > 0.1
    np.testing.assert_allclose(np.cov(by_axes.T), np.eye(5), atol=5e-3)
    # The largest axis first: the distance in whitened space is Mahalanobis', whatever the axes' signs.
    inverse = np.linalg.inv(np.cov(pilots.T.astype(np.float64), ddof=0))
    centred = (pilots - pilots.mean(axis=0))[:100].astype(np.float64)
    np.testing.assert_allclose(
        (by_axes[:100] ** 2).sum(axis=1), np.einsum("ni,ij,nj->n", centred, inverse, centred), rtol=0.01, atol=1e-3
    )
    matrix = np.asarray(pca(pilots).matrix)
    assert (np.diff(np.linalg.norm(matrix, axis=0)) > 0).all()
    assert (matrix[np.abs(matrix).argmax(axis=0), range(5)] > 0).all()


@pytest.mark.parametrize("name", WHITENINGS)
def test_a_summary_that_does_not_vary_is_centred_only(name):
    rows = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 0.0, 2.0] + [3.0, 4.0, 5.0]
    whitened = np.asarray(WHITENINGS[name](rows)(rows.astype(np.float32)))
    assert np.isfinite(whitened).all()
    np.testing.assert_allclose(sorted(whitened.std(axis=0)), [0.0, 1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(whitened.mean(axis=0), 0.0, atol=1e-5)


@pytest.mark.parametrize("name", WHITENINGS)
def test_a_whitened_task_is_the_plain_one_whitened(name, key):
    percentiles = (10.0, 60.0, 95.0)
    plain, whitened = task(12, percentiles), task(12, percentiles, whiten=name)
    trajectory = plain.simulate(key, plain.truth)
    x = plain.summary(trajectory)
    assert x.shape == (3,) and trajectory.shape == (12,)
    expected = WHITENINGS[name](pilot(12, percentiles))(x)
    np.testing.assert_allclose(whitened.summary(trajectory), expected, rtol=1e-6)
    assert np.abs(np.asarray(whitened.summary(trajectory))).max() < 5 < np.abs(np.asarray(x)).max()


# ------------------------------------------------------------------------------------------------------- task


def test_the_task_is_the_papers():
    problem = task()
    np.testing.assert_allclose(problem.truth, TRUTH)
    boxes = {
        "ok": ([0, 0, 0], [10, 10, 0.35]),
        "misspecified": ([3, 0, 0], [10, 7, 0.35]),
        "broad": ([0, 0, 0], [20, 20, 0.5]),
        "unmirrored": ([3, 2, 0], [10, 7, 0.35]),
    }
    assert list(problem.supports) == list(boxes) and problem.name == "mg1"
    for name, (low, high) in boxes.items():
        np.testing.assert_allclose(problem.support(name).low, low)
        np.testing.assert_allclose(problem.support(name).high, high)
        assert bool(FEASIBLE.contains(problem.support(name).low) & FEASIBLE.contains(problem.support(name).high))
    np.testing.assert_allclose(problem.feasible.high, boxes["broad"][1])
    assert bool(problem.support("ok").contains(problem.truth))
    assert not bool(problem.support("misspecified").contains(problem.truth))
    mirrored = problem.truth[jnp.array([1, 0, 2])]
    assert bool(problem.support("misspecified").contains(mirrored))  # as the text says
    assert not bool(problem.support("unmirrored").contains(jnp.stack([jnp.asarray(problem.truth), mirrored])).any())
    assert float(problem.feasible.low[2]) >= 0  # no negative rates
    assert (problem.names, problem.units) == (
        ("service min", "service max", "arrival rate"),
        ("time", "time", "1/time"),
    )


def corners() -> np.ndarray:
    bounds = np.stack([np.asarray(FEASIBLE.low), np.asarray(FEASIBLE.high)])
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@pytest.mark.parametrize("whiten", [None, "pca"])
def test_simulations_in_phi_and_at_its_corners_never_fail(whiten, key):
    problem = task(whiten=whiten)
    theta = np.concatenate([np.repeat(corners(), 25, axis=0), np.asarray(FEASIBLE.sample(key, 800))])
    x, failure = jax.jit(lambda key, theta: simulate(key, problem, theta))(jax.random.fold_in(key, 1), theta)
    assert x.shape == (1000, 5) and bool(jnp.isfinite(x).all()) and not bool(failure.any())


def test_low_rates_are_raised_to_the_floor(key):
    floor = 0.01
    gaps = lambda rate: draw_jobs(jax.random.clone(key), jnp.array([1.0, 5.0, rate]), 50, floor)[1]
    for rate in (0.0, 0.5 * floor, -1.0):
        np.testing.assert_array_equal(gaps(rate), gaps(floor))
    assert not np.array_equal(gaps(2 * floor), gaps(floor))
    idle = task(floor=0.3).simulate(key, jnp.array([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(jnp.mean(idle), 1 / 0.3, rtol=5 / np.sqrt(50))


def test_many_at_once_are_one_by_one(key):
    problem = task()
    keys, theta = jax.random.split(key, 6), jnp.asarray(np.float32(LOADS))
    together = jax.jit(jax.vmap(problem.simulate))(jax.random.clone(keys), theta)
    compiled = jax.jit(problem.simulate)
    alone = jnp.stack([compiled(*one) for one in zip(jax.random.clone(keys), theta, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=2e-6)
    np.testing.assert_allclose(problem.simulate(keys[0], theta[0]), alone[0], rtol=2e-6)
    assert together.shape == (6, 50)
    assert not np.allclose(together[0], together[1])  # same queue, another key


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"jobs": 0}, r"^jobs: expected at least 1, got 0"),
        ({"jobs": 4}, r"^jobs: expected at least as many as the 5 percentiles, got 4"),
        ({"percentiles": ()}, r"^percentiles: expected numbers in \[0, 100\], got \(\)"),
        ({"percentiles": (0, 101)}, r"^percentiles: expected numbers in \[0, 100\], got \(0.0, 101.0\)"),
        ({"percentiles": (float("nan"),)}, r"^percentiles: expected numbers in \[0, 100\], got \(nan,\)"),
        ({"percentiles": (50, 25)}, r"^percentiles: expected increasing numbers, got \(50.0, 25.0\)"),
        ({"whiten": "zca"}, r"^whiten: expected None or one of \['pca', 'zscore'\], got 'zca'"),
        ({"order": "random"}, r"^order: expected one of \['departure', 'sorted'\], got 'random'"),
        ({"floor": 0.0}, r"^floor: expected an arrival rate above 0 and below 0.35, got 0.0"),
        ({"floor": 0.4}, r"^floor: expected an arrival rate above 0 and below 0.35, got 0.4"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        task(**changes)
