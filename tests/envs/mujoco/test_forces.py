"""Forces that a model lacks: their size, their effect, and what residuals reveal about them."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.stats

mujoco = pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import forces, least_squares
from jaxlfi.envs.mujoco.effects import STATE
from jaxlfi.envs.mujoco.forces import UnmodelledForces, estimated, typical
from jaxlfi.envs.mujoco.least_squares import fit
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

DAMPING = Parameter("joint/shoulder/damping", (0.01, 0.5), unit="N m s/rad", log=True, truth=0.08)
GEAR = Parameter("actuator/motor/gear[0]", (0.5, 3.0), truth=1.5)
BALL = """
<mujoco><worldbody>
  <body><joint type="ball"/><geom size="0.1" pos="0 0 -0.3"/>
    <body pos="0 0 -0.5"><joint type="slide" axis="0 0 1" stiffness="20"/><geom size="0.1"/></body></body>
</worldbody></mujoco>
"""


def task(log=None, noise=0.005, **others):
    return mujoco_task(ARM, [DAMPING, GEAR], log or recorded(), ["angle"], {"angle": noise}, **others)


def test_typical_forces_are_those_of_a_swinging_rod():
    """Gravity and damping by their formulas, at angles and speeds of all signs."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.07"/>'
        '<geom type="sphere" size="0.05" pos="0 0 -0.4" mass="0.5"/></body></worldbody></mujoco>'
    )
    rng = np.random.default_rng(0)
    angle, speed = rng.uniform(-1, 2, 50), rng.uniform(-3, 1, 50)
    states = np.stack([np.zeros(50), angle, speed], axis=1)
    found = typical(model, states, STATE)
    force = np.sqrt(np.mean((0.5 * 9.81 * 0.4 * np.sin(angle)) ** 2 + (0.07 * speed) ** 2))
    np.testing.assert_allclose(found.friction, force, rtol=1e-6)
    np.testing.assert_allclose(found.stiffness, force / np.sqrt(np.mean(angle**2)), rtol=1e-6)
    np.testing.assert_allclose(found.damping, force / np.sqrt(np.mean(speed**2)), rtol=1e-6)


def test_balls_have_no_spring_and_what_stands_still_has_no_damper():
    model = mujoco.MjModel.from_xml_string(BALL)
    state = np.zeros((1, mujoco.mj_stateSize(model, STATE)))
    mujoco.mj_getState(model, mujoco.MjData(model), state[0], STATE)
    state[0, 5] = 0.1  # of the slide
    found = typical(model, state, STATE)
    assert found.stiffness[0] == 0 and found.stiffness[1] > 0
    assert found.friction[3] > 1 and (found.damping == 0).all()
    assert len(found.names) == len(found.deviations) == 2 + 4 + 4


def test_a_force_is_that_of_a_model_that_has_it():
    simulator = simulator_of(task())
    besides = simulator.typical_forces(np.array([0.08, 1.5]))
    assert (besides.deviations > 0).all()
    numbers = np.array([0.4, -0.3, 0.05, 0.02, 0.03, 0.01])
    rows, outcome = simulator.lacking(besides).clean(np.array([[0.08, 1.5]]), numbers[None])

    def edit(model):
        model.jnt_stiffness[:], model.dof_damping[:], model.dof_frictionloss[:] = np.split(numbers, 3)
        model.dof_damping += [0.08, 0.03]

    np.testing.assert_allclose(rows[0, :, 0], recorded(edit=edit).signals["angle"], atol=1e-9)
    assert outcome == 0 and np.ptp(rows) > 0.5
    plain, _ = simulator.clean(np.array([[0.08, 1.5]]))
    assert np.abs(rows - plain).max() > 0.02


def test_damping_and_friction_do_not_become_negative():
    model = mujoco.MjModel.from_xml_string(ARM)
    besides = UnmodelledForces(np.ones(2), np.ones(2), np.ones(2))
    besides.add(model, np.array([-1.0, 2.0, -1.0, 0.5, -1.0, 0.25]))
    np.testing.assert_allclose(model.jnt_stiffness, [-1, 2])
    np.testing.assert_allclose(model.dof_damping, [0, 0.53])
    np.testing.assert_allclose(model.dof_frictionloss, [0, 0.25])


@pytest.mark.slow
def test_simulations_scatter_as_their_forces_say():
    """A hundredth of the typical forces, where their effects add up: a covariance of F F^T, by Gaussian draws."""
    own = task(noise=0.0, unmodelled_force=0.003)
    simulator, theta = simulator_of(own), np.array([0.08, 1.5])
    rows, outcome = simulator(np.random.default_rng(0), np.tile(theta, (1500, 1)))
    assert not outcome.any() and simulator.forces.friction[0] > 0
    residuals = least_squares.Residuals(own)
    scale = residuals.of_forces(np.array([np.log(0.08), 1.5]), simulator.forces) * residuals.noise
    # Friction that is not there cannot be taken away: of draws about zero it has half of the second moment.
    variance = np.sum(scale**2 * np.array([1, 1, 1, 1, 0.5, 0.5]), axis=1)
    moment = np.mean((rows[:, 1:, 0] - simulator.clean(theta[None])[0][0, 1:, 0]) ** 2, axis=0)
    assert np.sqrt(variance.max()) > 1e-3
    np.testing.assert_allclose(moment[20:], variance[21:], rtol=0.25)


