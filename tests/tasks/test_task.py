"""Task: coordinates, named supports and Phi, and what a declaration is refused for."""

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.bayessim.algorithm import prior_draws
from jaxlfi.distributions.support import Support
from jaxlfi.tasks import summaries
from jaxlfi.tasks.task import Task
from tests.strategies import vectors


def simulate(key, theta):
    return theta


def make(**changes) -> Task:
    """Three parameters, the first and the last of them in logarithms."""
    arguments = {
        "simulate": simulate,
        "names": ("mass", "offset", "drag"),
        "units": ("kg", "m", ""),
        "supports": {
            "guess": Support([1.0, -2.0, 0.5], [4.0, 3.0, 8.0]),
            "wide": Support([0.01, -30.0, 0.1], [400.0, 3.0, 16.0]),
        },
        "feasible": Support([0.1, -5.0, 0.25], [10.0, 5.0, 16.0]),
        "log": ("drag", "mass"),
        "truth": [2.0, -1.0, 1.0],
    }
    return Task(**(arguments | changes))


def test_declarations_are_taken_to_coordinates():
    task = make()
    assert task.dim == 3
    assert task.coordinates == ("ln mass", "offset", "ln drag")
    assert task.units == ("kg", "m", "")
    np.testing.assert_allclose(task.feasible.low, [np.log(0.1), -5.0, np.log(0.25)], rtol=1e-6)
    np.testing.assert_allclose(task.supports["guess"].high, [np.log(4.0), 3.0, np.log(8.0)], rtol=1e-6)
    np.testing.assert_allclose(task.truth, [np.log(2.0), -1.0, 0.0], rtol=1e-6)


def test_without_logs_everything_stays_as_it_was():
    task = make(log=())
    assert task.coordinates == task.names
    np.testing.assert_array_equal(task.supports["guess"].low, [1.0, -2.0, 0.5])
    np.testing.assert_array_equal(task.truth, [2.0, -1.0, 1.0])
    theta = jnp.array([-1.0, -2.0, -3.0])
    np.testing.assert_array_equal(task.to_natural(theta), theta)
    np.testing.assert_array_equal(task.to_coordinates(theta), theta)


@given(vectors(-8.0, 8.0, 4, 3))
def test_coordinates_round_trip(theta):
    task = make()
    natural = np.asarray(task.to_natural(jnp.asarray(theta)))
    expected = np.stack([np.exp(theta[:, 0]), theta[:, 1], np.exp(theta[:, 2])], axis=1)
    np.testing.assert_allclose(natural, expected, rtol=1e-5)
    np.testing.assert_allclose(task.to_coordinates(natural), theta, rtol=1e-5, atol=2e-6)


def test_gradients_pass_through_coordinates_without_nan():
    """Neither the logarithm of the plain parameter, which may be negative, nor its exponential is taken."""
    task = make()
    theta = jnp.array([0.5, 1000.0, 1.0])
    natural = jnp.array([0.5, -2.0, 3.0])
    np.testing.assert_allclose(jax.grad(lambda t: task.to_coordinates(t).sum())(natural), [2.0, 1.0, 1 / 3], rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda t: task.to_natural(t)[1])(theta), [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"units": ("kg", "m")}, r"^units: expected one for each of the 3 parameters, got 2"),
        (
            {"names": ("mass", "mass", "drag")},
            r"^names: expected distinct names, got \('mass', 'mass', 'drag'\)",
        ),
        ({"log": ("drag", "speed")}, r"^log: expected names among \('mass'.*got \['speed'\]"),
        (
            {"feasible": Support([0.1, 1.0], [10.0, 5.0])},
            r"^feasible: expected bounds for 3 parameters, got 2",
        ),
        ({"supports": {}}, r"^supports: expected at least one named support, got none"),
        (
            {"supports": {"guess": Support([1.0], [4.0])}},
            r"^supports\['guess'\]: expected bounds for 3 parameters, got 1",
        ),
        (
            {"supports": {"guess": Support([1.0], [4.0])}, "log": ()},
            r"^supports\['guess'\]: expected bounds for 3 parameters, got 1",
        ),
        (
            {"supports": {"a": Support([1.0, -2.0, 0.0], [4.0, 3.0, 8.0])}},
            r"^supports\['a'\]: expected positive bounds for the log parameters \('drag', 'mass'\), got",
        ),
        (
            {"feasible": Support([-1.0, -5.0, 0.25], [10.0, 5.0, 16.0])},
            r"^feasible: expected positive bounds for the log parameters",
        ),
        (
            {"feasible": Support(jnp.array([0.1, 6.0, 0.2]), jnp.array([10.0, 5.0, 16.0])), "log": ()},
            r"expected low < high .* dimension \[1\]",
        ),
        ({"truth": [1.0, 2.0]}, r"^truth: expected 3 numbers, got shape \(2,\)"),
        ({"truth": [1.0, 2.0, 0.0]}, r"^truth: expected positive values of the log parameters"),
        ({"summary": "nine"}, r"^summary: expected one of \['identity', 'series'\], got 'nine'"),
    ],
)
def test_bad_declarations_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


