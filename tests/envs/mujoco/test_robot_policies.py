"""What policies of robots need, in episodes of a carriage with a servo and a winch, against MuJoCo's own steps."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("mujoco.mjx")
pytest.importorskip("brax")

import jax
import jax.numpy as jnp

from jaxlfi.envs.mujoco.environment import MujocoEnvironment
from jaxlfi.envs.mujoco.goal import Goal, Reading
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.rl.preparation import Control, Signal

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
GOAL = Goal(
    ("place", "joint/winch/qpos", "joint/winch/qvel"),
    interval=0.05,
    duration=1.0,
    targets={"place": (0.4, 2.0), "joint/winch/qpos": (9.0, 0.5)},
    limits={"servo": (-1.0, 0.6), "pull": (-0.5, 2.0)},
    costs={"servo": 0.3},
    scales={"joint/winch/qvel": 4.0},
    initial={"rail/qpos": (0.2, 0.3)},
    turns=("joint/winch/qpos",),
    history=2,
    actions=1,
    rates={"servo": 2.0},
    displacing=("servo",),
)


@pytest.fixture(scope="module")
def carriage():
    return MujocoEnvironment(CARRIAGE, [DAMPING], GOAL)


def test_episodes_are_those_of_commanded_controls(carriage):
    """The servo's target begins where the carriage is, and moves by the actions, 0.1 at most; turns are counted."""
    state = jax.jit(carriage.reset)(jax.random.key(0), jnp.array([0.8]))
    step, model = jax.jit(carriage.step), mujoco.MjModel.from_xml_string(CARRIAGE)
    model.dof_damping[0] = 0.8
    data = mujoco.MjData(model)
    data.qpos[0] = target = float(state.inner.state.qpos[0])
    assert 0.2 <= target <= 0.3 and target == state.observation[0]
    seen, rng = [np.array([target, 0.0, 0.0])], np.random.default_rng(1)
    for _ in range(8):
        action = np.array([rng.uniform(-0.05, 0.2), rng.uniform(1.0, 2.0)])
        state = step(state, jnp.asarray(action, jnp.float32))
        target = min(target + min(action[0], 0.1), 0.6)
        data.ctrl[:] = target, action[1]
        mujoco.mj_step(model, data, 5)
        seen.append(np.array([*data.qpos, data.qvel[1]]))
        np.testing.assert_allclose(state.observation, [*seen[-1], *seen[-2], target, action[1]], rtol=1e-4, atol=1e-4)
        cost = 2.0 * (data.qpos[0] - 0.4) ** 2 + 0.5 * (data.qpos[1] - 9.0) ** 2 + 0.3 * ((target + 0.2) / 0.8) ** 2
        assert state.reward == pytest.approx(-0.05 * cost, rel=1e-3)
    assert target == 0.6 and data.qpos[1] > 2 * np.pi


def test_it_says_what_a_robot_measures_and_is_commanded(carriage):
    prepared = carriage.preparation
    signals = Signal("place", "m"), Signal("joint/winch/qpos", "rad"), Signal("joint/winch/qvel", "rad/s")
    assert prepared.signals == signals
    servo = Control("servo", -1.0, 0.6, "m", rate=2.0, displacing=True, begins=0)
    assert prepared.controls == (servo, Control("pull", -0.5, 2.0))
    assert (prepared.interval, prepared.steps, prepared.history, prepared.actions) == (0.05, 20, 2, 1)
    assert prepared.names == carriage.observations.names
    assert carriage.observations.scale == (1.0, 1.0, 4.0, 1.0, 1.0, 4.0, 0.8, 1.25)
    np.testing.assert_allclose(carriage.observations.centre, (*[0.0] * 6, -0.2, 0.75), atol=1e-12)
    np.testing.assert_allclose([carriage.actions.centre, carriage.actions.scale], [[0.0, 0.75], [0.1, 1.25]])


def reading(**changes):
    fields = {name: getattr(GOAL, name) for name in GOAL.__dataclass_fields__}
    goal = Goal(**fields | changes)
    spec = specification(CARRIAGE)
    add_sensors(spec, goal.signals)
    return Reading(compile_spec(spec), goal)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"turns": ("place",)}, "turns: expected positions of hinges without a range (joint/winch/qpos), got place"),
        ({"turns": ("turn",)}, "turns: expected positions of hinges without a range (joint/winch/qpos), got turn"),
        ({"rates": {"motor": 1.0}}, "rates: expected actuators of the model (servo, pull), got motor"),
        ({"displacing": ("motor",)}, "displacing: expected actuators of the model (servo, pull), got motor"),
        ({"displacing": ("pull",)}, "displacing: pull: expected a rate"),
        ({"rates": {"servo": -1.0}}, "rates: servo: expected a rate of more than 0 per second, got -1"),
        ({"observed": ("turn",), "turns": (), "scales": {}}, "rates: servo: expected the position of the joint 'rail'"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(ValueError) as refusal:
        reading(**changes)
    assert str(refusal.value).startswith("policy: ") and message in str(refusal.value)
    assert "\n" not in str(refusal.value)
