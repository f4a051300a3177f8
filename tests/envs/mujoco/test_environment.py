"""Environments of MuJoCo models, against MuJoCo's own steps of a model that was edited by hand."""

import dataclasses
import tomllib
import warnings

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")
pytest.importorskip("brax")

import chex
import jax
import jax.numpy as jnp
from envs_mujoco import ARM

from jaxlfi.envs.mujoco import config, goal
from jaxlfi.envs.mujoco.environment import TRAINING, IdleParameterWarning, MujocoEnvironment, environment
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.envs.mujoco.mjx_effects import passed_by
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.rl import ppo
from jaxlfi.rl.domains import uniform
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.settings import PPO
from jaxlfi.robots import velocities
from jaxlfi.robots.settings import Velocity

INTERVAL = 0.02
GOAL = Goal(
    ("angle", "joint/shoulder/qvel", "joint/elbow/qpos", "velocity[2]"),
    INTERVAL,
    duration=0.2,
    targets={"angle": (0.4, 2.0), "velocity[0]": (0.1, 0.5)},
    costs={"motor": 0.3},
    limits={"motor": (-1.0, 2.0)},
    scales={"velocity[2]": 3.0},
)
PARAMETERS = (
    Parameter("joint/elbow/damping", (0.01, 0.2), (0.001, 1.0), "N m s/rad", log=True),
    Parameter("joint/shoulder/frictionloss", (0.01, 0.1), (0.0, 0.5), "N m"),
    Parameter("body/fore/mass", (0.05, 0.3), (0.01, 1.0), "kg"),
    Parameter("actuator/motor/gear[0]", (1.0, 2.0)),
    Parameter("option/gravity[2]", (-11.0, -9.0)),
    Parameter("initial/elbow/qpos", (-1.0, 1.0)),
    Parameter("control/delay", (0.0, 0.05), unit="s"),
    Parameter("sensor/angle/bias", (-0.2, 0.2), unit="rad"),
)
THETA = np.array(
    [
        [0.013, 0.07, 0.11, 1.7, -9.2, 0.6, 0.0, 0.13],
        [0.9, 0.0, 0.93, 1.1, -10.7, -0.9, 0.028, -0.04],  # a friction of zero, as at the bound of Phi
        [0.04, 0.31, 0.02, 1.4, -9.8, 0.1, 0.05, 0.0],
    ],
    np.float32,
)
ACTIONS = np.array([0.8, 1.9, -0.7, -0.9, 0.2, 1.3], np.float32)[:, None]


@pytest.fixture(scope="module")
def arm():
    return MujocoEnvironment(ARM, PARAMETERS, GOAL)


@pytest.fixture(scope="module")
def compiled(arm):
    """Reset and step of three episodes side by side."""
    return jax.jit(jax.vmap(arm.reset)), jax.jit(jax.vmap(arm.step))


def native(theta):
    """Signals of the goal after each action, as MuJoCo's own steps give them."""
    damping, friction, mass, gear, gravity, elbow, delay, _ = (float(number) for number in theta)
    spec = mujoco.MjSpec.from_string(ARM)
    geom = spec.body("fore").geoms[0]
    geom.density *= mass / spec.compile().body("fore").mass[0]
    spec.joint("elbow").damping[0] = damping
    spec.joint("shoulder").frictionloss = friction
    spec.actuator("motor").gear[0] = gear
    spec.option.gravity[2] = gravity
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    data.qpos[1] = elbow
    substeps = round(INTERVAL / model.opt.timestep)
    for interval in range(len(ACTIONS)):
        for substep in range(substeps):
            asked = int(np.floor(interval + (substep * model.opt.timestep - delay) / INTERVAL + 1e-5))
            data.ctrl[0] = ACTIONS[asked, 0] if asked >= 0 else 0.0
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        rows.append([*data.qpos, data.qvel[0], data.sensor("velocity").data[0], data.sensor("velocity").data[2]])
    return np.array(rows)


