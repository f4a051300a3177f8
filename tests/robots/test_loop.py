"""The control loop: its rate, limits, what it does without observations, and that it stops the robot in any case."""

import dataclasses
import os
import signal
import time

import numpy as np
import pytest
from robots.fakes import LIMITS, PERIOD, Robot, a_policy

from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.interrupts import Interrupted
from jaxlfi.robots.loop import Loop
from jaxlfi.robots.robot import Observation, RobotError

TOWARDS = np.array([0.02, -0.01])


def loop(**changes):
    return dataclasses.replace(Loop.of(a_policy()), **{"clock": Simulated(), **changes})


def run(robot, act=lambda observation: TOWARDS, whole=True, **changes):
    return loop(**changes).run(robot, act, whole)


def test_what_happened_is_told_after_the_stop_however_it_ended():
    def cable(command):
        if command.slot == 8:
            raise OSError("cable")

    ends = []
    for robot, expected in (
        (Robot(on_act=cable), OSError),
        (Robot(given=dict.fromkeys(range(9), missing)), RobotError),
    ):
        with pytest.raises(expected):
            loop().run(
                robot, lambda observation: TOWARDS, on_end=lambda log, robot=robot: ends.append((log, robot.stops))
            )
    (failed, stops), (nothing, _) = ends
    assert stops == 1 and failed.targets.shape == (8, 2) and failed.observations.shape == (9, 5)
    assert nothing.targets.shape == (0, 2) and nothing.observations.shape == (0, 5) and nothing.extras == {}
    log = loop().run(Robot(), lambda observation: TOWARDS, on_end=lambda log: ends.append(log))
    np.testing.assert_array_equal(ends[-1].targets, log.targets)


def missing(plain):
    return None


def late(plain):
    return dataclasses.replace(plain, age=PERIOD + 1e-3)


def spoiled(plain):
    return dataclasses.replace(plain, values=np.where(np.arange(5) == 2, np.inf, plain.values))


def old(plain):
    return dataclasses.replace(plain, number=0)


class Reusing(Robot):
    """Measures into the same arrays again and again, and spoils the commands that it was given."""

    def __init__(self):
        super().__init__()
        self.values, self.extra = np.zeros(5), np.zeros(1)

    def observe(self):
        plain = super().observe()
        self.values[:], self.extra[:] = plain.values, self.number
        return dataclasses.replace(plain, values=self.values, extras={"number": self.extra})

    def act(self, command):
        super().act(dataclasses.replace(command, target=command.target.copy()))
        command.target[:] = command.displacement[:] = np.nan


def test_what_is_measured_into_one_array_is_logged_as_it_was():
    def act(observation):
        asked[:] = observation[[1, 3]] / 20 * [1, -1]
        observation[:] = np.nan  # a policy may scale it in place
        return asked

    asked = np.zeros(2)
    plain = run(Robot(), lambda observation: observation[[1, 3]] / 20 * [1, -1])
    log = run(Reusing(), act)
    for name in ("observations", "asked", "actions", "targets"):
        np.testing.assert_array_equal(getattr(log, name), getattr(plain, name))
    assert log.extras["number"].ravel().tolist() == list(range(17))


def test_it_is_as_the_policy_was_trained():
    made = Loop.of(a_policy())
    assert made.limits == LIMITS and made.moved == (1, 3) and made.size == 5
    assert made.rate == pytest.approx(6.25) and made.steps == 16 and made.period == pytest.approx(PERIOD)


