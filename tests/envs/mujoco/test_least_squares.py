"""Least squares of MuJoCo tasks: closed forms, known truths, and the errors that residuals do not show."""

import tracemalloc

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import least_squares, simulator
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.least_squares import Residuals, best_fits, fit
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

DAMPING = Parameter("joint/shoulder/damping", (0.01, 0.5), unit="N m s/rad", log=True, truth=0.08)
GEAR = Parameter("actuator/motor/gear[0]", (0.5, 3.0), truth=1.5)
PENDULUM = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="rod">
    <joint name="hinge" axis="0 1 0" damping="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
    <site name="tip" pos="0 0 -0.4"/>
  </body></worldbody>
  <sensor><jointpos name="angle" joint="hinge"/><framepos name="tip" objtype="site" objname="tip"/></sensor>
</mujoco>
"""


def task(seed=0, noise=0.01, error=None):
    """An arm's recording with noise, and perhaps with a discrepancy."""
    log, rng = recorded(), np.random.default_rng(seed)
    angle = log.signals["angle"] + noise * rng.standard_normal(len(log.times))
    if error is not None:
        angle = angle + error.draws(rng, 1, log.times)[0]
    noisy = Log(log.times, {"motor": log.signals["motor"], "angle": angle})
    return mujoco_task(ARM, [DAMPING, GEAR], noisy, noises={"angle": noise})