def test_episodes_are_those_of_the_model_that_mujoco_compiles(arm, compiled):
    reset, step = compiled
    state = reset(jax.random.split(jax.random.key(0), 3), jnp.asarray(THETA))
    seen, rewards = [], []
    for action in ACTIONS:
        state = step(state, jnp.tile(action, (3, 1)))
        seen.append(state.observation)
        rewards.append(state.reward)
    assert step._cache_size() == 1
    seen, rewards = np.stack(seen, axis=1), np.stack(rewards, axis=1)
    for row, theta in enumerate(THETA):
        shoulder, elbow, speed, sideways, up = native(theta).T
        biased = shoulder + theta[-1]
        expected = [np.cos(biased), np.sin(biased), speed, np.cos(elbow), np.sin(elbow), up]
        np.testing.assert_allclose(seen[row], np.stack(expected, axis=1), atol=2e-3)
        share = (ACTIONS[:, 0] - 0.5) / 1.5
        cost = 2.0 * 2 * (1 - np.cos(shoulder - 0.4)) + 0.5 * (sideways - 0.1) ** 2 + 0.3 * share**2
        np.testing.assert_allclose(rewards[row], -INTERVAL * cost, atol=2e-4)
    assert np.abs(seen[0] - seen[1]).max() > 0.3 and np.abs(seen[1] - seen[2]).max() > 0.3
    np.testing.assert_allclose(state.facts["velocity[0] off"], [abs(native(t)[-1, 3] - 0.1) for t in THETA], atol=2e-3)


def test_numbers_that_mujoco_derives_are_in_the_model(arm):
    """MJX derives none of these constants for changed masses."""
    assert {"body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0"} <= {
        *arm.models.varied
    }
    numbers, refused = jax.jit(jax.vmap(arm.models.numbers))(jnp.asarray(THETA))
    for theta, row in zip(THETA, numbers, strict=True):
        model = arm.models.model(row)
        one = mujoco.MjSpec.from_string(ARM)
        one.body("fore").geoms[0].density *= theta[2] / one.compile().body("fore").mass[0]
        oracle = one.compile()
        for field in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0"):
            np.testing.assert_allclose(getattr(model, field), getattr(oracle, field), rtol=1e-5, err_msg=field)
    assert not refused.any()


@pytest.mark.slow
def test_one_episode_is_as_in_a_batch(arm, compiled):
    reset, step = compiled
    keys = jax.random.split(jax.random.key(1), 3)
    many = reset(keys, jnp.asarray(THETA))
    alone = arm.reset(jax.random.clone(keys)[1], jnp.asarray(THETA[1]))  # not compiled
    np.testing.assert_allclose(alone.observation, many.observation[1], atol=1e-5)
    np.testing.assert_array_equal(alone.inner.numbers, many.inner.numbers[1])
    same = many.replace(inner=many.inner.replace(key=jax.random.clone(many.inner.key)))
    again = step(many, jnp.full((3, 1), 0.4, jnp.float32))
    thrice = step(jax.tree.map(lambda leaf: leaf[jnp.array([1, 1, 1])], same), jnp.full((3, 1), 0.4, jnp.float32))
    np.testing.assert_allclose(thrice.observation[2], again.observation[1], atol=1e-5)


def test_unstable_simulations_and_refused_models_end_episodes(arm, compiled):
    reset, step = compiled
    wrong = THETA.copy()
    wrong[1, 2] = -1.0  # a negative mass
    state = reset(jax.random.split(jax.random.key(0), 3), jnp.asarray(wrong))
    inner = state.inner
    fast = inner.state.replace(qvel=inner.state.qvel.at[2].set(1e12))
    state = state.replace(inner=inner.replace(state=fast))
    after = step(state, jnp.zeros((3, 1)))
    assert after.truncated.tolist() == [False, True, True] == after.facts["failed"].tolist()
    assert after.reward[1:].tolist() == [0.0, 0.0] and not after.terminated.any()
    assert np.isfinite(after.observation).all()
    np.testing.assert_array_equal(after.observation[2], state.observation[2])