def test_an_episode_is_commanded_and_logged():
    robot = Robot()
    act = lambda observation: observation[[1, 3]] / 20 * [1, -1]
    log = run(robot, act)
    assert robot.stops == 1 and [command.slot for command in robot.commands] == list(range(16))
    position = np.array([0.4, 0.3])
    for step in range(16):  # the robot is where it was told to be, so that it can be told in advance
        np.testing.assert_allclose(log.observations[step, [1, 3]], position, rtol=1e-12)
        np.testing.assert_allclose(log.asked[step], position / 20 * [1, -1], rtol=1e-12)
        position = np.clip(position + np.clip(log.asked[step], -0.06, 0.06), LIMITS.low, LIMITS.high)
        np.testing.assert_allclose(log.targets[step], position, rtol=1e-12)
    np.testing.assert_allclose(log.times, PERIOD * np.arange(17), atol=1e-12)
    np.testing.assert_allclose(log.actions.sum(axis=0), log.targets[-1] - [0.4, 0.3], atol=1e-12)
    assert log.targets[-1][0] == 0.6 and not log.held.any() and log.missed == 0 and log.stopped == ""
    assert log.extras["seen"].ravel().tolist() == [i % 2 == 0 for i in range(17)]
    assert log.over is None and log.faults == {"missing": 0, "late": 0, "non-finite": 0}


def test_set_points_begin_where_the_robot_knows_they_are():
    """A controller that sags is not where its set-point is."""
    robot = Robot(given={0: lambda plain: dataclasses.replace(plain, target=[0.42, 0.31])})
    assert run(robot).targets[0].tolist() == pytest.approx([0.44, 0.30])


def test_no_command_breaks_a_limit_whatever_is_asked_for():
    rng = np.random.default_rng(0)
    robot = Robot()
    log = run(robot, lambda observation: rng.normal(size=2) * 0.1, steps=400)
    assert (np.abs(log.asked) > LIMITS.step).mean() > 0.3
    assert (np.abs(log.actions) <= np.array(LIMITS.step) + 1e-12).all()
    assert (np.linalg.norm(log.actions, axis=1) <= LIMITS.speed * PERIOD + 1e-12).all()
    assert (log.targets >= LIMITS.low).all() and (log.targets <= LIMITS.high).all()
    np.testing.assert_allclose(np.diff(log.targets, axis=0), log.actions[1:], atol=1e-12)
    assert {0.275, 0.6} <= set(log.targets[:, 0]) and {0.1, 0.5} <= set(log.targets[:, 1])


def test_at_a_higher_rate_steps_are_shorter():
    log = run(Robot(), lambda observation: np.array([-0.06, 0.0]), rate=25.0)
    np.testing.assert_allclose(log.actions[:5], np.tile([-0.4 / 25, 0.0], (5, 1)), rtol=1e-9)


@pytest.mark.parametrize("fault", [missing, late, spoiled, old], ids=lambda one: one.__name__)
def test_without_an_observation_that_can_be_used_set_points_are_held_and_then_the_robot_is_stopped(fault):
    robot = Robot(given={2: fault, 3: fault, 6: fault, 7: fault, 8: fault})
    log = run(robot, holds=2)
    assert robot.stops == 1 and len(log.actions) == 8  # slots 6 and 7 were held, 8 was one too many
    held = np.array([False, False, True, True, False, False, True, True])
    np.testing.assert_array_equal(log.held, held)
    np.testing.assert_array_equal(log.actions, np.where(held[:, None], 0.0, np.tile(TOWARDS, (8, 1))))
    np.testing.assert_array_equal(np.isnan(log.asked[:, 0]), held)
    assert sum(log.faults.values()) == 5
    name = {"old": "missing", "spoiled": "non-finite"}.get(fault.__name__, fault.__name__)
    assert log.stopped == f"3 observations in a row could not be used, the last one was {name}"
    assert len(log.observations) == 4  # those of slots 0, 1, 4 and 5


def test_a_first_observation_is_waited_for_as_long_as_set_points_would_be_held():
    robot, clock = Robot(given={0: missing, 1: late}), Simulated()
    log = run(robot, holds=2, clock=clock)
    assert len(log.actions) == 16 and log.times[0] == 0 and clock.now() == pytest.approx(18 * PERIOD)
    robot = Robot(given={0: missing, 1: late, 2: spoiled})
    with pytest.raises(RobotError, match="to begin with, got none in 3 control periods, the last one was non-finite"):
        run(robot, holds=2)
    assert robot.stops == 1 and not robot.commands


