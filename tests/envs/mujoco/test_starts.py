"""Where episodes begin: against closed forms and plain loops of steps."""

import warnings
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

import jax.numpy as jnp

from jaxlfi.envs.mujoco import config, least_squares, starts
from jaxlfi.envs.mujoco.effects import Effects
from jaxlfi.envs.mujoco.logs import Log, RecordingWarning
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

FOLDER = Path(__file__).parents[3] / "examples/mujoco"
PENDULUM = """
<mujoco><option timestep="0.002"/><worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></worldbody>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
  <keyframe><key name="up" qpos="3.1"/><key name="aside" qpos="1.2" qvel="-0.4"/></keyframe></mujoco>
"""
DAMPING = Parameter("joint/hinge/damping", (0.005, 0.2), log=True)
ROBOT = """
<mujoco><option timestep="0.002" gravity="0 0 -2"/><worldbody>
  <body name="torso" pos="0 0 1"><freejoint/><geom type="sphere" size="0.1" mass="2"/>
    <body pos="0.3 0 0"><joint axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/></body>
  </body></worldbody>
  <keyframe><key name="home" qpos="0.1 -0.2 0.7 0.8 0 0.6 0 0.35" qvel="0 0 0.3 0 0 0 -1"/></keyframe></mujoco>
"""


def swing(position, speed, noise=0.002, damping=0.05, seed=0, count=300):
    """A recording of the pendulum by a plain loop."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.dof_damping[0] = damping
    data, rows = mujoco.MjData(model), []
    data.qpos[0], data.qvel[0] = position, speed
    for _ in range(count):
        rows.append(data.qpos[0])
        for _ in range(5):
            mujoco.mj_step(model, data)
    noisy = np.array(rows) + noise * np.random.default_rng(seed).standard_normal(count)
    return Log(0.01 * np.arange(count), {"angle": noisy}, f"from {position:g}")


def task(several, parameters=(DAMPING,), **others):
    return mujoco_task(PENDULUM, list(parameters), several, noises={"angle": 0.002}, **others)


def begins(own):
    return [start.state for start in simulator_of(own).starts]


def test_every_episode_begins_where_its_recording_does_and_that_is_one_line():
    with pytest.warns(RecordingWarning) as said:
        own = task([swing(1.0, 0.0), swing(0.4, -1.5)])
    assert len(said) == 1 and "from 1, from 0.4: an episode begins where the recording does" in str(said[0].message)
    for state, truth, start in zip(begins(own), [(1.0, 0.0), (0.4, -1.5)], simulator_of(own).starts, strict=True):
        deviations = np.linalg.norm(start.root[0], axis=1)
        assert (np.abs(state[1:] - truth) < 4 * deviations).all() and deviations[1] < 0.15
    found = least_squares.fit(own, [0.1])
    (low, high), span = found.interval[0], np.ptp(found.interval[0])
    assert low < 0.05 < high and span < 0.006 and 0.8 < found.misfit < 1.2


def test_velocities_are_as_uncertain_as_they_are_said_to_be():
    """Errors in standard deviations, for many recordings of a sine in noise, at an edge and in the middle."""
    times, noise = 0.01 * np.arange(200), 0.01
    exact = lambda t: np.array([0.7 * np.sin(4 * t + 0.3), 2.8 * np.cos(4 * t + 0.3)])
    for at in (0.0, 0.9):
        errors = []
        for seed in range(300):
            values = exact(times)[0] + noise * np.random.default_rng(seed).standard_normal(200)
            moments, covariance = starts.polynomial([(times, values, noise, 0)], at, "sine")
            errors.append((moments[:2] - exact(at)) / np.sqrt(np.diagonal(covariance)))
        np.testing.assert_allclose(np.std(errors, axis=0), 1.0, atol=0.15)
        np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.3)


def test_a_measured_velocity_says_more():
    times, rng = 0.01 * np.arange(100), np.random.default_rng(1)
    positions = (times, np.sin(times) + 0.01 * rng.standard_normal(100), 0.01, 0)
    speeds = (times, np.cos(times) + 0.01 * rng.standard_normal(100), 0.01, 1)
    _, without = starts.polynomial([positions], 0.0, "")
    moments, covariance = starts.polynomial([positions, speeds], 0.0, "")
    assert np.sqrt(covariance[1, 1]) < 0.3 * np.sqrt(without[1, 1])
    assert abs(moments[1] - 1.0) < 4 * np.sqrt(covariance[1, 1])


def test_what_is_left_open_is_drawn_anew_in_each_simulation():
    """A cart that nothing drives: where it is after a second, x + v, has the variance of the sum."""
    xml = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
    <geom size="0.1"/></body></worldbody></mujoco>"""
    times = 0.01 * np.arange(101)
    signals = {"joint/rail/qpos": 0.5 + 0.8 * times + 0.01 * np.random.default_rng(0).standard_normal(101)}
    parameter = Parameter("joint/rail/damping", (0.0, 1.0))
    own = mujoco_task(xml, [parameter], Log(times, signals), noises={"joint/rail/qpos": 1e-9}, begins="log")
    simulator = simulator_of(own)
    (start,) = simulator.starts
    covariance = start.root[0] @ start.root[0].T
    rows, _ = simulator(np.random.default_rng(2), np.zeros((2000, 1)))
    expected = np.sqrt(covariance.sum())
    assert rows[:, -1, 0].std() == pytest.approx(expected, rel=5 / np.sqrt(2 * 2000))
    assert rows[:, -1, 0].mean() == pytest.approx(start.state[1] + start.state[2], abs=5 * expected / np.sqrt(2000))
    clean, _ = simulator.clean(np.zeros((2, 1)))
    np.testing.assert_allclose(clean[:, -1, 0], start.state[1] + start.state[2], rtol=1e-9)


