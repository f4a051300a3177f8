"""What policies of robots need, in episodes of a carriage with a servo and a winch, against MuJoCo's own steps."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("mujoco.mjx")
pytest.importorskip("brax")

import jax
import jax.numpy as jnp

from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.effects import Effects, built
from jaxlfi.envs.mujoco.environment import MujocoEnvironment
from jaxlfi.envs.mujoco.forces import UnmodelledForces
from jaxlfi.envs.mujoco.goal import Goal, Target
from jaxlfi.envs.mujoco.mjx_models import added, with_forces
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.envs.mujoco.parameters import Parameter, edit
from jaxlfi.envs.mujoco.reading import Reading, add_signals
from jaxlfi.rl.preparation import Command, Control, Signal
from jaxlfi.rl.termination import parsed

CARRIAGE = """
<mujoco model="carriage">
  <option timestep="0.01"/>
  <worldbody>
    <body name="carriage">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.4"/>
      <geom size="0.1" mass="1.2"/>
    </body>
    <body name="drum" pos="0 1 0">
      <joint name="winch" axis="0 1 0" damping="0.05"/>
      <geom type="cylinder" size="0.1 0.05" mass="0.7"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="rail" kp="60" kv="9"/>
    <motor name="pull" joint="winch" gear="2"/>
  </actuator>
  <sensor><jointpos name="place" joint="rail"/><jointpos name="turn" joint="winch"/></sensor>