def test_after_the_end_of_an_episode_set_points_are_held():
    robot = Robot()
    log = run(robot, over=lambda observation: observation[1] > 0.45)
    assert log.over == 3 and len(log.actions) == 16
    np.testing.assert_allclose(log.actions, np.where(np.arange(16)[:, None] < 3, TOWARDS, 0.0), atol=1e-12)
    log = run(robot := Robot(), whole=False, over=lambda observation: observation[1] > 0.45)
    assert len(log.actions) == len(robot.commands) == 3 and len(log.observations) == 4 and robot.stops == 1


def test_a_robot_that_is_measured_far_outside_is_stopped():
    away = lambda x: lambda plain: dataclasses.replace(plain, values=np.array([0.5, x, 0.7, 0.3, 0.0]))
    log = run(Robot(given={3: away(0.64), 5: away(0.66)}))
    assert len(log.actions) == 5 and log.stopped == "it was measured at [0.66, 0.3], 0.06 outside of its limits"


# ---------------------------------------------------------------------------------------------------------------- time


def test_deadlines_do_not_drift_and_those_that_pass_are_not_made_up_for():
    """Work takes 40 % of a period, once 130 %, and once 250 %."""
    clock, moments = Simulated(), []
    work = {4: 1.3, 9: 2.5}

    def act(observation):
        moments.append(clock.now())
        clock.pass_by(PERIOD * work.get(len(moments) - 1, 0.4))
        return TOWARDS

    robot = Robot()
    log = run(robot, act, clock=clock)
    slots = [command.slot for command in robot.commands]
    # After slot 4 it is slot 5 at once, 0.3 periods late; after slot 9 it is 11, half a period late.
    assert slots == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15]
    late = [0, 0, 0, 0, 0, 0.3, 0, 0, 0, 0, 0.5, 0, 0, 0, 0]
    np.testing.assert_allclose(moments, PERIOD * np.add(slots, late), atol=1e-9)
    np.testing.assert_array_equal(np.isinf(log.lateness), np.arange(16) == 10)
    np.testing.assert_array_equal(log.actions[10], 0)
    np.testing.assert_allclose(log.targets[10], log.targets[9])
    np.testing.assert_allclose(log.lateness[[0, 4, 5, 9, 11]], PERIOD * np.array([0.4, 1.3, 0.7, 2.5, 0.9]), atol=1e-9)
    assert log.missed == 16  # a tenth of a period is let, and all are later
    assert run(Robot()).missed == 0


def test_commands_that_follow_each_other_closely_keep_to_the_speed():
    clock, sent = Simulated(), []
    delays = iter([0.0, 0.8, 0.05, 0.0, 0.5, 0.0])

    def act(observation):
        clock.pass_by(PERIOD * next(delays, 0.0))
        return np.array([-0.06, 0.04]) * (-1) ** len(sent)

    log = run(Robot(on_act=lambda command: sent.append(clock.now())), act, clock=clock)
    gaps = np.diff(sent)
    assert gaps.min() < 0.3 * PERIOD
    assert (np.linalg.norm(log.actions[1:], axis=1) <= LIMITS.speed * np.minimum(gaps, PERIOD) + 1e-12).all()


def test_it_keeps_the_rate_by_the_systems_clock():
    """Whatever else runs on the machine: as many periods pass as were asked for, and every one is accounted for."""
    robot, began = Robot(), time.monotonic()
    log = run(robot, rate=200.0, steps=40, clock=Monotonic())
    assert time.monotonic() - began >= 40 / 200.0
    assert len(robot.commands) + np.isinf(log.lateness).sum() == 40 and (log.lateness >= 0).all()
    assert (np.diff(log.times) > 0).all()