def swung(integrator, factor=1, angle=0.8, count=301):
    """Angle and height of a pendulum let go, by a loop of single steps."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep, model.opt.integrator = model.opt.timestep / factor, integrator
    data, rows = mujoco.MjData(model), []
    data.qpos[0] = angle
    for step in range(factor * (count - 1) + 1):
        mujoco.mj_step(model, data)
        if step % factor == 0:
            rows.append(data.sensordata.copy())
    rows = np.array(rows)
    return Log(0.01 * np.arange(count), {"angle": rows[:, 0], "tip[2]": rows[:, 3]})


def test_the_truth_is_found_where_there_is_no_error():
    own = mujoco_task(ARM, [DAMPING, GEAR], recorded(), ["angle"], {"angle": 1e-3})
    found = fit(own, [0.3, 0.7])
    # A finer integrator would change it by 2 %, which this recording was not made by.
    np.testing.assert_allclose(found.theta, [0.08, 1.5], rtol=1e-4)
    assert not found.at_bound.any() and found.defect == 0


def test_derivatives_are_those_of_single_simulations():
    own = task()
    residuals = Residuals(own)
    low, high = (np.asarray(bound, float) for bound in (own.inference.feasible.low, own.inference.feasible.high))
    point, step = np.array([np.log(0.1), 1.2]), 1e-3
    found = residuals.jacobian(point, low, high)
    for d, direction in enumerate(step * np.eye(2)):
        ends = [residuals.simulator.clean(residuals.natural((point + sign * direction)[None]))[0] for sign in (1, -1)]
        expected = (ends[0] - ends[1])[0, :, 0] / (2 * step) / 0.01
        np.testing.assert_allclose(found[:, d], expected, rtol=1e-3, atol=1e-3)
    assert residuals.simulations == 4


@pytest.mark.slow
def test_points_scatter_as_their_covariances_say(monkeypatch):
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    fits = [fit(task(seed), [0.1, 1.3]) for seed in range(24)]
    truth = np.array([np.log(0.08), 1.5])
    scores = [
        (np.array([np.log(one.theta[0]), one.theta[1]]) - truth) / np.sqrt(np.diagonal(one.covariance)) for one in fits
    ]
    # 48 scores of about unit variance: their root mean square is 1 within three sigma of 0.1.
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3
    held = [(one.interval[:, 0] < [0.08, 1.5]) & ([0.08, 1.5] < one.interval[:, 1]) for one in fits]
    assert 0.77 < np.mean(held) < 1.0


def test_covariances_are_those_of_the_whole_matrix(monkeypatch):
    """Two episodes with missing samples, compared with the full covariance of all measurements."""
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    rng, several = np.random.default_rng(1), []
    for count in (101, 60):
        log = recorded(count=count)
        signals = {"motor": log.signals["motor"]}
        for name in ("angle", "velocity[0]"):
            error = Discrepancy(0.01, 0.2).draws(rng, 1, log.times)[0] + 0.01 * rng.standard_normal(count)
            signals[name] = np.where(rng.random(count) < 0.2, np.nan, log.signals[name] + error)
        several.append(Log(log.times, signals))
    own = mujoco_task(ARM, [DAMPING, GEAR], several, noises={"angle": 0.01, "velocity[0]": 0.02})
    kept, estimate = {}, least_squares.forces.estimated
    monkeypatch.setattr(
        least_squares.forces, "estimated", lambda *given: kept.setdefault("size", (estimate(*given), given))[0]
    )
    found = fit(own, [0.1, 1.3])
    (size, widened), (left, _, by_forces) = kept["size"]
    residuals = Residuals(own)
    there, times = residuals.simulator.there, residuals.simulator.times
    episode, clock = np.repeat([0, 1], [len(one) for one in times]), np.concatenate(times)
    signal = np.nonzero(there)[1]
    row = np.nonzero(there)[0]
    whole = np.eye(there.sum()) + (size * widened) ** 2 * by_forces @ by_forces.T
    for c, process in enumerate(found.discrepancies):
        same = (signal[:, None] == c) & (signal == c) & (episode[row][:, None] == episode[row])
        whole += np.where(same, process.covariance(clock[row]), 0.0) / residuals.noise[c] ** 2
    low, high = (np.asarray(bound, float) for bound in (own.inference.feasible.low, own.inference.feasible.high))
    point = np.array([np.log(found.theta[0]), found.theta[1]])
    bread = np.linalg.pinv(residuals.jacobian(point, low, high))
    np.testing.assert_allclose(found.covariance, bread @ whole @ bread.T, rtol=1e-3)
    assert len(left) == there.sum() and size > 0 and found.discrepancies[0].deviation > 3e-3 and found.informed.all()


def test_points_by_stated_errors_are_those_of_the_whole_matrix():
    """Generalised least squares with the covariance of noise, discrepancy and forces, made in full; samples lack."""
    rng, log, process = np.random.default_rng(2), recorded(), Discrepancy(0.02, 0.2)
    angle = log.signals["angle"] + process.draws(rng, 1, log.times)[0] + 0.01 * rng.standard_normal(101)
    lacks = Log(log.times, {"motor": log.signals["motor"], "angle": np.where(rng.random(101) < 0.1, np.nan, angle)})
    own = mujoco_task(
        ARM, [DAMPING, GEAR], lacks, noises={"angle": 0.01}, discrepancies={"angle": process}, unmodelled_force=0.005
    )
    found, plain = fit(own, [0.1, 1.3], stated=True), fit(own, [0.1, 1.3])
    assert found.discrepancies == () and 0.8 < found.misfit < 1.25 < plain.misfit
    simulator, residuals = simulator_of(own), Residuals(own)
    there, (times,) = simulator.there[:, 0], simulator.times
    point = np.array([np.log(found.theta[0]), found.theta[1]])
    residuals.correct(point)
    by_forces = residuals.of_forces(point, simulator.forces.times(100.0)) / 100.0
    whole = np.eye(there.sum()) + process.covariance(times[there]) / 0.01**2 + by_forces @ by_forces.T
    low, high = (np.asarray(bound, float) for bound in (own.inference.feasible.low, own.inference.feasible.high))
    jacobian, left = residuals.jacobian(point, low, high), residuals(point[None])[0]
    information = jacobian.T @ np.linalg.solve(whole, jacobian)
    larger = max(1.0, left @ np.linalg.solve(whole, left) / len(left))
    np.testing.assert_allclose(found.covariance, larger * np.linalg.inv(information), rtol=2e-2)
    step = np.linalg.solve(information, jacobian.T @ np.linalg.solve(whole, left))
    assert (np.abs(step) < 0.05 * np.sqrt(np.diagonal(found.covariance))).all()  # it is the optimum
    assert np.linalg.eigvalsh(by_forces.T @ by_forces).max() > 1.0


def test_memory_grows_with_the_recording_only(monkeypatch):
    """The fit is to 24,000 numbers, whose full covariance matrix would take 4.6 GB."""
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    monkeypatch.setattr(simulator, "MEMORY", 2**22)
    times = 0.01 * np.arange(12_000)
    signals = {"angle": 0.3 * np.cos(times), "tip[2]": np.sin(3 * times)}
    own = mujoco_task(
        PENDULUM,
        [Parameter("joint/hinge/damping", (0.005, 0.2))],
        Log(times, signals),
        noises=dict.fromkeys(signals, 1.0),
    )
    assert simulator_of(own)._chunk < 10
    tracemalloc.start()
    try:
        found = fit(own, [0.05])
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert np.isfinite(found.misfit) and most < 1e8


def test_an_error_that_persists_makes_intervals_wider(monkeypatch):
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    plain, wrong = (fit(task(3, 0.01, error), [0.1, 1.3]) for error in (None, Discrepancy(0.03, 0.3)))
    assert (np.diagonal(wrong.covariance) > 9 * np.diagonal(plain.covariance)).all()
    assert wrong.misfit > 2 and wrong.discrepancies[0].deviation > 0.015 > plain.discrepancies[0].deviation


def test_the_integrators_error_is_taken_off(monkeypatch):
    """A step of 10 ms shifts a pendulum's phase, for which its centre of mass compensates."""
    log = swung(mujoco.mjtIntegrator.mjINT_RK4, factor=10)
    parameter = Parameter("body/rod/ipos[2]", (-0.4, -0.1), unit="m", truth=-0.2)
    own = mujoco_task(PENDULUM, [parameter], log, ["angle"], {"angle": 1e-3}, {"hinge/qpos": 0.8})
    corrected = fit(own, [-0.3])
    monkeypatch.setattr(least_squares, "CORRECTIONS", 0)
    plain = fit(own, [-0.3])
    errors = [abs(one.theta[0] / -0.2 - 1) for one in (plain, corrected)]
    assert errors[0] > 0.001 and errors[1] < 0.1 * errors[0]
    assert corrected.misfit < 0.1 * plain.misfit