def test_nothing_is_added_by_default():
    rows = [task(**others).simulate.function(np.random.default_rng(0), [[0.1, 1.0]])[0] for others in ({}, FORCELESS)]
    np.testing.assert_array_equal(*rows)


FORCELESS = {"unmodelled_force": 0.0}


def test_size_from_residuals():
    """Residuals have a known size, which the parameters partly absorb; white noise leaves hardly any.

    Six directions that are equally visible are about six degrees of freedom: 1.943 for 1.645 of a normal distribution.
    """
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((400, 3))
    by_forces = 50 * rng.standard_normal((400, 6)) + jacobian @ rng.standard_normal((3, 6)) * 100
    found = []
    for size in (0.0, 0.2):
        sets = [
            jacobian @ rng.standard_normal(3) + by_forces @ (size * rng.standard_normal(6)) + rng.standard_normal(400)
            for _ in range(300)
        ]
        found.append(np.sqrt(np.mean([estimated(own, jacobian, by_forces)[0] ** 2 for own in sets])))
    assert found[0] < 0.003
    assert found[1] == pytest.approx(0.2, rel=4 / np.sqrt(2 * 300 * 6))
    assert estimated(sets[0], jacobian, by_forces)[1] == pytest.approx(1.943 / 1.645, rel=0.02)
    assert estimated(sets[0], jacobian, np.zeros((400, 6))) == (0, 1)
    assert estimated(np.zeros(400), jacobian, by_forces) == (0, 1)


def test_noise_along_other_directions_does_not_count():
    """Of 300 residuals half of all sets have more noise than expected; two directions are visible.

    The most likely size is that of SciPy's optimiser on the whole covariance.
    """
    rng = np.random.default_rng(3)
    jacobian, by_forces = rng.standard_normal((300, 4)), rng.standard_normal((300, 2)) * [6.0, 0.4]
    directions = scipy.linalg.null_space(jacobian.T)
    seen = directions.T @ by_forces
    sizes = []
    for number in range(200):
        left = rng.standard_normal(300) + by_forces @ ([0.0, 0.1][number % 2] * rng.standard_normal(2))
        sizes.append(estimated(left, jacobian, by_forces)[0])
        if number < 6:
            found = scipy.optimize.minimize_scalar(
                lambda log, left=left: (
                    -scipy.stats.multivariate_normal.logpdf(
                        directions.T @ left, None, np.eye(296) + np.exp(log) * seen @ seen.T
                    )
                ),
                bounds=(-20.0, 5.0),
                method="bounded",
                options={"xatol": 1e-3},
            )
            assert sizes[-1] == pytest.approx(np.exp(found.x / 2), rel=0.03, abs=1e-3)
    alone, forced = np.reshape(sizes, (100, 2)).T
    assert np.median(alone) == 0.0 and np.quantile(alone, 0.95) < 0.025  # 0.02 moves the residuals by two deviations
    assert np.sqrt(np.mean(forced**2)) == pytest.approx(0.1, rel=0.3)


@pytest.mark.slow
def test_intervals_hold_truths_where_forces_are_lacking(monkeypatch):
    """Each recording is of an arm with springs, dampers and friction of its own, a hundredth of what acts on it."""
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    simulator, rng, held = simulator_of(task()), np.random.default_rng(2), {True: [], False: []}
    real = simulator.lacking(simulator.typical_forces(np.array([0.08, 1.5])).times(0.01))
    estimate = forces.estimated
    for _ in range(20):
        rows, _ = real(rng, np.array([[0.08, 1.5]]))
        log = Log(recorded().times, {"motor": recorded().signals["motor"], "angle": rows[0, :, 0].astype(float)})
        for known, several in held.items():
            monkeypatch.setattr(forces, "estimated", estimate if known else lambda *given: (0.0, 1.0))
            low, high = fit(task(log), [0.1, 1.3]).interval.T
            several.append((low < [0.08, 1.5]) & ([0.08, 1.5] < high))
    assert np.mean(held[True]) >= 0.8 > np.mean(held[False]) + 0.2


@pytest.mark.parametrize("fraction", [-0.1, np.inf, np.nan])
def test_a_size_is_at_least_zero(fraction):
    with pytest.raises(ValueError, match="unmodelled_force: expected a fraction of at least 0"):
        task(unmodelled_force=fraction)


def test_the_centre_has_to_be_simulated():
    unstable = Parameter("joint/shoulder/stiffness", (-1e9, -1e8))
    with pytest.raises(ValueError, match="centre of its first guess, got unstable"):
        mujoco_task(ARM, [unstable], recorded(), ["angle"], {"angle": 0.01}, unmodelled_force=0.01)


def test_a_fit_where_the_centre_cannot_be_simulated():
    damping = Parameter("joint/shoulder/damping", (-6.0, 0.5))
    own = mujoco_task(ARM, [damping], recorded(), ["angle"], {"angle": 0.01})
    assert simulator_of(own).clean([[-2.75]])[1] > 0
    found = fit(own, [0.1])
    assert found.theta[0] == pytest.approx(0.08, abs=0.01) and np.isfinite(found.covariance).all()