# ---------------------------------------------------------------------------------------------------- whatever happens


def failing(error, after):
    def fail(command):
        if command.slot == after:
            raise error

    return fail


@pytest.mark.parametrize(
    ("robot", "act", "expected"),
    [
        (Robot(on_act=failing(OSError("cable"), 3)), None, "cable"),
        (Robot(given={2: lambda plain: 1 / 0}), None, "division by zero"),
        (Robot(), lambda observation: 1 / 0, "division by zero"),
        (Robot(), lambda observation: [0.0, np.nan], "policy: expected 2 finite actions, got .0.0, nan."),
        (Robot(), lambda observation: [0.0], "policy: expected 2 finite actions, got .0.0."),
        (Robot(given={1: lambda plain: Observation(np.zeros(4), 1)}), None, r"of 5 numbers, got shape \[4"),
        (Robot(given={1: lambda plain: Observation(plain.values, 1)}), None, r"extras of shapes .* as before, got {}"),
        (Robot(position=(0.7, 0.3)), None, r"set-points between .* to begin with, got \[0.7, 0.3\]"),
        (Robot(given={0: lambda plain: dataclasses.replace(plain, target=[0.4])}), None, r"2 set-points, got \[0.4\]"),
    ],
)  # fmt: skip
def test_it_is_stopped_once_after_any_error(robot, act, expected):
    with pytest.raises((ValueError, OSError, ZeroDivisionError), match=expected):
        run(robot, act or (lambda observation: TOWARDS))
    assert robot.stops == 1


def test_a_robot_that_cannot_be_stopped_is_said_to():
    robot = Robot(on_act=failing(RobotError("the arm is stuck"), 2))

    def stop():
        robot.stops += 1
        raise OSError("no answer")

    robot.stop = stop
    with pytest.raises(RobotError, match="the arm is stuck; and stopping the robot failed: no answer"):
        run(robot)
    assert robot.stops == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_a_command_to_be_sent_and_then_stop_the_robot(number):
    sent, before = [], signal.getsignal(number)

    def on_act(command):
        if command.slot == 2:
            os.kill(os.getpid(), number)
            time.sleep(0.01)
            sent.append(command.slot)  # nothing is cut short

    robot = Robot(on_act=on_act)
    with pytest.raises(Interrupted, match=signal.Signals(number).name):
        run(robot)
    assert sent == [2] and len(robot.commands) == 3 and robot.stops == 1
    assert signal.getsignal(number) is before


def test_a_signal_ends_the_waiting_for_a_deadline_at_once():
    class Waiting(Simulated):
        def sleep_until(self, moment):
            if moment > 2.5 * PERIOD:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5.0)

    robot, began = Robot(), time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run(robot, clock=Waiting())
    assert time.monotonic() - began < 4.0 and robot.stops == 1


def test_a_second_signal_ends_a_call_that_hangs_but_none_ends_the_stop():
    ends = []

    def hang(command):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    robot, began = Robot(on_act=hang), time.monotonic()

    def stop():
        robot.stops += 1
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        ends.append("whole")

    robot.stop = stop
    with pytest.raises(Interrupted):
        run(robot)
    assert time.monotonic() - began < 4.0 and robot.stops == 1 and ends == ["whole"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"rate": 0.0}, "rate: expected a positive number, got 0.0"),
        ({"rate": -6.25}, "rate: expected a positive number, got -6.25"),
        ({"rate": np.inf}, "rate: expected a positive number, got inf"),
        ({"max_age": np.nan}, "max_age: expected a positive number"),
        ({"steps": 0}, "steps: expected at least 1, got 0"),
        ({"holds": -1}, "holds: expected at least 0, got -1"),
        ({"moved": (1,)}, "limits: expected those of 1 set-points, got 2"),
    ],
)
def test_what_makes_no_loop_is_refused(change, expected):
    with pytest.raises(ValueError, match=expected):
        loop(**change)
