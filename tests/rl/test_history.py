"""Policies that see the last observations and actions: what they see, and that episodes are the environment's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")

from rl.toy import SETTINGS, Line

from jaxlfi.rl import ppo
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.history import History

THETA = jnp.array([1.2, 1.5])
PUSHES = (0.1, -0.2, 0.4, 0.3)


class Bounded(Line):
    """With what environments may declare besides."""

    bounds = np.array([[-3.0, -2.0], [3.0, 2.0]])
    reward = "distance"

    def concluded(self, state):
        return {"end": state.inner.position, "seen": state.observation[0]}


def test_the_last_observations_come_first_and_the_actions_between_them_last():
    env, own = History(Line(), 3), Line()
    assert isinstance(env, Environment)
    state, single = env.reset(jax.random.key(0), THETA), own.reset(jax.random.key(0), THETA)
    first = np.asarray(single.observation)
    np.testing.assert_allclose(state.observation, [*first, *first, *first, 0.1, 0.1])  # 0.1: the middle of pushes
    seen = [first]
    for push in PUSHES:
        state, single = env.step(state, jnp.array([push])), own.step(single, jnp.array([push]))
        seen.append(np.asarray(single.observation))
        assert float(state.reward) == float(single.reward) and state.facts == single.facts
    np.testing.assert_allclose(state.observation, [*seen[4], *seen[3], *seen[2], 0.3, 0.4])


def test_its_signals_are_named_and_scaled_as_they_are_seen():
    env = History(Line(), 2)
    assert env.observations.names == ("position", "goal", "position 1 before", "goal 1 before", "push 1 before")
    assert env.observations.units == ("m",) * 5 and env.actions == Line().actions
    state = env.step(env.reset(jax.random.key(0), THETA), jnp.array([0.6]))
    assert float(env.observations.to_unit(state.observation)[-1]) == pytest.approx(1.0)  # the largest push
    np.testing.assert_allclose(History(Bounded(), 2).bounds, [[-3, -2, -3, -2, -0.4], [3, 2, 3, 2, 0.6]])
    assert History(Bounded(), 2).reward == "distance" and env.reward is None and not hasattr(env, "bounds")


def test_a_policy_that_sees_the_same_fares_the_same():
    domain = Domain(jnp.tile(THETA, (5, 1)))
    act = lambda observation: 0.3 * (observation[1:2] - observation[:1])
    alone = evaluate(jax.random.key(1), Bounded(), act, domain)
    found = evaluate(jax.random.key(1), History(Bounded(), 4), act, domain)
    np.testing.assert_allclose(found.value, alone.value, atol=1e-6)
    np.testing.assert_array_equal(found.steps, alone.steps)
    for name in ("there", "end", "seen"):
        np.testing.assert_allclose(found.facts[name], alone.facts[name], atol=1e-6)


@pytest.mark.usefixtures("keys_of_brax")
def test_it_can_be_trained_in():
    """The network takes all that is seen, and an update is made of it."""
    env = History(Line(), 2)
    state = ppo.init(jax.random.key(2), env, SETTINGS, Domain(jnp.tile(THETA, (SETTINGS.environments, 1))))
    assert state.params.policy["params"]["MLP_0"]["hidden_0"]["kernel"].shape == (5, 8)
    after, made = jax.jit(lambda state: ppo.update(env, SETTINGS, state))(state)
    assert int(after.updates) == 1 and np.isfinite(made.losses["total_loss"])


@pytest.mark.parametrize("frames", [1, 0, 101, 2.0, True])
def test_numbers_of_observations_that_are_none_are_refused(frames):
    with pytest.raises(ValueError, match=f"history: expected a whole number from 2 to 100, got {frames!r}$"):
        History(Line(), frames)


def test_environments_whose_policies_remember_are_refused():
    class Remembering(Line):
        memory = 3

    with pytest.raises(ValueError, match="history: expected an environment whose policies do not remember"):
        History(Remembering(), 2)
