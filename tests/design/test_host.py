"""Designs of simulators outside JAX, which are slow: nothing is simulated that is not needed."""

import jax
import numpy as np
import pytest

from jaxlfi.design.choosing import choose, rate
from jaxlfi.design.fisher import STEP, FisherRater
from jaxlfi.design.regions import region
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task
from tests.design.models import box, gaussian


class Counted:
    """y = gain * theta, and how many parameter vectors each design was asked for."""

    def __init__(self):
        self.clean, self.noisy = {}, {}

    def response(self, theta, design):
        self.clean[float(design[0])] = self.clean.get(float(design[0]), 0) + len(theta)
        return (theta * design[0])[:, :, None]

    def __call__(self, rng, theta, design):
        self.noisy[float(design[0])] = self.noisy.get(float(design[0]), 0) + len(theta)
        return (theta * design[0])[:, :, None] + 0.1 * rng.standard_normal((len(theta), 2, 1))


def made():
    counted = Counted()
    design = Design(
        {"gain": (0.0, 8.0)},
        response=counted.response,
        noise=0.1,
        safe=lambda trajectory: np.abs(trajectory).max() < 6.0,
    )
    task = Task(HostSimulator(counted), ["a", "b"], {"guess": box(2)}, box(2), design=design)
    regions = (gaussian([1.0, 1.0], 0.01 * np.eye(2), weight=0.8), gaussian([0.0, 0.0], np.eye(2), weight=0.2))
    return counted, FisherRater(jax.random.key(0), task, regions)


def test_refused_designs_are_simulated_no_further_and_none_is_rated_twice():
    counted, rater = made()
    designs = np.array([[2.0], [8.0], [3.0]])
    found = rate(rater, designs)  # 8 is beyond what is safe
    assert found.failing[1] > 0.9 and found.value[1] < -1e5
    assert set(counted.clean) == {2.0, 3.0}
    assert {gain: counted.noisy[gain] for gain in (2.0, 8.0, 3.0)} == {2.0: 32, 8.0: 8, 3.0: 32}
    assert counted.clean[2.0] == (16 + 4) * (1 + 2)  # two regions by their weights, two parameters
    again = rate(rater, designs[:1], given=rater.evidence(designs[2:]))
    assert counted.clean[2.0] == (16 + 4) * (1 + 2)
    assert 0 < again.value[0] < found.value[0]


def test_information_outside_jax_is_that_of_the_closed_form():
    """1/2 log2 det(I + C F) by F = gain^2 / noise^2, in each region."""
    _, rater = made()
    value = rate(rater, np.array([[2.0]])).value[0]
    near, far = (np.log2(1 + variance * 2.0**2 / 0.1**2) for variance in (0.01, 1.0))
    np.testing.assert_allclose(value, 0.8 * near + 0.2 * far, rtol=0.02)


def test_curvature_cancels_in_differences_that_go_up_and_down():
    """Of y = theta^3 at 2 +- 1: within a hundredth of a bit of the closed form, where steps up alone are not."""
    rng = np.random.default_rng(3)
    draws = 2 + rng.uniform(-1, 1, (4096, 1))
    cube = Design({"gain": (0.0, 8.0)}, response=lambda theta, design: (theta**3)[:, :, None], noise=1.0)
    simulate = HostSimulator(lambda rng, theta, design: (theta**3)[:, :, None])
    task = Task(simulate, ["a"], {"guess": box(1)}, box(1), design=cube)
    place = region(1.0, draws)
    found = FisherRater(jax.random.key(0), task, (place,), draws=2000)
    value = float(found.terms(found.evidence(np.array([[1.0]])))[0].mean())
    gained = lambda slope: float(np.mean(0.5 * np.log2(1 + place.covariance[0, 0] * slope**2)))
    theta, step = draws[:2000, 0], STEP * np.sqrt(place.covariance[0, 0])
    exact, up = gained(3 * theta**2), gained(((theta + step) ** 3 - theta**3) / step)
    assert abs(value - exact) < 0.01 < 0.03 < up - exact


@pytest.mark.slow
def test_a_batch_asks_for_each_design_once():
    counted, rater = made()
    choose(rater, np.random.default_rng(0), count=2, rated=16)
    assert set(counted.clean.values()) == {(16 + 4) * (1 + 2)}
    nominal = rater.task.design.nominal[0]  # which tells the shape of a trajectory, too
    others = {number for gain, number in counted.noisy.items() if gain != nominal}
    assert others == {8, 32}  # some are refused after the first draws
