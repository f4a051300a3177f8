"""Environments that are not ours: one of Brax's, and an MJX model in the manner of MuJoCo Playground."""

import contextlib
import functools
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")
mujoco = pytest.importorskip("mujoco")

with contextlib.redirect_stdout(io.StringIO()):
    from brax import envs
    from mujoco import mjx

from flax import struct

from jaxlfi.distributions.support import Support
from jaxlfi.rl import domains, ppo
from jaxlfi.rl.environment import Signals
from jaxlfi.rl.from_brax import from_brax
from jaxlfi.rl.settings import PPO

pytestmark = pytest.mark.usefixtures("keys_of_brax")

OPTIMISED = True
SETTINGS = PPO(environments=2, unroll=4, minibatches=2, epochs=1, hidden=(8,), total_steps=16)
MASSES = Support([0.5], [4.0])


def heavier(sys, theta):
    """The system with masses and inertias times theta."""
    inertia = sys.link.inertia
    times = jax.tree.map(lambda leaf: leaf * theta[0], inertia.replace(transform=None))
    return sys.replace(link=sys.link.replace(inertia=times.replace(transform=inertia.transform)))


@pytest.fixture(scope="module")
def pendulum():
    env = envs.get_environment("inverted_pendulum", backend="generalized")
    return from_brax(env, heavier, MASSES, names=("mass",), units=("times",), steps=5)


@struct.dataclass
class State:
    """A state as MuJoCo Playground has it."""

    data: mjx.Data
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Slider:
    """A mass on a rail, pushed; in the manner of MuJoCo Playground."""

    observation_size, action_size = 2, 1

    def __init__(self):
        model = mujoco.MjModel.from_xml_string(
            """<mujoco><option timestep="0.01"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
            <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
            <actuator><motor joint="rail"/></actuator></mujoco>"""
        )
        with contextlib.redirect_stdout(io.StringIO()):
            self._mjx_model = mjx.put_model(model)

    @property
    def mjx_model(self):
        return self._mjx_model

    def reset(self, rng):
        data = mjx.make_data(self.mjx_model)
        data = data.replace(qpos=0.1 * jax.random.normal(rng, (1,)))
        return self._state(data)

    def step(self, state, action):
        return self._state(mjx.step(self.mjx_model, state.data.replace(ctrl=action)))

    def _state(self, data):
        obs = jnp.concatenate([data.qpos, data.qvel])
        return State(data, obs, -jnp.abs(data.qpos[0]), jnp.float32(0), {}, {})


def mass_of(model, theta):
    return model.replace(body_mass=model.body_mass.at[1].set(theta[0]))


@pytest.fixture(scope="module")
def slider():
    return from_brax(Slider(), mass_of, MASSES, names=("mass",), units=("kg",), log=("mass",), steps=6)


def test_theta_reaches_the_model_and_the_original_is_left_alone(slider):
    """Newton's law: the speed after one step of a unit force is h / m."""
    before = np.array(slider.env.mjx_model.body_mass)

    def speed(theta):
        state = slider.reset(jax.random.key(0), theta)
        return slider.step(state, jnp.ones(1)).observation[1]

    speeds = jax.jit(jax.vmap(speed))(jnp.array([[0.5], [1.0], [4.0]]))
    np.testing.assert_allclose(speeds, 0.01 / np.array([0.5, 1.0, 4.0]), rtol=1e-4)
    np.testing.assert_array_equal(slider.env.mjx_model.body_mass, before)


@pytest.mark.slow
def test_the_unchanged_model_is_the_environment_itself(pendulum):
    key, action = jax.random.key(2), jnp.array([0.3])
    reset, step = jax.jit(pendulum.reset), jax.jit(pendulum.step)
    state = reset(key, jnp.ones(1))
    own = jax.jit(pendulum.env.reset)(jax.random.key_data(key))
    np.testing.assert_allclose(state.observation, own.obs, atol=1e-6)
    after, own = step(state, action), jax.jit(pendulum.env.step)(own, action)
    np.testing.assert_allclose(after.observation, own.obs, atol=1e-5)
    np.testing.assert_allclose(after.reward, own.reward, atol=1e-6)
    heavy = step(reset(key, jnp.array([4.0])), action)
    assert np.abs(heavy.observation - after.observation).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "slider"])
def test_they_are_trained_on(name, request):
    environment = request.getfixturevalue(name)
    domain = domains.uniform(jax.random.key(1), environment.supports["initial"], SETTINGS.environments)
    start = jax.jit(functools.partial(ppo.init, environment=environment, settings=SETTINGS))(
        jax.random.key(0), domain=domain
    )
    train = jax.jit(functools.partial(ppo.train, environment, SETTINGS), static_argnums=1)
    trained, made = train(start, SETTINGS.updates)
    assert np.isfinite(made.losses["total_loss"]).all()
    assert int(made.episodes.sum()) >= 2
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), trained.params, start.params)
    assert all(jax.tree.leaves(changed))
    theta = trained.episodes.env.inner.theta
    np.testing.assert_array_equal(theta, domain.theta)


def test_a_step_out_of_the_real_numbers_ends_the_episode(slider):
    state = jax.jit(slider.reset)(jax.random.key(0), jnp.ones(1))
    after = jax.jit(slider.step)(state, jnp.array([jnp.nan]))
    assert bool(after.truncated) and not bool(after.terminated) and float(after.reward) == 0.0
    np.testing.assert_array_equal(after.observation, state.observation)
    assert bool(after.facts["failed"])


def test_what_does_not_fit_is_refused(slider):
    wrapped = envs.training.EpisodeWrapper(envs.get_environment("inverted_pendulum", backend="generalized"), 5, 1)
    for arguments, expected in (
        ((wrapped, heavier, MASSES, ("mass",)), "env: expected an environment that is not wrapped, got EpisodeWrapper"),
        ((object(), heavier, MASSES, ("mass",)), "env: expected an environment with a model"),
        ((slider.env, mass_of, MASSES, ("mass", "friction")), "names: expected 1, one per parameter"),
    ):
        with pytest.raises(ValueError, match=expected):
            from_brax(*arguments)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"log": ("mas",)}, r"log: expected names of parameters \(mass\), got mas"),
        ({"units": ("kg", "m")}, r"units: expected 1, one per parameter, got \['kg', 'm'\]"),
        ({"feasible": Support([0.1, 0.1], [5.0, 5.0])}, "support: expected bounds for 2 parameters, got 1"),
        ({"feasible": Support([1.0], [5.0])}, "support: expected "),
        ({"nominal": (9.0,)}, r"nominal: expected 1 numbers within Phi, got \[9.0\]"),
        ({"nominal": (1.0, 1.0)}, "nominal: expected 1 numbers within Phi, got"),
        (
            {"observations": Signals(("x",) * 3, ("",) * 3, (0.0,) * 3, (1.0,) * 3)},
            "observations: expected 2, .* got 3",
        ),
        ({"steps": 0}, "steps: expected at least 1, got 0"),
    ],
)
def test_what_does_not_fit_its_parameters_is_refused(slider, changes, expected):
    with pytest.raises(ValueError, match=expected) as caught:
        from_brax(slider.env, mass_of, MASSES, ("mass",), **changes)
    assert "\n" not in str(caught.value)