def test_a_plain_parameter_may_be_zero_or_negative_where_others_are_logs():
    task = make(truth=[1.0, 0.0, 1.0])
    np.testing.assert_allclose(task.truth, [0.0, 0.0, 0.0], atol=1e-7)


def test_supports_by_name_by_default_and_own():
    task = make()
    assert task.support() is task.supports["guess"]
    assert task.support("wide") is task.supports["wide"]
    own = Support([-2.0, -5.0, -1.0], [2.0, 5.0, 1.0])
    assert task.support(own) is own
    with pytest.raises(ValueError, match=r"^support: expected one of \['guess', 'wide'\], got 'narrow'"):
        task.support("narrow")
    with pytest.raises(ValueError, match=r"inside the feasible domain Phi; in dimension 1 it is \[-5.1, 5\]"):
        task.support(Support([-2.0, -5.1, -1.0], [2.0, 5.0, 1.0]))


def test_a_named_support_may_be_wider_than_phi():
    """The paper's "broadest" is; the same box as one's own is refused."""
    wide = make().supports["wide"]
    assert float(wide.low[1]) == -30.0
    with pytest.raises(ValueError, match="feasible domain Phi"):
        make().support(Support(wide.low, wide.high))


def test_reasons_end_with_non_finite():
    assert make().reasons == ("failed", "non_finite")
    assert make(failures=("diverged", "timeout")).reasons == ("diverged", "timeout", "non_finite")


def test_units_default_to_none_and_the_summary_to_the_trajectory():
    task = make(units=None)
    assert task.units == ("", "", "")
    np.testing.assert_array_equal(task.summary(jnp.array([[1.0, 2.0], [3.0, 4.0]])), [1.0, 2.0, 3.0, 4.0])
    assert task.summary is summaries.SUMMARIES["identity"]
    total = lambda trajectory: trajectory.sum(keepdims=True)
    assert make(summary=total).summary is total


@given(st.integers(0, 2**32 - 1))
def test_draws_of_a_prior_are_kept_in_the_support(seed):
    """Half of the prior's mass is outside in one dimension, nearly all of it in another task's box."""
    prior = distrax.MultivariateNormalDiag(jnp.array([0.0, 2.0, 0.5]), jnp.array([1.0, 0.5, 2.0]))
    task = make(prior=prior)
    for box in (task.support(), Support([-2.0, -5.0, -1.0], [-1.9, -4.0, 1.0])):
        draws = prior_draws(jax.random.key(seed), task, box, 20)
        assert draws.shape == (20, 3) and bool(box.contains(draws).all())


def test_draws_of_a_prior_are_its_truncated_density(key):
    """Rejection, not clipping: no atoms on the bounds, and the mean of the truncated normal."""
    prior = distrax.MultivariateNormalDiag(jnp.zeros(1), jnp.ones(1))
    task = Task(simulate, ("a",), {"half": Support([0.0], [5.0])}, Support([-9.0], [9.0]), prior=prior)
    draws = np.asarray(prior_draws(key, task, task.support(), 4000))
    assert (draws > 0).all() and (draws < 5).all()
    assert abs(draws.mean() - np.sqrt(2 / np.pi)) < 5 * np.sqrt((1 - 2 / np.pi) / 4000)


def test_without_a_prior_draws_are_uniform(key):
    task = make(log=())
    draws = np.asarray(prior_draws(key, task, task.support(), 4000))
    np.testing.assert_allclose(draws.mean(0), task.support().centre, atol=5 * 7.5 / np.sqrt(12 * 4000))