</mujoco>
"""
DAMPING = Parameter("joint/rail/damping", (0.1, 2.0))
DELAY = Parameter("sensor/place/delay", (0.0, 0.04), (0.0, 0.06), "s")
GOAL = Goal(
    ("place", "joint/winch/qpos", "joint/winch/qvel"),
    interval=0.05,
    duration=1.0,
    targets={
        "place": (0.4, 2.0),
        "joint/winch/qpos": (23.0, 0.02),
        "joint/rail/qvel": Target("speed", 3.0, within=0.7),
    },
    limits={"servo": (-1.0, 0.6), "pull": (-0.5, 2.0)},
    costs={"servo": 0.3},
    scales={"joint/winch/qvel": 4.0},
    initial={"rail/qpos": (0.2, 0.3)},
    turns=("joint/winch/qpos",),
    history=2,
    actions=1,
    rates={"servo": 2.0},
    displacing=("servo",),
    change_costs={"pull": 0.2},
    alive=1.5,
    commands={"speed": (-0.5, 2.0)},
    terminations={"wound": parsed("turn > 21", cost=4.0), "back": parsed("abs(place) < 0.1")},
    action_delay=(0.02, 0.07),
    observation_delay=(0.0, 0.03),
)
FORCES = UnmodelledForces(np.array([3.0, 0.0]), np.array([0.4, 0.02]), np.zeros(2))
"""Without friction, which MJX would compile its solver for."""


@pytest.fixture(scope="module")
def carriage():
    errors = {"joint/winch/qvel": Discrepancy(0.3, 0.1)}
    return MujocoEnvironment(CARRIAGE, [DAMPING, DELAY], GOAL, forces=FORCES, discrepancies=errors)


@pytest.fixture(scope="module")
def stepped(carriage):
    return jax.jit(carriage.step)


@pytest.fixture(scope="module")
def begun(carriage):
    """Starts of 300 episodes."""
    theta = jnp.stack([jnp.full(300, 0.8), jnp.linspace(0.06, 0.0, 300)], axis=1)
    return jax.jit(jax.vmap(carriage.reset))(jax.random.split(jax.random.key(2), 300), theta)


def lacking(model, coefficients):
    """Adds what a model lacks of rail and winch: springs, dampers, dry friction."""
    for joint in range(2):
        model.jnt_stiffness[joint] += coefficients[joint]
        model.dof_damping[joint] = max(model.dof_damping[joint] + coefficients[2 + joint], 0.0)
        model.dof_frictionloss[joint] = max(model.dof_frictionloss[joint] + coefficients[4 + joint], 0.0)


@pytest.mark.parametrize("coefficients", [[3.0, -0.1, 0.2, -9.0, 0.7, 0.0], [0.0, 0.0, -0.1, 0.3, -2.0, 0.0]])
def test_forces_that_a_model_lacks_are_in_its_numbers(coefficients):
    forces = UnmodelledForces(np.ones(2), np.ones(2), np.array([1.0, 0.0]))
    spec, low, high = specification(CARRIAGE), np.array([0.1], np.float32), np.array([2.0], np.float32)
    build = lambda theta: built(spec, Effects(((edit(spec, spec.compile(), DAMPING.name), 0),)), theta)
    models = with_forces(build, forces, [DAMPING.name], np.array([0.5]), Support(low, high))
    numbers, _ = models.numbers(jnp.array([0.8, *[0.0] * 6]))
    got, expected = added(models.model(numbers), forces, jnp.array(coefficients)), build(np.array([0.8]))
    lacking(expected, coefficients)
    for field in ("jnt_stiffness", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(got, field), getattr(expected, field), rtol=1e-6, atol=1e-8, err_msg=field)


@pytest.mark.slow
@pytest.mark.parametrize("episode", [0, 1, 170])
def test_episodes_are_those_of_commanded_controls(episode, carriage, stepped, begun):
    """The servo's target begins where the carriage is, and moves by the actions, 0.1 at most; turns are counted.

    The carriage's place is seen as late as all signals, and by the delay of its own sensor later.
    """
    state = jax.tree.map(lambda leaf: leaf[episode], begun)
    drawn, model = state.inner.drawn, mujoco.MjModel.from_xml_string(CARRIAGE)
    model.dof_damping[0] = 0.8
    lacking(model, np.asarray(state.inner.lacking, float))
    data = mujoco.MjData(model)
    data.qpos[0] = target = float(state.inner.state.qpos[0])
    speed, pull, waits = float(state.observation[-1]), 0.0, float(drawn.action_delay)
    late = float(drawn.observation_delay) + np.array([float(state.inner.theta[1]), 0.0, 0.0])
    assert 0.2 <= target <= 0.3 and target == state.observation[0] and -0.5 <= speed <= 2.0 and 0.02 <= waits <= 0.07
    passed, seen = [np.array([target, 0.0, 0.0])] * 10, [np.asarray(state.observation[:3], float)]
    given, rng, over = [np.array([target, 0.0])], np.random.default_rng(1), False
    for interval in range(8):
        assert not over
        action = np.array([rng.uniform(-0.05, 0.2), rng.uniform(1.0, 2.0)])
        state = stepped(state, jnp.asarray(action, jnp.float32))
        target = min(target + min(action[0], 0.1), 0.6)
        given.append(np.array([target, action[1]]))
        for substep in range(5):
            data.ctrl[:] = given[max(int(np.floor(interval + 1 + (0.01 * substep - waits) / 0.05 + 1e-5)), 0)]
            mujoco.mj_step(model, data)
            passed.append(np.array([*data.qpos, data.qvel[1]]))
        ago = 0.01 * np.arange(len(passed))[::-1]
        then = [np.interp(-one, -ago, column) for one, column in zip(late, np.array(passed).T, strict=True)]
        seen.append(np.add(then, [0.0, 0.0, float(state.inner.drawn.errors[2])]))
        expected = [*seen[-1], *seen[-2], target, action[1], speed]
        np.testing.assert_allclose(state.observation, expected, rtol=1e-3, atol=1e-3)
        cost = 2.0 * (data.qpos[0] - 0.4) ** 2 + 0.02 * (data.qpos[1] - 23.0) ** 2 + 0.3 * ((target + 0.2) / 0.8) ** 2
        cost += 0.2 * ((action[1] - pull) / 1.25) ** 2
        gain, over, pull = 3.0 * np.exp(-(((data.qvel[0] - speed) / 0.7) ** 2)), data.qpos[1] > 21, action[1]
        expected = -4.0 - 0.05 * (cost - gain) if over else 0.05 * (gain + 1.5 - cost)
        assert state.reward == pytest.approx(expected, rel=1e-2)
        assert state.terminated == over == state.facts["wound"] and not (state.facts["back"] or state.truncated)
    assert target == 0.6 and data.qpos[1] > 4 * np.pi
    assert stepped._cache_size() == 1  # other delays are the same program
    assert state.facts["joint/rail/qvel off"] == pytest.approx(abs(data.qvel[0] - speed), rel=1e-2)


def test_commands_and_forces_are_drawn_anew_for_each_episode(begun):
    speeds = np.sort(np.asarray(begun.observation[:, -1]))
    assert np.abs(speeds - np.linspace(-0.5, 2.0, 300)).max() < 0.25
    lacking = np.asarray(begun.inner.lacking)
    np.testing.assert_allclose(lacking.std(axis=0), FORCES.deviations, rtol=0.15)
    assert abs(np.corrcoef(begun.observation[:, 0], begun.observation[:, -1])[0, 1]) < 0.15


def test_it_says_what_a_robot_measures_and_is_commanded(carriage):
    prepared = carriage.preparation
    signals = Signal("place", "m"), Signal("joint/winch/qpos", "rad"), Signal("joint/winch/qvel", "rad/s")
    assert prepared.signals == signals
    servo = Control("servo", -1.0, 0.6, "m", rate=2.0, displacing=True, begins=0)
    assert prepared.controls == (servo, Control("pull", -0.5, 2.0))
    assert (prepared.observation_delay, prepared.action_delay) == ((0.0, 0.03), (0.02, 0.07))
    assert (prepared.interval, prepared.steps, prepared.history, prepared.actions) == (0.05, 20, 2, 1)
    assert prepared.names == carriage.observations.names
    assert prepared.commands == (Command("speed", -0.5, 2.0, "m/s"),)
    assert {name: (str(one), one.unit) for name, one in prepared.terminations.items()} == {
        "wound": ("turn > 21", "rad"),
        "back": ("abs(place) < 0.1", "m"),
    }
    assert carriage.observations.scale == (1.0, 1.0, 4.0, 1.0, 1.0, 4.0, 0.8, 1.25, 1.25)
    np.testing.assert_allclose(carriage.observations.centre, (*[0.0] * 6, -0.2, 0.75, 0.75), atol=1e-12)
    np.testing.assert_allclose([carriage.actions.centre, carriage.actions.scale], [[0.0, 0.75], [0.1, 1.25]])


def reading(**changes):
    fields = {name: getattr(GOAL, name) for name in GOAL.__dataclass_fields__}
    goal = Goal(**fields | changes)
    spec = specification(CARRIAGE)
    add_signals(spec, goal)
    return Reading(compile_spec(spec), goal)


def test_rewards_of_ones_own_are_in_place_of_targets_and_costs():
    """What is there for being alive, and the costs of ends, are besides; commands are among the signals."""
    own = lambda signals, controls: 2.0 * signals["command speed"] + controls["pull"] - signals["place"]
    values, control, last = np.array([0.05, 22.0, 3.0, 1.0, 22.0]), np.array([0.4, 0.7]), np.zeros(2)
    ours = reading(reward=own, targets={})
    assert ours.goal.signals == ("place", "joint/winch/qpos", "joint/winch/qvel", "turn")
    ended = {"wound": True, "back": True}
    assert ours.ended(values[[0, 1, 2, 4]]) == ended
    assert ours.reward(values[[0, 1, 2, 4]], control, last, np.array([1.5]), np) == pytest.approx(3.65 - 4.0)
    values[[0, 4]] = 0.3, 2.0
    assert ours.reward(values[[0, 1, 2, 4]], control, last, np.array([1.5]), np) == pytest.approx(3.4 + 0.05 * 1.5)


def test_rewards_near_an_angle_go_the_shorter_way_round():
    ours = reading(
        turns=(), targets={"joint/winch/qpos": Target(3.0, 2.0, 0.5)}, costs={}, change_costs={}, commands={}
    )
    values = np.array([0.3, -3.0, 0.0, -3.0])
    expected = 0.05 * (2.0 * np.exp(-2 * (1 - np.cos(6.0)) / 0.25) + 1.5)
    assert ours.reward(values, np.zeros(2), np.zeros(2), (), np) == pytest.approx(expected)
    assert ours.off(values, (), np)["joint/winch/qpos"] == pytest.approx(2 * np.pi - 6.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"turns": ("place",)}, "turns: expected positions of hinges without a range (joint/winch/qpos), got place"),
        ({"turns": ("turn",)}, "turns: expected positions of hinges without a range (joint/winch/qpos), got turn"),
        ({"rates": {"motor": 1.0}}, "rates: expected actuators of the model (servo, pull), got motor"),
        ({"displacing": ("motor",)}, "displacing: expected actuators of the model (servo, pull), got motor"),
        (
            {"limits": {"servo": (-np.inf, 1.0), "pull": (0.0, 1.0)}},
            "limits: servo: expected LOW below HIGH, both finite",
        ),
        ({"displacing": ("pull",)}, "displacing: pull: expected a rate"),
        ({"rates": {"servo": -1.0}}, "rates: servo: expected a rate of more than 0 per second, got -1"),
        ({"observed": ("turn",), "turns": (), "scales": {}}, "rates: servo: expected the position of the joint 'rail'"),
        ({"change_costs": {"motor": 1.0}}, "change_costs: expected actuators of the model (servo, pull), got motor"),
        (
            {"terminations": {"lost": parsed("body/carrage/pos[0] < 1")}},
            "terminations: lost: 'body/carrage/pos[0]': ex",
        ),
        ({"terminations": {"lost": parsed("plaice < 1")}}, "terminations: lost: expected a sensor such as place"),
        (
            {"targets": {"joint/raid/qvel": (1.0, 1.0)}, "commands": {}},
            "targets: 'joint/raid/qvel': expected one such as",
        ),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(ValueError) as refusal:
        reading(**changes)
    assert str(refusal.value).startswith("policy: ") and message in str(refusal.value)
    assert "\n" not in str(refusal.value)
