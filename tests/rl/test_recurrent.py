"""Policies that remember: segments are gone through as they were acted, files act alike, and episodes begin anew."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")

from rl.toy import SETTINGS, Line, assert_same_results
from robots.machines import MOTOR, SIGNALS, Wheel

from jaxlfi.rl import domains, policy, ppo, preparation, recurrent, training
from jaxlfi.rl.environment import Signals
from jaxlfi.rl.policy import Policy, Unit
from jaxlfi.rl.preparation import Preparation
from jaxlfi.robots import sessions
from jaxlfi.robots.settings import Settings

pytestmark = pytest.mark.usefixtures("keys_of_brax")

MEMORY = 6
NAMES = tuple(f"memory {k + 1}" for k in range(MEMORY))


def with_memory(signals):
    return Signals(
        (*signals.names, *NAMES), (*signals.units, *[""] * MEMORY), (*signals.centre, *[0.0] * MEMORY),
        (*signals.scale, *[1.0] * MEMORY),
    )  # fmt: skip


class Recall(Line):
    """The target is seen in the first step only, and to be named in the last one."""

    memory = MEMORY
    observations = with_memory(Line.observations)
    actions = with_memory(Line.actions)
    steps = 4

    def __init__(self):
        super().__init__(steps=4, observations=with_memory(Line.observations), actions=with_memory(Line.actions))

    def reset(self, key, theta):
        state = super().reset(key, theta)
        seen = jnp.concatenate([jnp.array([0.0, theta[1]]), jnp.zeros(MEMORY)])
        return state.replace(inner=(state.inner, jnp.asarray(0)), observation=seen, terminated=jnp.asarray(False))

    def step(self, state, action):
        point, made = state.inner
        last = made == self.steps - 1
        reward = jnp.where(last, -((action[0] - 0.25 * point.theta[1]) ** 2), 0.0)
        seen = jnp.concatenate([jnp.array([made + 1.0, 0.0]), action[1:]])
        return state.replace(inner=(point, made + 1), observation=seen, reward=reward)


@pytest.fixture(scope="module")
def started():
    env = Recall()
    return env, ppo.init(jax.random.key(0), env, SETTINGS, domains.uniform(jax.random.key(1), env.feasible, 4))


@pytest.mark.slow
def test_a_training_that_was_stopped_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    """It is stopped while episodes are under way: what the policy remembers of them is in the checkpoint."""
    env, whole, again = Recall(), tmp_path / "whole", tmp_path / "again"
    monkeypatch.setattr(training, "MAX_CHUNK", 1)
    draws = {"uniform": lambda key, n: domains.uniform(key, env.supports["initial"], n)}
    for out in (whole, again):
        training.begin(training.Plan("rl.test_recurrent:Recall", env, SETTINGS, None, draws, (5,)), out)
    training.resumed(whole, env, lambda updates, curves: None)

    def stop(updates, curves):
        raise KeyboardInterrupt

    for done in range(3):
        assert training.updates_done(again) == done
        with pytest.raises(KeyboardInterrupt):
            training.resumed(again, env, stop)
    training.resumed(again, env, lambda updates, curves: None)
    assert_same_results(whole, again)
    saved = policy.load(again / "uniform/seed_005/policy.npz")
    assert saved.memory == MEMORY and saved.unit is not None


def test_segments_are_gone_through_as_they_were_acted(started):
    """Step by step, each with what the one before remembered, and from zeros where an episode begins."""
    env, start = started
    network = ppo.policy_networks(env, SETTINGS).policy_network
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(7, 3, 2)).astype(np.float32)
    memory, rows, logits = jnp.asarray(rng.uniform(-1, 1, (3, MEMORY)), jnp.float32), [], []
    for step, own in enumerate(seen):
        begins = np.array([step == 4, step == 2, False])[:, None]
        memory = jnp.where(begins, 0.0, memory)
        rows.append(jnp.concatenate([own, memory], axis=-1))
        logits.append(network.apply(None, start.params.policy, rows[-1])[0])
        memory = recurrent.remembered(start.params.policy, rows[-1], MEMORY)
    together = network.apply(None, start.params.policy, jnp.stack(rows))[0]
    np.testing.assert_allclose(together, jnp.stack(logits), atol=1e-5)

    def last(first):
        changed = jnp.stack([rows[0].at[:, :2].add(first), *rows[1:]])
        return jnp.sum(network.apply(None, start.params.policy, changed)[0][-1], axis=-1)

    slopes = jnp.abs(jax.jacobian(last)(jnp.zeros(2))).sum(axis=1)
    assert slopes[2] > 1e-6 and slopes[:2].tolist() == [0.0, 0.0]  # what was seen before an episode is not remembered


def test_the_file_of_a_policy_remembers_like_its_networks(started, tmp_path):
    env, start = started
    saved = policy.load(ppo.as_file(env, start.params).save(tmp_path / "policy.npz"))
    seen = np.random.default_rng(2).uniform(-1, 1, (200, 2 + MEMORY)).astype(np.float32)
    expected = jax.vmap(ppo.deterministic(env, SETTINGS, start.params))(seen)
    np.testing.assert_allclose(saved(seen), expected, atol=1e-5)
    assert saved.memory == MEMORY and np.abs(expected[:, 1:]).max() < 1


@pytest.mark.slow
def test_what_was_seen_only_at_first_is_named_in_the_end():
    env = Recall()
    settings = SETTINGS.replace(
        environments=32, minibatches=8, segments=8, unroll=4, epochs=4, total_steps=32 * 4 * 2 * 150, learning_rate=5e-3
    )
    points = domains.uniform(jax.random.key(1), env.feasible, 32)
    start = ppo.init(jax.random.key(0), env, settings, points)
    trained, made = jax.jit(lambda state: ppo.train(env, settings, state, settings.updates))(start)
    act = ppo.deterministic(env, settings, trained.params)
    theta = jnp.stack([jnp.ones(9), jnp.linspace(-1.5, 1.5, 9)], axis=1)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(2), 9), theta)
    for _ in range(env.steps):
        actions = jax.vmap(act)(state.observation)
        state = jax.vmap(env.step)(state, actions)
    assert np.corrcoef(actions[:, 0], theta[:, 1])[0, 1] > 0.95, made.value
    assert jax.tree.all(jax.tree.map(lambda leaf: bool(jnp.isfinite(leaf).all()), trained.params))


REMEMBERING = Preparation(SIGNALS, (MOTOR,), 0.02, 40, actions=1, memory=MEMORY)


@pytest.fixture(scope="module")
def made():
    """A policy of a wheel, with all weights drawn."""
    rng, seen = np.random.default_rng(3), 3
    column = lambda names, centre, scale: {
        "names": list(names), "units": [""] * len(names), "centre": list(centre), "scale": list(scale)
    }  # fmt: skip
    low, high = (float(own[0]) for own in REMEMBERING.ranges)
    zeros, ones = [0.0] * MEMORY, [1.0] * MEMORY
    schema = {
        "environment": "wheel",
        "observations": column(REMEMBERING.names, [0.1, 0.0, 0.5, *zeros], [0.7, 3.0, 2.0, *ones]),
        "actions": column(["motor", *REMEMBERING.remembered], [(low + high) / 2, *zeros], [(high - low) / 2, *ones]),
        "preparation": json.loads(json.dumps(dataclasses.asdict(REMEMBERING))),
    }
    drawn = lambda *shape: rng.normal(0, 0.6, shape).astype(np.float32)
    unit = Unit(drawn(seen, 3 * MEMORY), drawn(3 * MEMORY), drawn(MEMORY, 3 * MEMORY), drawn(MEMORY))
    return Policy((drawn(seen + MEMORY, 5), drawn(5, 1)), (drawn(5), drawn(1)), schema, unit)


@pytest.mark.parametrize("kind", ["numpy", "stablehlo", "onnx"])
def test_all_formats_remember_alike(kind, made, tmp_path):
    """Compared over the steps of an episode, each format with its own memory."""
    act, rng = _saved(made, kind, tmp_path), np.random.default_rng(4)
    prepared = preparation.of_schema(made.schema)
    assert prepared == REMEMBERING
    memories = [prepared.start([0.3, 0.0])] * 2
    assert not memories[0].remembered.any()
    for values in rng.normal(0, [0.5, 3.0], (REMEMBERING.steps, 2)):
        controls = []
        for k, one in enumerate((act, made)):
            memory, seen = prepared.observed(memories[k], values)
            memories[k], control = prepared.commanded(memory, one(np.asarray(seen, np.float32)))
            controls.append(control)
        np.testing.assert_allclose(*controls, atol=1e-5)
    assert np.abs(memories[0].remembered).max() > 0.2


def _saved(made, kind, folder):
    if kind == "numpy":
        return policy.load(made.save(folder / "policy.npz"))
    if kind == "stablehlo":
        stablehlo = pytest.importorskip("jaxlfi.rl.stablehlo")
        stablehlo.save(made, folder / "program.npz")
        return lambda seen: np.asarray(stablehlo.load(folder / "program.npz")(seen))
    pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    from jaxlfi.rl import onnx_graph

    onnx_graph.save(made, folder / "policy.onnx")
    session = ReferenceEvaluator(str(folder / "policy.onnx"))
    return lambda seen: session.run(None, {"observation": seen[None]})[0][0]


def test_a_robots_loop_hands_on_what_is_remembered_and_begins_each_episode_anew(made, tmp_path):
    logs = [
        sessions.of(made, Settings()).run(Wheel(), tmp_path / f"{name}.csv", {"policy": "policy.npz"})
        for name in ("one", "two")
    ]
    np.testing.assert_array_equal(logs[0].targets, logs[1].targets)
    memory = REMEMBERING.start(logs[0].observations[0])
    for values, target in zip(logs[0].observations, logs[0].targets, strict=False):
        memory, seen = REMEMBERING.observed(memory, values)
        memory, control = REMEMBERING.commanded(memory, made(np.asarray(seen, np.float32)))
        np.testing.assert_allclose(target, control, atol=1e-5)
    assert logs[0].asked.shape == logs[0].targets.shape == (REMEMBERING.steps, 1)
    assert np.ptp(logs[0].targets) > 0.1


def test_what_does_not_fit_is_refused(made):
    from jaxlfi.rl import fine_tuning

    with pytest.raises(ValueError, match="start: expected a policy and a task without memory"):
        fine_tuning.started(made, Line(), SETTINGS)
    with pytest.raises(ValueError, match="expected a recurrent unit of 6 numbers, got arrays of other shapes"):
        dataclasses.replace(made.unit, bias=np.zeros(3))
    with pytest.raises(ValueError, match="expected a recurrent unit that sees 3 numbers"):
        dataclasses.replace(made, unit=dataclasses.replace(made.unit, weight=np.zeros((4, 3 * MEMORY))))