def test_a_recording_that_begins_as_the_model_does_changes_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = task(swing(0.0, 0.0))
    assert begins(own)[0].tolist() == [0, 0, 0] and not simulator_of(own).starts[0].uncertain


@pytest.mark.parametrize("name", ["furuta", "arm", "puck", "finger", "shuffle", "servo"])
def test_examples_begin_as_their_files_say(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RecordingWarning)
        simulator = simulator_of(config.read(FOLDER / f"{name}.toml"))
    (start,) = simulator.starts
    assert not start.uncertain
    assert start.state[1:].any() == (name == "puck")


def test_numbers_win_one_for_all_or_one_for_each():
    several = [swing(1.0, 0.0), swing(0.4, -1.5)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both = begins(task(several, initial={"hinge/qpos": 0.9}))
        each = begins(task(several, initial={"hinge/qpos": [1.0, 0.4], "hinge/qvel": [0.0, -1.5]}))
        beside = task(several, initial={"hinge/qvel": -0.7}, begins="log")
    assert [state.tolist() for state in both] == [[0, 0.9, 0], [0, 0.9, 0]]
    assert [state.tolist() for state in each] == [[0, 1.0, 0], [0, 0.4, -1.5]]
    first, second = simulator_of(beside).starts
    assert first.state[2] == second.state[2] == -0.7 and abs(first.state[1] - 1.0) < 0.01
    assert first.root[0, 0, 0] > 0 and not first.root[0, 1].any()


def test_a_number_that_is_inferred_is_not_read_off_the_recording():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = task(swing(1.0, -0.5), [DAMPING, Parameter("initial/hinge/qpos", (-2.0, 2.0))])
    simulator = simulator_of(own)
    assert simulator.begun(0, np.array([0.1, 1.7])).tolist() == [0, 1.7, 0]
    assert not simulator.starts[0].uncertain


def test_a_start_of_one_episode_that_is_inferred():
    parameters = [DAMPING, Parameter("episode/1/initial/hinge/qpos", (-2.0, 2.0))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulator = simulator_of(task([swing(1.0, 0.0), swing(0.4, -1.5)], parameters, begins=["model", "log"]))
        default = simulator_of(task([swing(0.4, -1.5), swing(1.0, 0.0)], parameters))
    theta = np.array([[0.1, 1.7], [0.1, -0.3]])
    assert simulator.begun(0, theta).tolist() == [[0, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(simulator.begun(1, theta)[:, 1], [1.7, -0.3])
    assert abs(simulator.begun(1, theta)[0, 2] + 1.5) < 0.5 and not simulator.starts[1].root[0, 0].any()
    assert abs(default.begun(0, theta)[0, 1] - 0.4) < 0.01 and default.begun(1, theta)[1].tolist() == [0, -0.3, 0]
    for name, expected in {
        "episode/2/initial/hinge/qpos": "expected an episode of 0 to 1, got 2",
        "episode/1/initial/hing/qpos": "expected a joint such as hinge",
        "episode/one/initial/hinge/qpos": "expected one that begins with such as",
    }.items():
        with pytest.raises(ValueError, match=expected):
            task([swing(1.0, 0.0), swing(0.4, -1.5)], [Parameter(name, (-2.0, 2.0))])
    both = [Parameter("initial/hinge/qpos", (-2.0, 2.0)), parameters[1]]
    with pytest.raises(ValueError, match="expected one for each number, got 'initial/hinge/qpos' and 'episode/1/"):
        task([swing(1.0, 0.0), swing(0.4, -1.5)], both)


def test_keyframes_by_name_and_number_and_one_for_each_episode():
    several = [swing(1.2, -0.4), swing(3.1, 0.0)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        states = begins(task(several, begins=["keyframe aside", "keyframe 0"]))
        model = begins(task(several, begins="model"))
    assert [state.tolist() for state in states] == [[0, 1.2, -0.4], [0, 3.1, 0]]
    assert [state.tolist() for state in model] == [[0, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ({"begins": "start"}, 'initial: from: expected "log", "model" or "keyframe NAME", got \'start\''),
        ({"begins": 3}, 'initial: from: expected "log", "model" or "keyframe NAME", got 3'),
        ({"begins": "keyframe upp"}, "initial: from: expected a keyframe such as up, got 'upp'"),
        ({"begins": "keyframe 2"}, "initial: from: expected a keyframe .*, got '2'"),
        ({"begins": ["log", "log"]}, "expected one for all, or one for each of 1 episodes"),
        ({"initial": {"hinge/qpos": [0.1, 0.2]}}, "expected a number, or one for each of 1 episodes, got 2"),
    ],
)
def test_starts_that_are_none_are_one_line(others, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        task(swing(1.0, 0.0), **others)
    assert "\n" not in str(refusal.value)


def tumble():
    """Closed form of the robot's torso with its limb removed: it spins evenly, and falls."""
    times = 0.01 * np.arange(80)
    spin, first = np.array([0.5, -2.0, 1.2]), np.array([0.6, 0.0, 0.8, 0.0])
    place = np.array([0.2, -0.1, 1.4]) + np.outer(times, [0.7, 0.2, 1.0]) - np.outer(times**2, [0, 0, 1.0])
    half = 0.5 * np.linalg.norm(spin) * times
    axis = spin / np.linalg.norm(spin)
    other = np.column_stack([np.cos(half), np.sin(half)[:, None] * axis])
    turned = np.zeros_like(other)
    for row, own in zip(turned, other, strict=True):
        mujoco.mju_mulQuat(row, first, own)
    return times, place, turned, spin


def test_a_free_body_begins_with_the_velocity_and_the_spin_that_it_is_seen_with():
    times, place, quaternions, spin = tumble()
    xml = ROBOT.replace('<joint axis="0 1 0" damping="0.1"/>', "").replace('size="0.02"/>', 'size="0.02" mass="1e-9"/>')
    xml = xml[: xml.index("<keyframe>")] + "</mujoco>"
    rng = np.random.default_rng(0)
    columns = [*place.T, *quaternions.T]
    names = [f"body/torso/pos[{i}]" for i in range(3)] + [f"body/torso/quat[{i}]" for i in range(4)]
    noisy = {name: own + 0.001 * rng.standard_normal(len(times)) for name, own in zip(names, columns, strict=True)}
    noisy["body/torso/quat[0]"][40:] *= -1  # a tracker that changes the sign
    for i in range(1, 4):
        noisy[f"body/torso/quat[{i}]"][40:] *= -1
    parameter = Parameter("body/torso/mass", (1.0, 3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = mujoco_task(xml, [parameter], Log(times, noisy), noises=dict.fromkeys(names, 0.001))
    (start,) = simulator_of(own).starts
    deviations = np.linalg.norm(start.root, axis=-1)
    assert (np.abs(start.state[1:4] - place[0]) < 4 * deviations[:3, 0]).all()
    assert (np.abs(start.state[8:] - [0.7, 0.2, 1.0, *spin]) < 4 * deviations[:, 1]).all() and deviations.max() < 0.2
    clean, _ = simulator_of(own).clean([[2.0]])
    np.testing.assert_allclose(clean[0, :20, :3], place[:20], atol=0.03)
    signs = np.where(np.arange(20) < 40, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(clean[0, :20, 3:], signs * quaternions[:20], atol=0.03)


def test_turning_is_that_of_mujoco():
    model = mujoco.MjModel.from_xml_string(ROBOT)
    rng = np.random.default_rng(3)
    qpos, by = model.key_qpos[0].copy(), rng.standard_normal((5, model.nv))
    expected = np.tile(qpos, (5, 1))
    for row, own in zip(expected, by, strict=True):
        mujoco.mj_integratePos(model, row, own, 1.0)
    start = starts.certain(model, np.concatenate([[0.0], qpos, np.zeros(model.nv)]))
    np.testing.assert_allclose(starts.moved(start.joints, qpos, by), expected, atol=1e-12)


def test_a_robot_with_a_keyframe_a_free_joint_and_joints_without_names_runs_as_it_is():
    log = Log(
        0.01 * np.arange(60), {"joint/1/qpos": 0.35 - 0.01 * np.arange(60), "body/torso/pos[2]": np.full(60, 0.7)}
    )
    parameters = [Parameter("joint/1/damping", (0.05, 0.5)), Parameter("body/2/mass", (0.1, 1.0))]
    noises = {"joint/1/qpos": 0.01, "body/torso/pos[2]": 0.5}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = mujoco_task(ROBOT, parameters, log, noises=noises, begins="keyframe home")
    rows, outcome = simulator_of(own).clean([[0.3, 0.4]])
    spec = mujoco.MjSpec.from_string(ROBOT)
    spec.joints[1].damping[0] = 0.3
    model = spec.compile()
    model.body_inertia[2] *= 0.4 / model.body_mass[2]
    model.body_mass[2] = 0.4
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for step in range(296):
        if step % 5 == 0:
            np.testing.assert_allclose(rows[0, step // 5], [data.qpos[7], data.qpos[2]], atol=1e-9)
        mujoco.mj_step(model, data)
    assert outcome.tolist() == [0] and np.ptp(rows[0, :, 0]) > 0.01
    with pytest.raises(
        ValueError, match="from: expected a log that measures all joints, got none of 0 in log: give 0/q"
    ):
        mujoco_task(ROBOT, parameters, log, noises=noises, begins="log")


def test_what_sensors_do_to_a_start_is_undone():
    """An angle that is measured late, with a gain and an offset."""
    plain = swing(1.0, -2.0, noise=0.0, count=330)
    late, gain, bias = 0.03, 1.3, -0.2
    measured = gain * plain.signals["angle"][27:327] + bias
    log = Log(plain.times[:300], {"angle": measured})
    parameters = [
        Parameter(f"sensor/angle/{name}", (0.0 if name == "delay" else -2.0, 2.0)) for name in ("gain", "bias")
    ]
    parameters.append(Parameter("sensor/angle/delay", (0.0, 0.1)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = task(log, [DAMPING, *parameters])
    rows, _ = simulator_of(own).clean([[0.05, gain, bias, late]])
    np.testing.assert_allclose(rows[0, 3:, 0], measured[3:], atol=0.02)
    state = simulator_of(own).begun(0, np.array([0.05, gain, bias, late]))
    assert state[1] == pytest.approx(plain.signals["angle"][30], abs=0.005)
    assert state[2] == pytest.approx((plain.signals["angle"][31] - plain.signals["angle"][29]) / 0.02, abs=0.1)


def test_compiled_programs_begin_there_too():
    model = mujoco.MjModel.from_xml_string(ROBOT)
    rng = np.random.default_rng(5)
    state = np.concatenate([[0.0], model.key_qpos[0], rng.standard_normal(model.nv)])
    start = starts.Start(
        state, rng.standard_normal(model.nv), rng.standard_normal((model.nv, 2, 2)), np.arange(model.nv) - 2, {9: 0.3},
        starts.certain(model, state).joints,
    )  # fmt: skip
    does = Effects(gains=((0, 0),), biases=((4, 1),), lags=((0, 2), (4, 2)))
    theta, draws = np.array([1.4, 0.2, 0.03]), rng.standard_normal((model.nv, 2))
    expected = start.at(does, np.tile(theta, (3, 1)), np.tile(draws, (3, 1, 1)))
    assert expected[1, 9] == 0.3
    np.testing.assert_allclose(start.at(does, jnp.asarray(theta), jnp.asarray(draws), jnp), expected[1], atol=1e-5)


def test_filters_of_actuators_begin_with_the_first_control():
    xml = PENDULUM.replace("<sensor>", '<actuator><general name="motor" joint="hinge" dyntype="filter" dynprm="0.1"/>'
                           "</actuator><sensor>")  # fmt: skip
    xml = xml[: xml.index("<keyframe>")] + "</mujoco>"
    plain = swing(1.0, 0.0)
    log = Log(plain.times, {"motor": np.full(300, 0.7), "angle": plain.signals["angle"]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = mujoco_task(xml, [DAMPING], log, noises={"angle": 0.002})
    assert begins(own)[0][3] == 0.7