def test_it_is_an_environment(arm):
    assert isinstance(arm, Environment)
    assert arm.space.names == tuple(one.name for one in PARAMETERS) and arm.space.log == (True, *[False] * 7)
    assert arm.observations.names == (
        *("cos angle", "sin angle", "joint/shoulder/qvel", "cos joint/elbow/qpos", "sin joint/elbow/qpos"),
        "velocity[2]",
    )
    assert arm.observations.units == ("", "", "rad/s", "", "", "") and arm.observations.scale[-1] == 3.0
    assert arm.actions.centre == (0.5,) and arm.actions.scale == (1.5,)
    assert arm.steps == 10 and arm.nominal[0] == pytest.approx(np.sqrt(0.01 * 0.2))


PLAIN = Goal(("angle",), INTERVAL, 0.1, {"angle": (0.4, 1.0)}, limits={"motor": (-1.0, 1.0)})


@pytest.mark.slow
def test_it_is_one_of_gymnasium_and_of_brax(arm):
    """Any environment's adapters serve; the control of 2 at the end of its range is an action of 1 in Brax."""
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    from jaxlfi.rl.gym import GymEnvironment, GymVector
    from jaxlfi.rl.to_brax import ToBrax

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(infinity|render|normalized)")
        check_env(GymEnvironment(arm, THETA[0]))
    many = GymVector(3, arm, THETA, "SameStep")
    _, info = many.reset(seed=0)
    np.testing.assert_allclose(np.stack([info[name] for name in arm.space.names], axis=1), THETA)
    over = [many.step(np.tile(ACTIONS[0], (3, 1)))[3].tolist() for _ in range(arm.steps)]
    assert over == [[False] * 3] * (arm.steps - 1) + [[True] * 3]
    brax = ToBrax(arm, THETA[0])
    state = jax.jit(brax.step)(jax.jit(brax.reset)(jax.random.key(0)), jnp.ones(1))
    single = GymEnvironment(arm, THETA[0])
    single.reset(seed=0)
    own, reward, *_ = single.step([2.0])
    np.testing.assert_allclose(state.obs, arm.observations.to_unit(own), atol=1e-5)
    np.testing.assert_allclose(state.reward, reward, rtol=1e-5)


@pytest.mark.slow
def test_first_states_are_drawn_and_noise_is_added():
    spread = Goal(
        ("angle", "joint/shoulder/qpos"),
        INTERVAL,
        duration=0.1,
        limits=PLAIN.limits,
        initial={"shoulder/qpos": (0.2, 0.7)},
        reward=lambda signals, controls: signals["angle"] - controls["motor"],
    )
    noisy = Parameter("sensor/angle/noise", (0.01, 0.1))
    unseen = Parameter("sensor/velocity[1]/bias", (-1.0, 1.0))
    env = MujocoEnvironment(ARM, [PARAMETERS[0], noisy, unseen], spread)
    theta = jnp.tile(jnp.asarray([0.05, 0.08, 0.3]), (400, 1))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 400), theta)
    start = state.inner.state.qpos[:, 0]
    assert 0.2 <= start.min() < 0.22 and 0.68 < start.max() <= 0.7
    angle = jnp.arctan2(state.observation[:, 1], state.observation[:, 0])
    assert (angle - start).std() == pytest.approx(0.08, rel=0.15)
    assert env.reading.reward(np.array([0.5, 0.1]), np.array([0.2]), np.array([0.0]), (), np) == pytest.approx(0.3)


