"""Simulations of a model, against a plain loop of single steps."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

import jax
from envs_mujoco import ARM, driven, recorded

from jaxlfi.envs import gaussian_linear
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import CHUNK, REFUSED, UNSTABLE, simulator_of
from jaxlfi.tasks.executors import one_by_one

DAMPING = Parameter("joint/elbow/damping", (0.01, 0.2), (0.001, 1.0), "N m s/rad", log=True)
QUIET = {"angle": 0.0, **{f"velocity[{i}]": 0.0 for i in range(3)}}
SIGNALS = list(QUIET)


def simulator(parameters, log=None, noise=QUIET, xml=ARM, **others):
    return mujoco_task(xml, parameters, log or recorded(), noises=noise, **others).simulate.function


def matrix(log):
    return np.stack([log.signals[name] for name in SIGNALS], axis=1)


def test_a_simulation_is_the_loop_of_its_steps():
    truth = recorded(edit=lambda model: model.dof_damping.__setitem__(1, 0.11))
    rows, outcome = simulator([DAMPING], truth).clean([[0.03], [0.11]])
    assert outcome.tolist() == [0, 0]
    np.testing.assert_allclose(rows[1], matrix(truth), atol=1e-10)
    np.testing.assert_allclose(rows[0], matrix(recorded()), atol=1e-10)
    assert np.abs(rows[1] - rows[0]).max() > 0.1


def test_every_kind_of_parameter_acts():
    bent = recorded(start=(0.3, -0.5), delay=0.012)
    parameters = [
        Parameter("initial/elbow/qpos", (-1.0, 1.0)),
        Parameter("control/delay", (0.0, 0.1)),
        Parameter("sensor/velocity[1]/bias", (-1.0, 1.0)),
    ]
    own = simulator(parameters, initial={"shoulder/qpos": 0.3})
    rows, _ = own.clean([[-0.5, 0.012, 0.25], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(rows[0] - [0, 0, 0.25, 0], matrix(bent), atol=1e-10)
    np.testing.assert_allclose(rows[1], matrix(recorded(start=(0.3, 0.0))), atol=1e-10)


def test_states_are_those_of_the_loop():
    """Checked for the second episode, at the times of the model's steps."""
    parameters = [DAMPING, Parameter("initial/elbow/qpos", (-1.0, 1.0)), Parameter("control/delay", (0.0, 0.1))]
    own = simulator(parameters, [recorded(count=40), recorded(interval=0.04, count=12)])
    theta = [[0.03, 0.2, 0.0], [0.11, -0.3, 0.012]]
    models, grid, states = own.states(theta, 1)
    np.testing.assert_allclose(grid, 0.004 * np.arange(111))
    for (damping, start, delay), model, found in zip(theta, models, states, strict=True):
        assert model.dof_damping[1] == damping
        plain = mujoco.MjModel.from_xml_string(ARM)
        plain.dof_damping[1] = damping
        data = mujoco.MjData(plain)
        data.qpos[1] = start
        for step, state in enumerate(found):
            np.testing.assert_allclose(state, [data.time, *data.qpos, *data.qvel], atol=1e-9)
            data.ctrl[0] = driven(0.04 * (max(step - round(delay / 0.004), 0) // 10))
            mujoco.mj_step(plain, data)


def test_the_simulator_of_a_task_whose_simulations_are_made_one_by_one():
    task = mujoco_task(ARM, [DAMPING], recorded(), noises=QUIET)
    assert simulator_of(one_by_one(task)) is simulator_of(task) is task.simulate.function
    with pytest.raises(ValueError, match="task: expected one of a MuJoCo model, got gaussian_linear"):
        simulator_of(gaussian_linear.task())


def test_a_bias_is_of_its_signal():
    rows, _ = simulator([Parameter("sensor/velocity[2]/bias", (-1.0, 1.0))]).clean([[0.5], [0.0]])
    np.testing.assert_allclose(rows[0] - rows[1], np.broadcast_to([0, 0, 0, 0.5], rows[0].shape), atol=1e-12)


def test_noise_has_the_standard_deviations_that_are_given_or_inferred():
    noise = {**QUIET, "angle": 0.02, "velocity[0]": 0.3}
    del noise["velocity[2]"]  # that is inferred
    own = simulator([Parameter("sensor/velocity[2]/noise", (0.01, 1.0))], noise=noise)
    theta = np.tile([[0.7], [0.1]], (100, 1))
    rows, _ = own(np.random.default_rng(0), theta)
    rest = rows - own.clean(theta)[0]
    count = 100 * rest.shape[1]
    for half, last in ((0, 0.7), (1, 0.1)):
        deviation = rest[half::2].std(axis=(0, 1))
        np.testing.assert_allclose(deviation, [0.02, 0.3, 0.0, last], rtol=4 / np.sqrt(2 * count), atol=1e-12)
    again, _ = own(np.random.default_rng(0), theta)
    np.testing.assert_array_equal(rows, again)


def test_samples_between_steps_are_between_their_values():
    """The signal is a free fall, whose velocity is linear in time."""
    xml = """<mujoco><option timestep="0.01"/><worldbody><body name="ball"><joint name="z" type="slide" axis="0 0 1"/>
             <geom size="0.1"/></body></worldbody><sensor><jointvel name="speed" joint="z"/></sensor></mujoco>"""
    times = np.array([0.0, 0.013, 0.0275, 0.1, 0.333])
    log = Log(times, {"speed": np.zeros(5)})
    own = simulator([Parameter("option/gravity[2]", (-20.0, -1.0))], log, {"speed": 0.0}, xml)
    rows, _ = own.clean([[-9.0], [-3.0]])
    np.testing.assert_allclose(rows[..., 0], np.outer([-9.0, -3.0], times), rtol=1e-6, atol=1e-12)


def test_what_was_not_sampled_is_zero_in_simulations_too():
    log = recorded()
    signals = {name: values.copy() for name, values in log.signals.items()}
    signals["angle"][1::2] = np.nan
    signals["velocity[0]"][7] = np.nan
    for name in SIGNALS:
        signals[name][50] = np.nan
    own = simulator([DAMPING], Log(log.times, signals))
    rows, _ = own(np.random.default_rng(0), np.array([[0.03]]))
    assert rows.shape == (1, 100, 4) and own.times[0].size == 100  # the row without any sample is left out
    np.testing.assert_array_equal(rows[0] == 0, ~own.there | (matrix(recorded())[np.arange(101) != 50] == 0))
    assert (own.observation[~own.there] == 0).all() and own.there.sum() == 100 * 4 - 50 - 1


def test_controls_have_a_clock_of_their_own():
    """Held from row to row: every second one is as good as twice the interval."""
    log = recorded(interval=0.04, count=51)
    finer = np.arange(0, 101) * 0.02
    motor = np.full(101, np.nan)
    motor[::2] = log.signals["motor"]
    sensed = {name: np.full(101, np.nan) for name in SIGNALS}
    for name in SIGNALS:
        sensed[name][::2] = log.signals[name]
    rows, _ = simulator([DAMPING], Log(finer, {"motor": motor, **sensed})).clean([[0.03]])
    np.testing.assert_allclose(rows[0], matrix(log), atol=1e-10)


def test_episodes_lie_one_after_another():
    short, long = recorded(count=40), recorded(interval=0.04, count=30)
    own = simulator([DAMPING], [short, long])
    rows, _ = own.clean([[0.03]])
    np.testing.assert_allclose(rows[0], np.concatenate([matrix(short), matrix(long)]), atol=1e-10)
    assert [times.size for times in own.times] == [40, 30]


def test_any_number_of_threads_and_simulations_gives_the_same():
    log = recorded(count=10)
    theta = np.geomspace(0.01, 0.2, CHUNK + 3)[:, None]
    one, several = (simulator([DAMPING], log, threads=threads) for threads in (1, 3))
    rows, _ = several.clean(theta)
    np.testing.assert_array_equal(rows, one.clean(theta)[0])
    np.testing.assert_array_equal(rows[-1], one.clean(theta[-1:])[0][0])


def test_what_explodes_or_is_refused_is_counted_and_the_others_go_on(capfd):
    parameters = [Parameter("joint/elbow/stiffness", (0.0, 1e-3)), Parameter("body/fore/mass", (0.1, 1.0))]
    own = simulator(parameters, xml=ARM.replace("implicitfast", "Euler"))
    rows, outcome = own.clean([[0.0, 0.3], [-1e9, 0.3], [0.0, -1.0], [0.0, 0.5]])
    assert outcome.tolist() == [0, UNSTABLE, REFUSED, 0]
    assert (rows[[1, 2]] == 0).all() and np.abs(rows[[0, 3]]).max(axis=(1, 2)).min() > 0.1
    np.testing.assert_array_equal(rows[3], own.clean([[0.0, 0.5]])[0][0])
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        (lambda log: Log(log.times, {name: log.signals[name] for name in SIGNALS}), r"for each actuator .* motor"),
        (lambda log: Log(log.times * 1e-6, log.signals), "expected more than a step of the model, 0.004 s"),
    ],
)
def test_recordings_that_do_not_fit_the_model(log, expected):
    with pytest.raises(ValueError, match=expected) as caught:
        simulator([DAMPING], log(recorded()))
    assert "\n" not in str(caught.value)


