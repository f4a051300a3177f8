"""Expected information and best designs against closed forms, by both methods."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.design.choosing import choose, failures, rate
from jaxlfi.design.contrastive import ContrastiveRater
from jaxlfi.design.fisher import FisherRater, covariance_after, worth
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task
from tests.design.models import SIGMA, gaussian, information, linear, rows

COVARIANCE = np.array([[1.0, 0.6], [0.6, 0.5]])
ANGLES = np.linspace(0.0, np.pi, 5)[:, None]


RATERS = {
    "fisher": lambda key, region: FisherRater(key, linear(), (region,)),
    "fisher of a simulator": lambda key, region: FisherRater(key, linear(response=False), (region,)),
    "likelihood": lambda key, region: ContrastiveRater(key, linear(), (region,), simulations=4096),
    "fitted": lambda key, region: ContrastiveRater(key, linear(response=False), (region,), simulations=8192),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "likelihood")) for name in RATERS]
)
def test_linear_gaussian_information(name):
    rater = RATERS[name](jax.random.key(0), gaussian([1.0, -1.0], COVARIANCE))
    found, within = rate(rater, ANGLES), 0.01 if "fisher" in name else 0.05
    expected = np.array([information(COVARIANCE, angle) for angle in ANGLES])
    np.testing.assert_allclose(found.value, expected, rtol=within, atol=0.02)
    assert np.abs(found.value - expected).max() < 5 * found.error.max() + 0.03
    assert expected.max() > 1.2 * expected.min() and (found.failing == 0).all()


def test_information_of_noise_that_is_estimated():
    """Nothing is declared: 64 repetitions at each of 64 points."""
    region = gaussian([1.0, -1.0], COVARIANCE)
    rater = FisherRater(jax.random.key(1), linear(response=False, noise=False), (region,))
    expected = [information(COVARIANCE, angle) for angle in ANGLES]
    np.testing.assert_allclose(rate(rater, ANGLES).value, expected, rtol=0.05)


def test_where_nothing_can_be_learnt_nothing_is_found():
    blind = Task(
        lambda key, theta, design: jax.random.normal(key, (3,)),
        ["a", "b"],
        {"guess": Support([-9.0] * 2, [9.0] * 2)},
        Support([-9.0] * 2, [9.0] * 2),
        design={"angle": (0.0, 1.0)},
    )
    rater = ContrastiveRater(jax.random.key(0), blind, (gaussian([0.0, 0.0], COVARIANCE),), simulations=2048)
    assert -0.1 < rate(rater, np.array([[0.5]])).value[0] < 0.02


@pytest.mark.parametrize("method", ["fisher", "fitted"])
def test_information_about_one_parameter(method):
    """A measurement along an axis tells most of that parameter, whatever it tells of the other."""
    region = gaussian([0.0, 0.0], np.diag([1.0, 4.0]))
    about = np.array([[1.0, 0.0]])
    if method == "fisher":
        rater = FisherRater(jax.random.key(0), linear(), (region,), about)
    else:
        rater = ContrastiveRater(jax.random.key(0), linear(response=False), (region,), about, simulations=4096)
    angles = np.array([[0.0], [0.5 * np.pi]])
    found = rate(rater, angles)
    expected = 0.5 * np.log2(1 + 1.45 / SIGMA**2)
    np.testing.assert_allclose(found.value, [expected, 0.0], rtol=0.05, atol=0.03)
    everything = rate(FisherRater(jax.random.key(0), linear(), (region,)), angles)
    assert everything.value.argmax() == 1


def test_variances_left_are_those_of_a_regression():
    """A-optimality: the mean of the variances after it, as fractions."""
    factor = np.linalg.cholesky(COVARIANCE)
    matrix = np.array([[2.0, 0.5], [0.5, 1.0]])
    after = np.linalg.inv(np.linalg.inv(COVARIANCE) + matrix)
    np.testing.assert_allclose(covariance_after(factor, matrix), after, rtol=1e-6)
    left = np.mean(np.diagonal(after) / np.diagonal(COVARIANCE))
    assert worth(factor, matrix, criterion="variance") == pytest.approx(-left)


def decay(noise=0.02) -> Task:
    """One measurement of exp(-rate t), at a time t that is chosen."""
    response = lambda theta, design: jnp.exp(-theta * design)
    return Task(
        lambda key, theta, design: response(theta, design) + noise * jax.random.normal(key, (1,)),
        ["rate"],
        {"guess": Support([0.1], [9.0])},
        Support([0.1], [9.0]),
        design=Design({"time": (0.0, 5.0, "s")}, response=response, noise=noise),
    )


@pytest.mark.parametrize(
    ("method", "value"),
    [
        ("fisher", 0.5),
        ("contrastive", 2.0),
        pytest.param("fisher", 2.0, marks=pytest.mark.slow),
        pytest.param("contrastive", 0.5, marks=pytest.mark.slow),
    ],
)
def test_exponential_decay_is_best_measured_at_one_over_its_rate(method, value):
    region = gaussian([value], [[(0.05 * value) ** 2]])
    if method == "fisher":
        rater = FisherRater(jax.random.key(0), decay(), (region,))
    else:
        rater = ContrastiveRater(jax.random.key(0), decay(), (region,), simulations=512)
    found = choose(rater, np.random.default_rng(0), rated=96)
    assert found.batch.designs[0, 0] == pytest.approx(1 / value, rel=0.05)


def test_michaelis_menten_is_best_measured_at_two_known_points():
    """v = V s / (K + s), s up to s_max: half at s_max, half at K s_max / (2 K + s_max) (Bates and Watts 1988)."""
    top, half, most = 3.0, 0.8, 4.0
    response = lambda theta, design: theta[0] * design / (theta[1] + design)
    box = Support([0.1, 0.1], [9.0, 9.0])
    task = Task(
        lambda key, theta, design: response(theta, design) + 0.001 * jax.random.normal(key, (2,)),
        ["V", "K"],
        {"guess": box},
        box,
        design=Design({"s1": (0.0, most), "s2": (0.0, most)}, response=response, noise=0.001),
    )
    rater = FisherRater(jax.random.key(0), task, (gaussian([top, half], np.diag([0.03**2, 0.008**2])),))
    found = choose(rater, np.random.default_rng(0), rated=240)
    low, high = np.sort(found.batch.designs[0])
    assert high == pytest.approx(most, rel=0.05)
    assert low == pytest.approx(half * most / (2 * half + most), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fisher", "likelihood"])
def test_a_batch_is_as_good_as_the_best_of_all_batches(method):
    """Three measurements in the plane, against all triples of 36 angles."""
    region = gaussian([0.0, 0.0], COVARIANCE)
    if method == "fisher":
        rater = FisherRater(jax.random.key(0), linear(), (region,))
    else:
        rater = ContrastiveRater(jax.random.key(0), linear(), (region,), simulations=512)
    found = choose(rater, np.random.default_rng(0), count=3, rated=64)
    grid = np.linspace(0.0, np.pi, 36, endpoint=False)
    best = max(information(COVARIANCE, angles) for angles in itertools.combinations_with_replacement(grid, 3))
    assert information(COVARIANCE, found.batch.designs[:, 0]) > 0.99 * best
    assert found.together[0] == pytest.approx(best, rel=0.05)
    assert found.batch.value.sum() == pytest.approx(found.together[0], abs=1e-3)
    assert (np.diff(found.batch.value) < 0.05).all()  # each in the order of what it adds


def test_a_batch_repeats_an_experiment_only_where_that_is_best():
    """A belief that is wide in one direction is measured along it twice; one that is round in two directions."""
    choose_two = lambda covariance: choose(
        FisherRater(jax.random.key(0), linear(), (gaussian([0.0, 0.0], covariance),)),
        np.random.default_rng(0),
        count=2,
        rated=120,
    ).batch.designs[:, 0]
    turned = lambda angles: abs(np.sin(angles[0] - angles[1]))  # 0 where they are the same line
    assert turned(choose_two(np.diag([1.0, 1e-4]))) < 0.05
    assert turned(choose_two(np.eye(2))) > 0.99


def test_experiments_that_would_harm_are_not_chosen():
    """The angle that tells most is beyond what is safe."""
    covariance = np.diag([1.0, 0.01])
    task = linear(safe=lambda y: jnp.abs(y[0]) < 1.5)
    region = gaussian([0.0, 0.0], covariance)
    rater = FisherRater(jax.random.key(0), task, (region,))
    free = choose(FisherRater(jax.random.key(0), linear(), (region,)), np.random.default_rng(0), rated=100)
    kept = choose(rater, np.random.default_rng(0), rated=200, tolerance=0.05)
    assert abs(np.cos(free.batch.designs[0, 0])) > 0.99
    assert kept.batch.failing[0] <= 0.05 < failures(rater, free.batch.designs)[0]
    assert abs(np.cos(kept.batch.designs[0, 0])) < 0.99
    share = failures(rater, np.array([[0.0]]))[0]
    assert 0.06 < share < 0.35  # P(|N(0, 1.25)| > 1.5) = 0.18


def test_where_all_experiments_harm_that_is_said():
    rater = FisherRater(jax.random.key(0), linear(safe=lambda y: y[0] > 99.0), (gaussian([0.0, 0.0], np.eye(2)),))
    with pytest.raises(ValueError, match="safest of 24 fails for 100%"):
        choose(rater, np.random.default_rng(0), rated=24)


def test_derivatives_by_differences_are_those_of_jax():
    """A simulator that JAX cannot differentiate, and one outside of it, give the same information."""
    region = gaussian([1.0, -1.0], COVARIANCE)

    @jax.custom_vjp  # has no forward derivative
    def opaque(theta, design):
        return rows(design) @ theta

    opaque.defvjp(lambda theta, design: (opaque(theta, design), None), lambda _, g: (g, g))
    own = Task(
        lambda key, theta, design: opaque(theta, design),
        ["a", "b"],
        {"guess": Support([-9.0] * 2, [9.0] * 2)},
        Support([-9.0] * 2, [9.0] * 2),
        design=Design({"angle": (0.0, np.pi)}, noise=SIGMA),
    )
    outside = Task(
        HostSimulator(lambda rng, theta, design: theta @ np.asarray(rows(design)).T + rng.normal(0, SIGMA, 3)),
        ["a", "b"],
        own.supports,
        own.feasible,
        design=Design(
            {"angle": (0.0, np.pi)}, noise=SIGMA, response=lambda theta, design: theta @ np.asarray(rows(design)).T
        ),
    )
    expected = FisherRater(jax.random.key(0), linear(), (region,)).precision(ANGLES)
    for task in (own, outside):
        found = FisherRater(jax.random.key(0), task, (region,)).precision(ANGLES)
        np.testing.assert_allclose(found, expected[:, : found.shape[1]], rtol=2e-3, atol=2e-3)


def test_the_precision_of_a_fitted_likelihood_is_that_of_the_model():
    rater = ContrastiveRater(
        jax.random.key(0), linear(response=False, noise=False), (gaussian([1.0, -1.0], COVARIANCE),), simulations=8192
    )
    found = rater.precision(ANGLES).mean(axis=1)
    matrix = np.stack([np.asarray(rows(jnp.asarray(angle))) for angle in ANGLES])
    expected = np.swapaxes(matrix, 1, 2) @ matrix / SIGMA**2
    np.testing.assert_allclose(found, expected, atol=0.4)
    assert expected.max() > 5