def test_parameters_that_make_no_difference_to_policies_are_named():
    doubted = [
        Parameter("sensor/angle/delay", (0.0, 0.05)),
        Parameter("sensor/velocity[1]/bias", (-1.0, 1.0)),
        Parameter("initial/elbow/qpos", (-1.0, 1.0)),
        Parameter("episode/0/initial/shoulder/qpos", (-1.0, 1.0)),
    ]
    drawn = dataclasses.replace(PLAIN, initial={"elbow/qpos": (0.2, 0.7)})
    with pytest.warns(IdleParameterWarning) as said:
        MujocoEnvironment(ARM, doubted, drawn)
    assert [str(one.message).removeprefix("parameters: ") for one in said] == [
        "sensor/velocity[1]/bias makes no difference to policies: policies do not observe the signal",
        "initial/elbow/qpos makes no difference to policies: [policy.initial] draws that number",
        "episode/0/initial/shoulder/qpos makes no difference to policies: a recorded episode begins there, and others "
        "do not",
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error", IdleParameterWarning)
        MujocoEnvironment(ARM, [doubted[0], doubted[2], Parameter("sensor/*/noise", (0.01, 0.02), tie="shared")], PLAIN)


SLIDE = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody><body><joint name="rail" type="slide"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="motor" joint="rail"/></actuator>
  <sensor><jointpos name="angle" joint="rail"/></sensor>
</mujoco>
"""


PUSHED = (
    SLIDE.replace("0.02", "0.001")
    .replace('size="0.1"', 'size="0.1" mass="0.4"')
    .replace("<option", "<option gravity='0 0 0'")
)


@pytest.fixture(scope="module")
def pushes():
    """Speeds of many carts after actions of a policy, with the same delay and jitter."""
    doubted = [Parameter("control/delay", (0.0, 0.04)), Parameter("clock/jitter", (0.0, 0.02))]
    watching = Goal(("joint/rail/qvel",), INTERVAL, 0.2, {"angle": (0.4, 1.0)}, limits={"motor": (-2.0, 2.0)})
    env = MujocoEnvironment(PUSHED, doubted, watching)

    @jax.jit
    @jax.vmap
    def speeds(key, theta, actions):
        step = lambda state, action: (after := env.step(state, action), after.observation[0])
        return jax.lax.scan(step, env.reset(key, theta), actions)[1]

    def after(delay, jitter, actions, count=1000):
        keys = jax.random.split(jax.random.key(4), count)
        rows = np.tile(np.array([delay, jitter], np.float32), (count, 1))
        return np.asarray(speeds(keys, rows, np.tile(np.array(actions, np.float32)[:, None], (count, 1, 1))))

    return after


@pytest.mark.slow
def test_controls_of_policies_act_at_times_that_spread(pushes):
    """As in inference (test_sensors.py): a push from 0.04 s on, until the end at 0.16 s."""
    last = pushes(0.03, 0.006, [0, 0, 1.2, 1.2, 1.2, 1.2, 1.2, 1.2])[:, -1]
    speed = 1.2 / 0.4
    half_a_step = 0.0005  # by which a control waits for the next step
    assert last.mean() == pytest.approx(speed * (0.12 - 0.03 - half_a_step), abs=5 * speed * 0.006 / np.sqrt(1000))
    assert last.std() == pytest.approx(speed * 0.006, rel=5 / np.sqrt(2 * 1000))
    exact = pushes(0.03, 0.0, [0, 0, 1.2, 1.2, 1.2, 1.2, 1.2, 1.2])[:, -1]
    np.testing.assert_allclose(exact, speed * 0.09, rtol=1e-5)


@pytest.mark.slow
def test_controls_of_policies_act_neither_before_they_are_given_nor_before_earlier_ones(pushes):
    """Without a delay half of them are as early as can be; a push of 20 ms never pulls."""
    late = 0.16 - pushes(0.0, 0.006, [0, 0, 1.2, 1.2, 1.2, 1.2, 1.2, 1.2])[:, -1] / 3.0 - 0.04
    assert late.min() == pytest.approx(0, abs=1e-6) and np.mean(late < 1e-6) == pytest.approx(0.5, abs=0.08)
    assert late.mean() == pytest.approx(0.006 / np.sqrt(2 * np.pi) + 0.00025, abs=5e-4)
    short = pushes(0.03, 0.02, [0, 1.2, 0, 0, 0, 0, 0, 0])[:, -1]
    assert short.min() >= 0 and 0.1 < np.mean(short < 1e-6) < 0.4 and short.max() > 3.0 * 0.04


@pytest.mark.slow
def test_a_policy_is_trained_on_it():
    env = MujocoEnvironment(SLIDE, [Parameter("joint/rail/damping", (0.1, 2.0))], PLAIN)
    settings = PPO(environments=4, unroll=5, segments=2, minibatches=4, epochs=2, total_steps=80, hidden=(8,))
    key_domain, key_init = jax.random.split(jax.random.key(0))
    domain = uniform(key_domain, env.supports["initial"], 4)
    with jax.debug_key_reuse(False):  # Brax uses keys in its own way, which the checker takes for a reuse
        start = jax.jit(lambda key: ppo.init(key, env, settings, domain))(key_init)
        after, made = jax.jit(lambda start: ppo.train(env, settings, start, settings.updates))(start)
    assert np.isfinite(made.value).all() and (made.episodes > 0).all()
    changes = jax.tree.map(lambda one, other: float(abs(one - other).max()), start.params, after.params)
    assert max(jax.tree.leaves(changes)) > 0
    policy = ppo.as_file(env, after.params)
    assert policy(start.episodes.env.observation[0]).shape == (1,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": ["option/timestep"]}, "expected numbers other than the model's time step"),
        (
            {"parameters": [("clock/jitter", (0.0, 0.3))]},
            "clock/jitter: expected 0 s up to the policy's duration, 0.1 s, to be feasible, got 0 to 0.3",
        ),
        (
            {"parameters": [("sensor/angle/delay", (0.0, 0.3))]},
            "sensor/angle/delay: expected 0 s up to the policy's duration, 0.1 s, to be feasible, got 0 to 0.3",
        ),
        ({"limits": {}}, "policy: limits: expected those of motor, whose actuator has no ctrlrange; got none"),
        ({"limits": {"engine": (0, 1), "motor": (0, 1)}}, "policy: limits: expected actuators of the model"),
        ({"limits": {"motor": (1, 0)}}, "policy: limits: motor: expected LOW below HIGH"),
        ({"interval": 0.021}, "policy: interval: expected a multiple of the model's time step, 0.004 s"),
        ({"observed": ("angel",)}, "policy: observed: expected a sensor such as angle"),
        ({"initial": {"hinge/qpos": (0, 1)}}, "expected a joint"),
        ({"xml": ARM.replace("implicitfast", "implicit")}, "model: MJX cannot simulate it"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_does_not_fit_is_refused(changes, message):
    own = {key: value for key, value in changes.items() if key not in ("parameters", "xml")}
    named = [one if isinstance(one, tuple) else (one, (0.001, 0.002)) for one in changes.get("parameters", [])]
    doubted = [Parameter(*one) for one in named] or PARAMETERS[:1]
    fields = {name: getattr(PLAIN, name) for name in PLAIN.__dataclass_fields__}
    with pytest.raises(ValueError) as refusal:
        MujocoEnvironment(changes.get("xml", ARM), doubted, Goal(**fields | own))
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_parameters_that_change_what_mjx_holds_fixed_are_refused():
    with pytest.raises(ValueError, match=r"'site/tip/size\[0\]': .* MJX can vary, got one that changes site_size"):
        MujocoEnvironment(ARM, [Parameter("site/tip/size[0]", (0.1, 0.2))], PLAIN)


TABLE = """
interval = 0.02
duration = 1.0
observed = ["angle"]
limits = { motor = [-1, 1] }
[targets.angle]
value = 0.4
"""


def test_a_table_is_a_goal():
    assert goal.of_table(tomllib.loads(TABLE)) == Goal(
        ("angle",), 0.02, 1.0, {"angle": (0.4, 1.0)}, limits={"motor": (-1.0, 1.0)}
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration", "length", "policy: expected keys among interval, duration"),
        ("duration = 1.0", "", "policy: expected duration, got none"),
        ('["angle"]', '"angle"', "policy: observed: expected names of signals"),
        ("[-1, 1]", "[-1]", "policy: limits: motor: expected [LOW, HIGH]"),
        ("value = 0.4", "weight = 0.4", "policy: targets: angle: expected keys value or command"),
        ("value = 0.4", "value = 0.4\nweight = -1", "policy: targets: angle: expected a weight of at least 0"),
        ("0.02", '"20 ms"', "policy: interval: expected a number"),
        ("0.02", "2.0", "policy: interval: expected more than 0 s and at most the duration"),
        ('observed = ["angle"]', 'observed = ["angle"]\nscales = { speed = 2 }', "policy: scales: expected signals"),
        ('observed = ["angle"]', 'observed = ["angle"]\ncosts = 3', "costs: expected a table of numbers"),
    ],
)
def test_a_table_that_is_no_goal_is_refused(old, new, message):
    with pytest.raises(ValueError, match=r"^[^\n]*$") as refusal:
        goal.of_table(tomllib.loads(TABLE.replace(old, new, 1)))
    assert message in str(refusal.value)


def test_a_file_without_a_policy_is_refused(tmp_path):
    file = tmp_path / "arm.toml"
    file.write_text('model = "arm.xml"\n[parameters."joint/elbow/damping"]\nsupport = [0.01, 0.2]\n')
    with pytest.raises(ValueError, match=r"expected a table \[policy\]"):
        environment(file)


@pytest.mark.parametrize("name", ["furuta", "arm", "shuffle", "servo"])
def test_the_example_has_the_parameters_of_its_task(name):
    from jaxlfi.envs.mujoco import task

    file = config.Path(__file__).parents[3] / f"examples/mujoco/{name}.toml"
    env, inferred = environment(file), task(file)
    assert env.space == inferred.space and env.units == tuple(inferred.units) and env.name == inferred.name
    for support in ("initial", "feasible"):
        chex.assert_trees_all_equal(env.supports[support], inferred.supports[support])


def test_trainings_begin_with_settings_for_rewards_in_every_step():
    """This holds for the preset `quick`; flags take precedence, and `paper` keeps the paper's settings."""
    from jaxlfi.cli import train
    from jaxlfi.rl.settings import PAPER, QUICK

    file = config.Path(__file__).parents[3] / "examples/mujoco/furuta.toml"

    def settings(*more):
        words = [f"mujoco,config={file}", "--domain", "uniform", "--out", "runs/policy", *more]
        return train._plan(train.main.parser().parse_args(words)).settings

    assert settings() == QUICK.replace(**TRAINING["quick"]) != QUICK
    assert settings("--epochs", "3", "--total-steps", "640") == settings().replace(epochs=3, total_steps=640)
    assert settings("--preset", "paper") == PAPER


def test_the_error_of_the_model_is_what_inference_says(tmp_path):
    """Forces, discrepancies and noise; for a signal without noise in the file, that estimated from the recording."""
    from jaxlfi.envs.mujoco import task
    from jaxlfi.envs.mujoco.discrepancy import Discrepancy
    from jaxlfi.envs.mujoco.simulator import simulator_of

    folder = config.Path(__file__).parents[3] / "examples/mujoco"
    for name in ("furuta.xml", "furuta.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    text = (folder / "furuta.toml").read_text().replace('"pendulum angle" = 0.002\n', "", 1)
    file = tmp_path / "furuta.toml"
    file.write_text(text.replace("[policy]", "[policy]\nmodel_error = true\nnoises = { 'joint/arm/qvel' = 0.2 }", 1))
    env, learnt = environment(file), simulator_of(task(file))
    np.testing.assert_array_equal(env._forces.deviations, learnt.forces.deviations)
    assert (env._forces.deviations[[0, 2, 4]] > 0).all() and learnt.signals == ("arm angle", "pendulum angle")
    assert env._noise.tolist() == [0.002, learnt.noise[1], 0.2, 0.0] and 1e-4 < learnt.noise[1] < 0.01
    kept = np.exp(-0.1 / np.array([0.78, 0.14]))
    np.testing.assert_allclose(env._nuisances._keep[:2], kept, rtol=1e-6)
    assert learnt.discrepancies[0] == Discrepancy(0.019, 0.78)
    np.testing.assert_allclose(env._nuisances._deviations, [0.019, 0.0175, 0.0, 0.0])
    file.write_text(text.replace("[policy]", "[policy]\nmodel_error = 1", 1))
    with pytest.raises(ValueError, match="policy: model_error: expected true or false, got 1"):
        environment(file)


def test_what_a_signal_was_some_steps_ago():
    """At constant speed it is the position minus speed times delay, for any fraction of a step."""
    step, speed, now = 0.004, np.array([1.5, -0.7, 40.0]), 3.0
    trace = (now + step * np.arange(-20, 1))[:, None] * speed
    for delay in ([0.0, 0.0, 0.0], [0.004, 0.0401, 0.08], [0.0533, 0.001, 0.0798]):
        seen = passed_by(jnp.asarray(trace, jnp.float32), jnp.asarray(delay, jnp.float32) / step)
        np.testing.assert_allclose(seen, speed * (now - np.array(delay)), rtol=1e-6)
    earliest = passed_by(jnp.asarray(trace, jnp.float32), jnp.array([21.0, 400.0, 20.0]))
    np.testing.assert_allclose(earliest, trace[0], rtol=1e-6)


def test_what_is_estimated_from_a_late_signal_is_as_late_and_later():
    """The shoulder's velocity: the signal that it is estimated from is delayed, and estimates lag."""
    delay = Parameter("sensor/angle/delay", (0.0, 0.02), (0.0, 0.03), "s")
    ours = MujocoEnvironment(
        ARM, [PARAMETERS[0], delay], GOAL, estimated={"joint/shoulder/qvel": Velocity("angle", 0.05)}
    )
    state = jax.eval_shape(ours.reset, jax.random.key(0), jnp.zeros(2))
    longest = 0.03 + velocities.lag(INTERVAL, 0.05)
    assert state.inner.trace.shape == (1 + int(np.ceil(longest / 0.004)), 5)
    late, place = dict(ours._lags), [GOAL.signals.index(name) for name in ("angle", "joint/shoulder/qvel")]
    assert late == dict.fromkeys(place, 1)
    np.testing.assert_allclose(ours._lag, [0.0, velocities.lag(INTERVAL, 0.05), 0.0, 0.0, 0.0], rtol=1e-6)


def test_what_a_policy_remembers_is_the_end_of_its_observations_and_actions():
    fields = {name: getattr(GOAL, name) for name in GOAL.__dataclass_fields__}
    ours = MujocoEnvironment(ARM, PARAMETERS[:1], Goal(**fields | {"memory": 3}))
    names = ("memory 1", "memory 2", "memory 3")
    assert ours.memory == 3 and ours.observations.names[-3:] == ours.actions.names[1:] == names
    assert ours.actions.scale == (1.5, 1.0, 1.0, 1.0) and ours.observations.centre[-3:] == (0.0, 0.0, 0.0)
    state = jax.eval_shape(ours.reset, jax.random.key(0), jnp.zeros(1))
    after = jax.eval_shape(ours.step, state, jnp.zeros(4))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    memory, control = ours.preparation.commanded(ours.preparation.start(np.zeros(4)), np.array([0.4, 0.1, 0.2, -0.3]))
    assert control.tolist() == [0.4] and memory.remembered.tolist() == [0.1, 0.2, -0.3]