def test_a_recording_of_other_signals():
    with pytest.raises(ValueError, match=r"measured: expected a sensor such as angle, got 'angel'"):
        log = recorded()
        signals = {**log.signals, "angel": log.signals["angle"]}
        mujoco_task(ARM, [DAMPING], Log(log.times, signals))
    with pytest.raises(ValueError, match=r"measured: expected signals of recorded: .*; got 'speed'"):
        mujoco_task(ARM, [DAMPING], recorded(), measured=["speed"])
    with pytest.raises(ValueError, match=r"noises: expected some of angle, .* got angel"):
        mujoco_task(ARM, [DAMPING], recorded(), noises={"angel": 0.1})
    with pytest.raises(ValueError, match="noises: angle: expected a standard deviation of at least 0"):
        mujoco_task(ARM, [DAMPING], recorded(), noises={**QUIET, "angle": -0.1})


@pytest.mark.parametrize("model", ["none.xml", "<mujoco><worldbody><geom/></mujoco>", "<mujoco><nonsense/></mujoco>"])
def test_models_that_are_none(model):
    with pytest.raises(ValueError, match="model: ") as caught:
        mujoco_task(model, [DAMPING], recorded())
    assert "\n" not in str(caught.value)


def test_the_task_says_what_it_is():
    task = mujoco_task(ARM, [DAMPING, Parameter("control/delay", (0.0, 0.1), unit="s")], recorded(), noises=QUIET)
    assert task.name == "arm" and task.names == ("joint/elbow/damping", "control/delay")
    assert task.units == ("N m s/rad", "s") and task.log == ("joint/elbow/damping",)
    assert task.simulate.function.signals == tuple(SIGNALS)
    np.testing.assert_allclose([task.feasible.low, task.feasible.high], [[0.001, 0], [1.0, 0.1]], rtol=1e-6)
    np.testing.assert_allclose([task.supports["initial"].low[0], task.supports["initial"].high[0]], [0.01, 0.2])
    assert task.observation.shape == (101, 4) and task.truth is None
    summary = np.asarray(task.summary(task.observation))
    rows = np.linspace(0, 100, 30).round().astype(int)
    np.testing.assert_array_equal(summary, task.observation[rows].ravel())
    trajectory, outcome = task.simulate(jax.random.key(0), np.array([0.03, 0.0]))
    assert trajectory.shape == (101, 4) and outcome == 0
