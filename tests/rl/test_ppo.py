"""PPO against Brax's own training, and its laws: it learns, repeats, stops, and runs side by side."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")

from brax import envs
from brax.training.agents.ppo import train as brax_ppo
from rl.toy import SETTINGS, Line

from jaxlfi.rl import domains, ppo
from jaxlfi.rl.deployment import Deployment, Limits, of_schema
from jaxlfi.rl.episodes import Batch
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.policy import load

pytestmark = pytest.mark.usefixtures("keys_of_brax")

LINE = Line()
SEED = 3


@pytest.fixture(scope="module")
def domain():
    return domains.uniform(jax.random.key(1), LINE.supports["initial"], SETTINGS.environments)


@pytest.fixture(scope="module")
def train():
    return jax.jit(functools.partial(ppo.train, LINE, SETTINGS), static_argnums=1)


class AsBrax(envs.Env):
    """The same episodes as an environment that Brax trains on."""

    def __init__(self, domain):
        self.batch, self.domain = Batch(LINE, SETTINGS.environments), domain

    def _with_info(self, state):
        return state.replace(info={**state.info, "episode_metrics": {}, "episode_done": state.done})

    def reset(self, rng):
        return self._with_info(self.batch.reset(jax.random.wrap_key_data(rng[0]), self.domain))

    def step(self, state, action):
        return self._with_info(self.batch.step(state, action))

    observation_size, action_size, backend = 2, 1, "none"


class NotEvaluated(envs.Env):
    """What Brax's evaluator is made of, and does not run."""

    def reset(self, rng):
        zeros = jnp.zeros(rng.shape[0])
        return envs.State(None, jnp.zeros((rng.shape[0], 2)), zeros, zeros)

    def step(self, state, action):
        return state

    observation_size, action_size, backend = 2, 1, "none"


@pytest.mark.slow
def test_it_makes_the_updates_of_brax(domain):
    settings = SETTINGS.replace(adam_epsilon=1e-8, entropy=0.02)
    _, (_, policy, value), _ = brax_ppo.train(
        AsBrax(domain),
        num_timesteps=settings.total_steps,
        wrap_env=False,
        episode_length=LINE.steps,
        eval_env=NotEvaluated(),
        max_devices_per_host=1,
        num_envs=settings.environments,
        learning_rate=settings.learning_rate,
        entropy_cost=settings.entropy,
        discounting=settings.discount,
        unroll_length=settings.unroll,
        batch_size=settings.segments,
        num_minibatches=settings.minibatches,
        num_updates_per_batch=settings.epochs,
        clipping_epsilon=settings.clipping,
        gae_lambda=settings.gae_lambda,
        max_grad_norm=settings.max_gradient_norm,
        vf_loss_coefficient=settings.value_weight,
        network_factory=lambda *_, **__: ppo.policy_networks(LINE, settings),
        seed=SEED,
        num_evals=1,
        run_evals=False,
    )

    # As brax.training.agents.ppo.train splits its key.
    key_global, key_local = jax.random.split(jax.random.key(SEED))
    key_local, key_env, _ = jax.random.split(jax.random.fold_in(key_local, 0), 3)
    key_policy, key_value = jax.random.split(key_global)
    key_epoch, _ = jax.random.split(key_local)
    networks = ppo.policy_networks(LINE, settings)
    params = ppo.losses.PPONetworkParams(
        policy=networks.policy_network.init(key_policy), value=networks.value_network.init(key_value)
    )
    start = ppo.Training(
        params=params,
        optimiser=ppo._optimiser(settings, 0).init(params),
        episodes=Batch(LINE, settings.environments).reset(jax.random.split(key_env, settings.environments)[0], domain),
        key=jax.random.split(key_epoch, 1)[0],
        updates=jnp.asarray(0),
    )
    ours, _ = jax.jit(lambda state: ppo.train(LINE, settings, state, settings.updates))(start)
    moved = jax.tree.map(lambda new, old: np.abs(new - old).max(), ours.params, params)
    assert min(jax.tree.leaves(moved)) > 1e-4
    for name, theirs, own in (("policy", policy, ours.params.policy), ("value", value, ours.params.value)):
        jax.tree.map(lambda a, b, name=name: np.testing.assert_allclose(a, b, atol=2e-4, err_msg=name), theirs, own)


def test_it_learns(domain):
    settings = SETTINGS.replace(total_steps=8000, minibatches=8, environments=8, initial_deviation=0.5)
    domain = domains.uniform(jax.random.key(1), LINE.supports["initial"], 8)
    start = ppo.init(jax.random.key(0), LINE, settings, domain)
    trained, made = jax.jit(lambda state: ppo.train(LINE, settings, state, settings.updates))(start)
    held_out = domains.uniform(jax.random.key(2), LINE.supports["initial"], 200)

    def fares(params):
        act = ppo.deterministic(LINE, settings, params)
        return evaluate(jax.random.key(5), LINE, act, held_out).value.mean()

    before, after = jax.jit(fares)(start.params), jax.jit(fares)(trained.params)
    still = evaluate(jax.random.key(5), LINE, lambda observation: jnp.zeros(1), held_out).value.mean()
    assert after > before + 1.0 and after > 0.4 * still  # returns are negative
    assert np.nanmean(made.value[-5:]) > np.nanmean(made.value[:5]) + 0.5
    assert made.losses["total_loss"].shape == (settings.updates,)