def test_a_finer_simulator_is_a_loop_of_shorter_steps():
    log = swung(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    parameter = Parameter("joint/hinge/damping", (0.002, 0.05))
    own = mujoco_task(PENDULUM, [parameter], log, ["angle"], {"angle": 0.0}, {"hinge/qpos": 0.8})
    simulator, fine = own.simulate.function, swung(mujoco.mjtIntegrator.mjINT_RK4, factor=10)
    np.testing.assert_allclose(simulator.finer().clean([[0.01]])[0][0, :, 0], fine.signals["angle"], atol=1e-9)
    np.testing.assert_allclose(simulator.clean([[0.01]])[0][0, :, 0], log.signals["angle"], atol=1e-9)


def test_both_of_two_points_are_found():
    """The height of a pendulum's tip does not tell on which side it was released."""
    log = swung(mujoco.mjtIntegrator.mjINT_IMPLICITFAST, angle=0.4)
    parameter = Parameter("initial/hinge/qpos", (-1.0, 1.0), unit="rad")
    own = mujoco_task(PENDULUM, [parameter], log, ["tip[2]"], {"tip[2]": 1e-3})
    fits = best_fits(own, np.array([[-0.7], [-0.5], [0.3], [0.6]]))
    assert len(fits) == 2 and sorted(np.sign(one.theta[0]) for one in fits) == [-1, 1]
    np.testing.assert_allclose([abs(one.theta[0]) for one in fits], 0.4, rtol=0.02)


def test_a_point_on_a_bound_is_told():
    own = mujoco_task(ARM, [DAMPING, Parameter(GEAR.name, (0.5, 1.2))], recorded(), ["angle"], {"angle": 1e-3})
    found = fit(own, [0.1, 1.0])
    assert found.at_bound[1] and found.theta[1] == pytest.approx(1.2, rel=1e-3)


def test_controls_of_another_recording():
    own = mujoco_task(ARM, [DAMPING], recorded(), ["angle"], {"angle": 0.0})
    other = own.simulate.function.under(lambda values: 2 * values).clean([[0.08]])[0][0, :, 0]
    twice = recorded(edit=lambda model: model.actuator_gear.__setitem__((0, 0), 3.0)).signals["angle"]
    np.testing.assert_allclose(other, twice, atol=1e-9)


def test_means_of_held_signals():
    log = Log(np.array([0.0, 0.1, 0.3]), {"motor": np.array([1.0, 3.0, -2.0])})
    times = np.array([-0.5, 0.0, 0.06, 0.1, 0.26, 0.4])
    expected = [1.0, 1.0, (0.04 * 1 + 0.06 * 3) / 0.1, 3.0, (0.04 * 3 - 0.06 * 2) / 0.1, -2.0]
    np.testing.assert_allclose(log.mean_held("motor", times, 0.1), expected, atol=1e-12)


def test_tasks_of_another_kind_are_refused():
    from jaxlfi.envs import gaussian_linear

    with pytest.raises(ValueError, match="expected one of a MuJoCo model, got gaussian_linear"):
        fit(gaussian_linear.task(), np.zeros(10))
