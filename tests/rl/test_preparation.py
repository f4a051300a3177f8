"""Preparation, against a plain loop over lists; in JAX as in NumPy; and as JSON in a policy's schema."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.rl.preparation import Command, Control, Preparation, Signal, of_schema

ARM = Preparation(
    signals=(Signal("angle", "rad", turning=True), Signal("lift", "m"), Signal("winch", "rad")),
    controls=(
        Control("torque", -2.0, 3.0, "N m", rate=7.0),
        Control("servo", -1.0, 0.6, "m", rate=2.0, displacing=True, begins=1),
        Control("valve", 0.5, 4.0),
    ),
    interval=0.1,
    steps=30,
    history=3,
    actions=2,
    commands=(Command("speed", -1.0, 2.0, "m/s"),),
    observation_delay=(0.0, 0.02),
)
RNG = np.random.default_rng(3)
VALUES = np.cumsum(RNG.normal(size=(8, 4)), axis=0)
VALUES[0, 1] = 0.31
ACTIONS = RNG.normal(size=(8, 3)) * [4.0, 0.3, 3.0] + [0.0, 0.2, 0.0]


def by_hand():
    """Observations and controls of an episode, from lists of all that was."""
    seen, controls, observations = [], [[0.0, 0.31, 0.5]], []
    for values, action in zip(VALUES.tolist(), ACTIONS.tolist(), strict=True):
        angle, lift, winch, speed = values
        seen.append([math.cos(angle), math.sin(angle), lift, winch])
        frames = [number for k in range(3) for number in seen[max(len(seen) - 1 - k, 0)]]
        lasts = [number for k in range(2) for number in controls[max(len(controls) - 1 - k, 0)]]
        observations.append([*frames, *lasts, speed])
        torque, servo, valve = controls[-1]
        torque = min(max(action[0], torque - 0.7, -2.0), torque + 0.7, 3.0)
        servo = min(max(servo + min(max(action[1], -0.2), 0.2), -1.0), 0.6)
        valve = min(max(action[2], 0.5), 4.0)
        controls.append([torque, servo, valve])
    return np.array(observations), np.array(controls[1:])


def episode(values, actions, xp):
    memory, observations, controls = ARM.start(values[0], xp), [], []
    for now, action in zip(values, actions, strict=True):
        memory, observation = ARM.observed(memory, now, xp)
        memory, control = ARM.commanded(memory, action, xp)
        observations.append(observation)
        controls.append(control)
    return xp.stack(observations), xp.stack(controls)


def test_an_episode_is_what_it_is_by_hand():
    observations, controls = by_hand()
    for got, expected in zip(episode(VALUES, ACTIONS, np), (observations, controls), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert (np.abs(np.diff(controls[:, 0])) > 0.69).any() and (controls[:, 1:] == [0.6, 0.5]).any(axis=0).all()
    assert len(ARM.names) == observations.shape[1] == len(set(ARM.names))
    assert ARM.names[:6] == ("cos angle", "sin angle", "lift", "winch", "cos angle 1 before", "sin angle 1 before")
    assert ARM.names[-7:-3] == (
        *(f"control {name} 1 before" for name in ("torque", "servo", "valve")),
        "control torque 2 before",
    )
    assert ARM.names[-1] == "command speed"


def test_it_is_compiled_to_the_same_numbers():
    compiled = jax.jit(lambda values, actions: episode(values, actions, jnp))(jnp.asarray(VALUES), jnp.asarray(ACTIONS))
    for got, expected in zip(compiled, episode(VALUES, ACTIONS, np), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_actions_have_the_ranges_of_controls_or_of_their_displacements():
    low, high = ARM.ranges
    np.testing.assert_allclose(low, [-2.0, -0.2, 0.5])
    np.testing.assert_allclose(high, [3.0, 0.2, 4.0])


def schema(**changes):
    actions = {"names": ["torque", "servo", "valve"]}
    own = {"observations": {"names": list(ARM.names)}, "actions": actions, "preparation": dataclasses.asdict(ARM)}
    return json.loads(json.dumps(own | changes))


def test_a_schema_says_it_again():
    assert of_schema(schema()) == ARM
    assert of_schema({"environment": "line"}) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preparation": {"steps": 3}}, "expected a preparation in its schema, got one that is not whole"),
        (
            {"preparation": dataclasses.asdict(ARM) | {"history": 2**70}},
            "history: expected a whole number from 1 to 100",
        ),
        ({"preparation": 3}, "expected a preparation in its schema, got one that is not whole"),
        ({"preparation": dataclasses.asdict(ARM) | {"signals": [{"title": "x"}]}}, "not whole"),
        ({"observations": {"names": ["angle"]}}, r"expected a preparation of its observations \['angle'\]"),
        ({"actions": {"names": ["a", "b", "c"]}}, r"expected a preparation of its actions \['a', 'b', 'c'\]"),
    ],
)
def test_a_schema_that_does_not_fit_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        of_schema(schema(**changes))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Signal("angle", turning=1), "turning: expected bool, got 1"),
        (lambda: Signal(None), "name: expected str, got None"),
        (lambda: Control("motor", "0", 1.0), "low: expected float, got '0'"),
        (lambda: Control("motor", 0.0, 1.0, begins=True), "begins: expected int, got True"),
        (lambda: Command("speed", 0.0, math.nan), "speed: expected finite limits, LOW below HIGH"),
        (lambda: Control("motor", 1.0, 1.0), "motor: expected finite limits, LOW below HIGH"),
        (lambda: Control("motor", 0.0, math.inf), "motor: expected finite limits"),
        (lambda: Control("motor", 0.0, 1.0, rate=0.0), "motor: expected a rate of more than 0 per second, got 0"),
        (lambda: Control("motor", 0.0, 1.0, displacing=True), "motor: expected a rate, which limits its displacement"),
        (lambda: dataclasses.replace(ARM, history=0), "history: expected a whole number from 1 to 100, got 0"),
        (lambda: dataclasses.replace(ARM, actions=1.5), "actions: expected a whole number from 0 to 100, got 1.5"),
        (lambda: dataclasses.replace(ARM, interval=0.0), "interval: expected more than 0 s"),
        (lambda: dataclasses.replace(ARM, signals=()), "signals: expected at least one"),
        (lambda: dataclasses.replace(ARM, signals=ARM.signals[:1]), "servo: expected to begin at one of 1 signals"),
        (lambda: dataclasses.replace(ARM, action_delay=(0.2, 0.1)), "action_delay: expected LOW up to HIGH"),
    ],
)
def test_what_does_not_fit_together_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