@pytest.mark.slow
def test_two_trainings_in_one_are_the_trainings_and_a_stop_changes_nothing(train, domain):
    start = ppo.init(jax.random.key(0), LINE, SETTINGS, domain)
    whole, made = train(start, 4)
    half, first = train(start, 2)
    again, second = train(half, 2)
    jax.tree.map(np.testing.assert_array_equal, plain(whole), plain(again))
    np.testing.assert_array_equal(made.value, np.concatenate([first.value, second.value]))
    assert int(whole.updates) == 4


def plain(state):
    """With keys as numbers."""
    keys = lambda leaf: jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.tree.map(lambda leaf: np.asarray(jax.random.key_data(leaf) if keys(leaf) else leaf), state)


@pytest.mark.slow
def test_trainings_side_by_side_are_those_by_themselves(train):
    """Other seeds, domains and learning rates under one vmap."""
    keys = jax.random.split(jax.random.key(4), 3)
    points = jnp.stack([domains.uniform(key, LINE.supports["wide"], 4).theta for key in keys])
    rates = jnp.array([1e-3, 3e-3, 1e-2])

    def one(key, theta, rate):
        settings = SETTINGS.replace(learning_rate=rate)
        start = ppo.init(key, LINE, settings, domains.Domain(theta))
        return ppo.train(LINE, settings, start, 2)[0].params

    together = jax.jit(jax.vmap(one))(keys, points, rates)
    compiled = jax.jit(one)
    for i in range(3):
        alone = compiled(keys[i], points[i], rates[i])
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-4), together, alone)


@pytest.mark.slow
def test_the_learning_rate_falls_evenly_to_what_is_left_of_it(domain):
    start = ppo.init(jax.random.key(0), LINE, SETTINGS, domain)

    @jax.jit
    def moved(rate, annealing, made=3):
        settings = SETTINGS.replace(learning_rate=rate, annealing=annealing)
        return ppo.update(LINE, settings, start.replace(updates=jnp.asarray(made)))[0].params

    left = 1 - 0.8 * 3 / SETTINGS.updates
    close = functools.partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, moved(4e-3, 0.8), moved(4e-3 * left, 0.0))
    assert left < 0.9
    jax.tree.map(np.testing.assert_array_equal, moved(4e-3, 1.0, SETTINGS.updates + 1), start.params)


def test_the_file_of_a_policy_acts_like_its_networks(domain):
    params = ppo.init(jax.random.key(0), LINE, SETTINGS, domain).params
    policy = ppo.as_file(LINE, params, seed=0)
    seen = np.random.default_rng(0).normal(0, 3, (1000, 2)).astype(np.float32)
    expected = jax.vmap(ppo.deterministic(LINE, SETTINGS, params))(seen)
    np.testing.assert_allclose(policy(seen), expected, atol=1e-5)
    assert policy.schema["observations"] == dataclasses.asdict(LINE.observations) and policy.schema["seed"] == 0
    assert "deployment" not in policy.schema


def test_the_file_of_a_policy_says_what_its_environment_declares_of_robots(domain, tmp_path):
    class Robotic(Line):
        deployment = Deployment(0.5, 7, ("position",), Limits((0.4,), 0.8, (-3.0,), (3.0,)), {"name": "exact"})

    params = ppo.init(jax.random.key(0), LINE, SETTINGS, domain).params
    saved = load(ppo.as_file(Robotic(), params).save(tmp_path / "policy.npz"))
    assert of_schema(saved.schema) == Robotic.deployment


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"environments": 0}, "environments: expected"),
        ({"discount": 1.1}, r"discount: expected a number in \[0, 1\], got 1.1"),
        ({"clipping": 0.0}, r"clipping: expected a number in \(0, inf\)"),
        ({"hidden": (0,)}, "hidden: expected"),
        ({"environments": 3}, "minibatches: expected minibatches x segments to be a multiple of the 3 environments"),
    ],
)
def test_settings_that_make_no_training_are_refused(changes, expected):
    with pytest.raises(ValueError, match=expected):
        SETTINGS.replace(**changes)


def test_the_presets_are_what_they_say():
    from jaxlfi.rl.settings import PAPER, QUICK

    assert (PAPER.environments, PAPER.total_steps, PAPER.segments * PAPER.unroll) == (12, 60_000, 16)
    assert PAPER.steps_per_update == 12 * 2048 and PAPER.updates == 3
    assert (QUICK.steps_per_update, QUICK.updates) == (192, 313)
