"""Tables of goals: what they say, and what is refused; conditions that end episodes."""

import tomllib

import numpy as np
import pytest

from jaxlfi.envs.mujoco.goal import Goal, Target, of_table
from jaxlfi.rl.termination import Termination, parsed

TABLE = """
interval = 0.02
duration = 1.0
observed = ["place", "speed"]
turns = ["place"]
history = 3
actions = 1
rates = { motor = 4 }
displacing = ["motor"]
limits = { motor = [-1, 1] }
change_costs = { motor = 0.2 }
alive = 0.5
action_delay = 0.01
observation_delay = [0.0, 0.02]
noises = { speed = 0.1 }
bias = 2
memory = "gru"
memory_size = 5
[targets]
place = { value = 0.4, weight = 2 }
speed = { command = "pace", within = 0.3 }
[commands]
pace = [-1, 2]
[terminations]
fallen = { when = "body/torso/pos[2] < 0.2", cost = 10 }
away = "abs( arm angle )>=-2.5e0"
"""


def test_a_table_is_a_goal():
    assert of_table(tomllib.loads(TABLE)) == Goal(
        ("place", "speed"),
        0.02,
        1.0,
        {"place": Target(0.4, 2.0), "speed": Target("pace", 1.0, 0.3)},
        limits={"motor": (-1.0, 1.0)},
        turns=("place",),
        history=3,
        actions=1,
        rates={"motor": 4.0},
        displacing=("motor",),
        change_costs={"motor": 0.2},
        alive=0.5,
        action_delay=(0.01, 0.01),
        observation_delay=(0.0, 0.02),
        noises={"speed": 0.1},
        bias=2.0,
        memory=5,
        commands={"pace": (-1.0, 2.0)},
        terminations={
            "fallen": Termination("body/torso/pos[2]", "<", 0.2, cost=10.0),
            "away": Termination("arm angle", ">=", -2.5, magnitude=True),
        },
    )
    assert of_table(tomllib.loads(TABLE)).signals == ("place", "speed", "body/torso/pos[2]", "arm angle")


@pytest.mark.parametrize(
    ("text", "holds", "does_not"),
    [
        ("height < 0.2", [0.19, -5.0], [0.2, 1.0]),
        ("height <= .2", [0.2, -5.0], [0.21]),
        ("a long name, with a comma >-3", [-2.9, 0.0], [-3.0, -4.0]),
        ("abs(angle) > 1.5", [-1.6, 1.6], [1.5, 0.0]),
        ("abs(angle) <= 1e-1", [-0.1, 0.05], [-0.2, 0.2]),
        ("angle >= 2", [2.0], [1.9, np.nan]),
    ],
)
def test_conditions_hold_as_they_say(text, holds, does_not):
    condition = parsed(text)
    assert all(condition.holds(value) for value in holds) and not any(condition.holds(value) for value in does_not)


@pytest.mark.parametrize(
    "text", ["", "height", "height < low", "< 0.2", "0 < height < 2", "height == 2", "height < __import__('os')"]
)
def test_what_is_no_condition_is_refused(text):
    with pytest.raises(
        ValueError, match=r'^expected SIGNAL < NUMBER, or with <=, > or >=, as "body/torso/pos\[2\] < 0.2", got'
    ):
        parsed(text)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["place"]', '"place"', "policy: turns: expected names of signals, got 'place'"),
        ('["motor"]', "[3]", "policy: displacing: expected names of actuators, got [3]"),
        ("history = 3", "history = 0", "policy: history: expected a whole number from 1 to 100, got 0"),
        ("history = 3", "history = true", "policy: history: expected a whole number from 1 to 100, got True"),
        ("actions = 1", "actions = 1.0", "policy: actions: expected a whole number from 0 to 100, got 1.0"),
        ("motor = 4", 'motor = "fast"', "policy: rates: motor: expected a number, got 'fast'"),
        ("motor = 0.2", "motor = -0.2", "policy: change_costs: motor: expected a weight of at least 0, got -0.2"),
        ('"gru"', '"lstm"', "policy: memory: expected none or gru, got 'lstm'"),
        ('memory = "gru"', "", 'policy: memory_size: expected 1 to 1024, beside memory = "gru"; got 5'),
        ("memory_size = 5", "memory_size = 0", 'policy: memory_size: expected 1 to 1024, beside memory = "gru"; got 0'),
        ("alive = 0.5", "alive = inf", "policy: alive: expected a finite number, got inf"),
        ('command = "pace"', 'command = "pase"', "policy: targets: speed: expected a command such as pace, got 'pase'"),
        ('command = "pace"', "command = 3", "policy: targets: speed: command: expected the name of a command, got 3"),
        ('command = "pace"', "value = 3", "policy: commands: expected each to be a target of a signal, got no"),
        ("value = 0.4,", "", "policy: targets: place: expected keys value or command"),
        ("value = 0.4", "value = nan", "policy: targets: place: expected a finite value, got nan"),
        ("within = 0.3", "within = 0", "policy: targets: speed: within: expected more than 0, got 0"),
        ("[-1, 2]", "[2, -1]", "policy: commands: pace: expected LOW below HIGH, got [2.0, -1.0]"),
        ("pos[2] < 0.2", "pos[2] = 0.2", "policy: terminations: fallen: expected SIGNAL < NUMBER"),
        ("cost = 10", "coast = 10", "policy: terminations: fallen: expected { when ="),
        ("cost = 10", "cost = nan", "policy: terminations: fallen: expected finite numbers, got 0.2 and a cost of nan"),
        ("fallen =", "failed =", "policy: terminations: expected a name that has no other meaning, got 'failed'"),
        ("action_delay = 0.01", "action_delay = -0.01", "policy: action_delay: expected 0 s up to the duration"),
        ("[0.0, 0.02]", "[0.0, 2.0]", "policy: observation_delay: expected 0 s up to the duration"),
        ("[0.0, 0.02]", '"late"', "policy: observation_delay: expected a number, got 'late'"),
        ("{ speed = 0.1 }", "{ place = nan }", "policy: noises: place: expected a standard deviation of at least 0"),
        ("{ speed = 0.1 }", "{ sped = 0.1 }", "policy: noises: expected signals that are observed, got sped"),
        ("turns =", "scales = { speed = 0 }\nturns =", "policy: scales: speed: expected more than 0, got 0"),
        ("bias = 2", "bias = -2", "policy: bias: expected a standard deviation of at least 0, got -2"),
        ("alive = 0.5", "live = 0.5", "policy: expected keys among interval"),
    ],
)  # fmt: skip
def test_a_table_that_is_no_goal_is_refused(old, new, message):
    assert old in TABLE
    with pytest.raises(ValueError, match=r"^[^\n]*$") as refusal:
        of_table(tomllib.loads(TABLE.replace(old, new, 1)))
    assert str(refusal.value).startswith(message)


def test_a_goal_without_a_reward_is_refused():
    with pytest.raises(ValueError, match="targets: expected at least one, or a reward; got none"):
        Goal(("place",), 0.1, 1.0)
    assert Goal(("place",), 0.1, 1.0, alive=1.0).steps == 10
