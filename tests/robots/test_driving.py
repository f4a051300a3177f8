"""Policies that drive actuators: what is commanded and recorded, within which limits, and what ends an episode."""

import csv
import dataclasses
import json
import math
import threading
import time

import numpy as np
import pytest
from robots.machines import INTERVAL, MOTOR, SIGNALS, Wheel, a_policy, expected, prepared

from jaxlfi.rl.deployment import ControlLimits
from jaxlfi.rl.policy import Policy
from jaxlfi.rl.preparation import Command, Control, Signal
from jaxlfi.rl.termination import parsed
from jaxlfi.robots import driving, recording, sessions
from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.driver import Called, Driven, Driver
from jaxlfi.robots.interrupts import Interrupted
from jaxlfi.robots.robot import Observation, RobotError
from jaxlfi.robots.settings import Settings, of_table
from jaxlfi.robots.velocities import Differences


def run(driver, folder, table=None, policy=None, mode="control", name="log.csv", **more):
    session = sessions.of(policy or a_policy(), of_table(table or {}), mode=mode, **more)
    return session.run(driver, folder / name, {"policy": "policy.npz"})


def report_of(folder, name="log"):
    return json.loads((folder / f"{name}.json").read_text())


def table_of(path):
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    return {name: np.array([float(row[i] or "nan") for row in rows]) for i, name in enumerate(head)}


def test_what_is_commanded_and_recorded_is_what_the_policy_was_trained_to_do(tmp_path):
    driver = Wheel()
    assert isinstance(driver, Driver)
    log = run(driver, tmp_path)
    torques, seen = expected(100)
    np.testing.assert_allclose(log.targets[:, 0], torques, atol=1e-5)
    np.testing.assert_allclose(log.observations, seen, atol=1e-5)
    assert driver.asked == {"angle": "rad", "joint/wheel/qvel": "rad/s"} and driver.controls == {"motor": "N m"}
    assert driver.stops == 1 and len(driver.torques) == 100 and log.stopped == ""
    table = table_of(tmp_path / "log.csv")
    assert list(table) == ["time [s]", "motor [N m]", "angle [rad]", "joint/wheel/qvel [rad/s]"]
    np.testing.assert_allclose(table["time [s]"], INTERVAL * np.arange(101), atol=1e-12)
    np.testing.assert_allclose(table["motor [N m]"][:-1], torques, atol=1e-5)
    np.testing.assert_allclose(table["angle [rad]"], seen[:, 0], atol=1e-5)
    assert math.isnan(table["motor [N m]"][-1])  # the last measurement came after the last control
    report = report_of(tmp_path)
    assert report["stopped"] == "" and report["timing"]["missed"] == 0 and report["robot"] == {"name": "wheel"}


def test_limits_and_rates_of_a_robot_are_kept_whatever_is_asked_for(tmp_path):
    table = {"controls": {"motor": {"limits": [-0.75, 0.5], "rate": 10.0}}}
    log = run(Wheel(angle=-0.4), tmp_path, table)
    torques, seen = expected(100, angle=-0.4, low=-0.75, high=0.5, rate=10.0)
    np.testing.assert_allclose(log.targets[:, 0], torques, atol=1e-5)
    np.testing.assert_allclose(log.observations, seen, atol=1e-5)
    assert log.targets.max() == 0.5 and log.targets.min() == -0.75
    assert np.abs(np.diff(log.targets[:, 0])).max() == pytest.approx(10.0 * INTERVAL)


def test_what_a_policy_remembers_is_what_was_commanded_and_not_what_it_asked_for(tmp_path):
    """Displacements begin where a tightened limit left the control."""
    servo = Control("motor", -2.0, 3.0, "rad", rate=5.0, displacing=True, begins=0)
    preparation = prepared(steps=30, controls=(servo,), history=2, actions=1)
    policy = a_policy(preparation, weights=[[0.0]] * 4 + [[0.2]])  # a fifth of the last control is added to it
    log = run(Wheel(angle=0.3), tmp_path, {"controls": {"motor": {"limits": [-1.0, 0.75]}}}, policy)
    control, controls = 0.3, []
    for _ in range(30):
        control = np.clip(control + np.clip(0.2 * control, -0.1, 0.1), -1.0, 0.75)
        controls.append(control)
    np.testing.assert_allclose(log.targets[:, 0], controls, atol=1e-5)
    assert controls[-1] == 0.75


def test_a_robot_is_stopped_outside_of_the_bounds_of_its_signals(tmp_path):
    table = {"limits": {"angle": [-0.2, 0.6], "battery": [10.0, 13.0]}}
    driver = Wheel(seen=("angle", "joint/wheel/qvel", "battery"), angle=0.5)
    with pytest.raises(RobotError, match=r"^robot: stopped after \d+ of 100 controls: angle was measured at -0.2\d+, "):
        run(driver, tmp_path, table)
    _, seen = expected(100)
    first = int(np.flatnonzero(seen[:, 0] < -0.2)[0])
    assert len(driver.torques) == first and driver.stops == 1
    assert report_of(tmp_path)["stopped"].endswith("outside of its limits [-0.2, 0.6]")
    table = table_of(tmp_path / "log.csv")
    assert len(table["battery"]) == first + 1 and set(table["battery"]) == {11.0}


ENDS = {"turned": parsed("angle < -0.2", cost=3.0), "flat": parsed("abs(battery) < 10")}


def test_terminations_of_the_training_end_an_episode_which_is_no_fault(tmp_path):
    """It ends at the first measurement that meets the condition; the robot stops, and the recording goes up to it."""
    driver, said = Wheel(seen=("angle", "joint/wheel/qvel", "battery"), angle=0.5), []
    session = sessions.of(a_policy(prepared(terminations=ENDS)), Settings())
    log = session.run(driver, tmp_path / "log.csv", {}, said.append)
    _, seen = expected(100)
    first = int(np.flatnonzero(seen[:, 0] < -0.2)[0])
    assert len(driver.torques) == first and driver.stops == 1 and log.stopped == "" and not log.failed
    where = f"turned (angle < -0.2: angle was measured at {log.observations[-1, 0]:.6g})"
    assert said[-1] == f"the episode ended after {first} of 100 controls, as in training: {where}"
    report = report_of(tmp_path)
    assert report["ended"] == where and report["stopped"] == "" and report["failed"] is False
    assert set(table_of(tmp_path / "log.csv")["battery"]) == {11.0}  # which the policy does not see


def test_a_termination_needs_its_signal_or_is_ignored_by_name(tmp_path):
    """A number that is not finite does not pass for one at which the episode goes on."""
    policy, plain = a_policy(prepared(terminations=ENDS)), ("angle", "joint/wheel/qvel")
    with pytest.raises(ValueError, match="robot: expected signals among angle, joint/wheel/qvel, got battery"):
        run(Wheel(seen=plain), tmp_path, policy=policy, name="none.csv")
    lost = lambda seen: dataclasses.replace(seen, values={**seen.values, "battery": math.nan})
    driver = Wheel(seen=(*plain, "battery"), given=dict.fromkeys(range(3, 9), lost))
    with pytest.raises(RobotError, match="4 observations in a row could not be used, the last one was non-finite"):
        run(driver, tmp_path, policy=policy, name="lost.csv")
    log = run(Wheel(seen=plain), tmp_path, {"ignored_terminations": ["turned", "flat"]}, policy, name="whole.csv")
    assert len(log.targets) == 100 and log.ended == ""
    with pytest.raises(ValueError, match="ignored_terminations: expected some of turned, flat, got turnt"):
        run(Wheel(), tmp_path, {"ignored_terminations": ["turnt"]}, policy)


@pytest.mark.parametrize(("age", "trained", "said"), [(0.011, (0.0, 0.0), True), (0.011, (0.005, 0.015), False)])
def test_ages_of_measurements_that_a_policy_was_not_trained_with_are_said(age, trained, said, tmp_path):
    """As long as they are let: a tenth of a period more or less is not worth a word."""
    older = dict.fromkeys(range(101), lambda seen: dataclasses.replace(seen, age=age))
    session, lines = sessions.of(a_policy(prepared(observation_delay=trained)), Settings()), []
    log = session.run(Wheel(given=older), tmp_path / "log.csv", {}, lines.append)
    np.testing.assert_allclose(log.ages, age, atol=1e-9)
    assert report_of(tmp_path)["timing"]["age"] == pytest.approx(age)
    expected = (
        "measurements were 11 ms old when the controls made from them were sent (median); the policy was trained with "
        "0 to 0 ms: give [policy] an observation_delay that holds it"
    )
    assert lines[1:] == ([expected] if said else [])


def test_delays_of_sensors_that_a_policy_was_trained_with_are_said_beside_ages(tmp_path):
    """They are those of the recordings' time stamps: they add to an age."""
    policy = a_policy(prepared())
    on = {"sensor/angle/delay": {"low": 0.03, "high": 0.04, "unit": "s"}, "joint/a/damping": {"low": 1.0, "high": 2.0}}
    policy = dataclasses.replace(policy, schema={**policy.schema, "trained_on": on})
    older = dict.fromkeys(range(101), lambda seen: dataclasses.replace(seen, age=0.011))
    session, lines = sessions.of(policy, Settings()), []
    session.run(Wheel(given=older), tmp_path / "log.csv", {}, lines.append)
    assert lines[1].endswith("To ages it adds the delays that were inferred: sensor/angle/delay of 30 to 40 ms")
    assert report_of(tmp_path)["sensor_delays"] == {"sensor/angle/delay": [0.03, 0.04]}


def test_what_an_error_cut_short_is_marked_so(tmp_path):
    """What a limit ended is not marked: the loop itself stopped the robot there."""
    with pytest.raises(RobotError, match="bus"):
        run(Wheel(given={5: lambda seen: failing("bus")}), tmp_path)
    assert report_of(tmp_path)["failed"] is True and len(table_of(tmp_path / "log.csv")["angle [rad]"]) == 5
    with pytest.raises(RobotError, match="outside of its limits"):
        run(Wheel(angle=0.5), tmp_path, {"limits": {"angle": [-0.2, 0.6]}}, name="limit.csv")
    assert report_of(tmp_path, "limit")["failed"] is False


def failing(why):
    raise RobotError(why)


def test_targets_of_the_operator_are_within_what_was_trained_with(tmp_path):
    preparation = prepared(steps=20, commands=(Command("goal", -1.0, 2.0, "rad"),))
    policy = a_policy(preparation, weights=[[0.0], [0.0], [1.5]])
    for commands, torque in (({"goal": 1.25}, 1.875), ({}, 0.75)):
        log = run(Wheel(), tmp_path, policy=policy, commands=commands, name=f"{len(commands)}.csv")
        assert log.targets[-1, 0] == pytest.approx(torque, abs=1e-5)
    with pytest.raises(ValueError, match=r"commands: goal: expected what was trained with, \[-1.0, 2.0\], got 3"):
        sessions.of(policy, Settings(), {"goal": 3.0})
    with pytest.raises(ValueError, match="commands: expected some of goal, got gaol"):
        sessions.of(policy, Settings(), {"gaol": 1.0})


# ------------------------------------------------------------------------------------------- velocities, names, units


def test_velocities_are_differences_through_a_filter():
    """Compared with the recursion, at uneven times; angles take the shorter way round."""
    times, rng = np.array([0.0, 0.1, 0.15, 0.4, 0.5]), np.random.default_rng(0)
    values = rng.normal(size=5)
    velocity, found = None, [0.0]
    for i in range(1, 5):
        raw, passed = (values[i] - values[i - 1]) / (times[i] - times[i - 1]), times[i] - times[i - 1]
        velocity = raw if velocity is None else velocity + (1 - np.exp(-passed / 0.05)) * (raw - velocity)
        found.append(velocity)
    estimate = Differences(0.05)
    np.testing.assert_allclose([estimate(*row) for row in zip(times, values, strict=True)], found, rtol=1e-12)
    assert estimate(0.5, 9.0) == estimate(0.6, math.nan) == found[-1]  # nothing new, or nothing known
    turning = Differences(0.0, turning=True)
    turning(0.0, 3.1)
    assert turning(0.1, -3.1) == pytest.approx((2 * np.pi - 6.2) / 0.1)


def test_a_robot_without_velocities_is_controlled_by_estimates_which_are_not_recorded(tmp_path):
    table = {"velocities": {"joint/wheel/qvel": {"of": "angle", "filter": 0.01}}}
    driver = Wheel(seen=("angle",))
    log = run(driver, tmp_path, table)
    assert driver.asked == {"angle": "rad"}
    estimate = Differences(0.01)
    own = [estimate(*row) for row in zip(log.times, log.observations[:, 0], strict=True)]
    np.testing.assert_allclose(log.observations[:, 1], own, atol=1e-9)
    assert abs(driver.angle) < 0.2  # it is damped all the same
    assert list(table_of(tmp_path / "log.csv")) == ["time [s]", "motor [N m]", "angle [rad]"]
    with pytest.raises(ValueError, match="robot: expected signals among angle, got joint/wheel/qvel"):
        run(other := Wheel(seen=("angle",)), tmp_path, name="other.csv")
    assert other.stops == 1


def test_names_and_units_of_a_driver_are_converted(tmp_path):
    """Its encoder is in degrees, the other way round and from another zero; its motor takes mN m, the other way too."""

    class Other(Wheel):
        def values(self):
            return {"pan.pos": -np.degrees(self.angle - 0.25), "joint/wheel/qvel": self.speed}

        def connect(self, signals, controls):
            self.asked, self.controls = signals, controls

        def act(self, controls):
            super().act({"motor": -1e-3 * controls["pan.torque"]})

    names = {
        "angle": {"name": "pan.pos", "unit": "deg", "scale": -1.0, "offset": 0.25},
        "motor": {"name": "pan.torque", "unit": "mN m", "scale": -1.0},
    }
    driver = Other()
    log = run(driver, tmp_path, {"names": names})
    assert driver.asked == {"pan.pos": "deg", "joint/wheel/qvel": "rad/s"} and driver.controls == {"pan.torque": "mN m"}
    torques, seen = expected(100)
    np.testing.assert_allclose(log.targets[:, 0], torques, atol=1e-5)
    np.testing.assert_allclose([torque for _, torque in driver.torques], torques, atol=1e-5)
    np.testing.assert_allclose(log.observations, seen, atol=1e-5)
    with pytest.raises(ValueError, match=r"pan.pos: expected a unit of rad, got mm"):
        run(Other(), tmp_path, {"names": {"angle": {"name": "pan.pos", "unit": "mm"}}}, name="mm.csv")
    assert Called("t", "degC").factors("K") == (1.0, 273.15)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ({"angle": 0.1}, "expected a number of each signal, got none of joint/wheel/qvel"),
        ({"angle": "far", "joint/wheel/qvel": 0.0}, "expected numbers by name, got others: could not convert"),
        ([0.1, 0.2], "expected numbers by name from observe, got list"),
        (Observation([0.1, 0.2], 0), "expected numbers by name from observe, got list"),
    ],
)
def test_what_is_no_number_of_each_signal_is_refused(found, expected, tmp_path):
    driver = Wheel(given={2: lambda plain: found})
    with pytest.raises(RobotError, match=f"^robot: {expected}"):
        run(driver, tmp_path)
    assert driver.stops == 1 and len(driver.torques) == 2


def test_what_a_robot_says_of_itself_is_refused_where_it_could_not_be_recorded(tmp_path):
    driver = Wheel()
    driver.connect = lambda signals, controls: {"bus": object()}
    with pytest.raises(ValueError, match="robot: expected a mapping for JSON as information about itself"):
        run(driver, tmp_path)
    assert driver.stops == 1 and not list(tmp_path.iterdir())


def test_numbers_alone_are_measured_now_and_more_of_them_are_let(tmp_path):
    driver = Wheel(given={i: lambda plain: plain.values for i in range(200)})
    np.testing.assert_allclose(run(driver, tmp_path).targets[:, 0], expected(100)[0], atol=1e-5)


# ---------------------------------------------------------------------------------------------------- modes of the loop


def test_in_a_dry_run_nothing_is_commanded(tmp_path):
    driver = Wheel()
    log = run(driver, tmp_path, mode="dry run")
    assert not driver.torques and driver.stops == 1 and log.targets[0, 0] == pytest.approx(-1.2)
    assert list(table_of(tmp_path / "log.csv")) == ["time [s]", "angle [rad]", "joint/wheel/qvel [rad/s]"]
    assert np.load(tmp_path / "log.loop.npz")["asked"][0, 0] == pytest.approx(-2.0)
    assert report_of(tmp_path)["mode"] == "dry run"


def test_in_shadow_somebody_else_commands_and_wishes_are_recorded_beside(tmp_path):
    class Led(Wheel):
        """Somebody turns it by a torque of their own."""

        def observe(self):
            self.torque = 0.02 * (-1) ** (self.number // 10)
            return super().observe()

    driver = Led()
    log = run(driver, tmp_path, mode="shadow")
    assert driver.controls == {} and not driver.torques and driver.stops == 1
    assert list(driver.asked) == ["angle", "joint/wheel/qvel", "motor"]
    table = table_of(tmp_path / "log.csv")
    own = [0.02 * (-1) ** ((number - 1) // 10) for number in range(101)]
    np.testing.assert_allclose(table["motor [N m]"], own)
    wishes = np.clip(-8 * table["angle [rad]"] - 0.5 * table["joint/wheel/qvel [rad/s]"], -2.0, 3.0)
    np.testing.assert_allclose(log.asked[:, 0], wishes[:-1], atol=1e-5)


def test_a_policy_from_before_there_were_preparations_is_read_by_its_names(tmp_path):
    signals = {"names": ["cos a", "sin a", "v"], "units": ["", "", "rad/s"], "centre": [0.0] * 3, "scale": [1.0] * 3}
    actions = {"names": ["motor"], "units": [""], "centre": [0.5], "scale": [1.5]}
    schema = {"environment": "old", "observations": signals, "actions": actions}
    policy = Policy((np.zeros((3, 1), np.float32),), (np.zeros(1, np.float32),), schema)
    made = driving.preparation_of(policy, rate=50.0)
    assert made.signals == (Signal("a", "rad", True), Signal("v", "rad/s")) and made.names == ("cos a", "sin a", "v")
    assert made.controls == (Control("motor", -1.0, 2.0, ""),) and made.interval == 0.02
    with pytest.raises(
        ValueError, match="expected a control interval in its schema, got none: train it again, or give"
    ):
        driving.preparation_of(policy)


def test_settings_that_a_policy_carries_are_used():
    robot = {"limits": {"angle": [-1, 1]}, "controls": {"motor": {"rate": 5.0}}, "watchdog": 0.25, "holds": 1}
    policy = a_policy(robot=robot)
    loop = driving.Drive.of(policy)
    assert loop.bounds == {"angle": (-1.0, 1.0)} and loop.limits.rate == (5.0,) and loop.limits.low == (-2.0,)
    assert loop.watchdog == 0.25 and loop.holds == 1 and loop.rate == 50.0 and loop.steps == 100
    assert driving.Drive.of(policy, Settings()).watchdog == driving.WATCHDOG


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"limit": {}}, "robot: expected keys among controls, holds, ignored_terminations, limits, max_age, names, "),
        ({"limits": {"angle": [1, -1]}}, r"robot: limits: angle: expected LOW below HIGH, got \[1, -1\]"),
        ({"limits": {"angle": [0, "x"]}}, "robot: limits: angle: expected a number, got 'x'"),
        ({"limits": 3}, "robot: limits: expected a table, got 3"),
        ({"controls": {"motor": {"rate": 0}}}, "robot: controls: motor: rate: expected a number above 0, got 0"),
        ({"controls": {"motor": [0, 1]}}, r"robot: controls: motor: expected a table, got \[0, 1\]"),
        ({"controls": {"motor": {"limits": [-3, 1]}}}, r"limits: motor: expected LOW below HIGH within the policy's"),
        ({"controls": {"motor": {"rate": 61.0}}}, "limits: motor: expected a rate of more than 0 and at most"),
        ({"controls": {"rotor": {"rate": 1.0}}}, "limits: expected some of motor, got rotor"),
        ({"velocities": {"v": {"filter": 1}}}, "robot: velocities: v: expected the signal that it is"),
        ({"velocities": {"v": {"of": "a", "filter": -1}}}, "robot: velocities: v: filter: expected at least 0 s"),
        ({"velocities": {"v": {"of": "w"}, "w": {"of": "a"}}}, "velocities: v: expected a signal that is measured"),
        ({"names": {"a": {"name": "b", "unit": "furlong"}}}, "robot: names: a: expected a unit such as rad"),
        ({"names": {"a": {"name": "b", "scale": 0}}}, "robot: names: a: b: expected a scale other than 0, got 0"),
        ({"names": {"a": {"unit": "deg"}}}, "robot: names: a: expected name = NAME of the driver"),
        ({"record": "tip"}, "robot: record: expected names of signals, got 'tip'"),
        ({"units": {"tip": "furlong"}}, "robot: units: tip: expected a unit such as rad"),
        ({"watchdog": 0}, "robot: watchdog: expected a number above 0, got 0"),
        ({"holds": True}, "robot: holds: expected a whole number of at least 0, got True"),
    ],
)  # fmt: skip
def test_settings_that_fit_nothing_are_refused(table, expected):
    with pytest.raises(ValueError, match=expected) as error:
        sessions.of(a_policy(), of_table(table))
    assert "\n" not in str(error.value)


def test_limits_of_controls_are_kept_in_no_time_too():
    limits = ControlLimits(("a", "b"), (-1.0, -2.0), (1.0, 2.0), (math.inf, 4.0))
    change, control = limits.applied(np.zeros(2), np.array([0.5, 0.5]), 0.0)
    assert change.tolist() == control.tolist() == [0.5, 0.0]
    assert limits.allow(np.zeros(2), change, control, 0.0)
    assert not limits.allow(np.zeros(2), np.array([0.5, 0.1]), np.array([0.5, 0.1]), 0.02)
    assert not limits.allow(np.zeros(2), np.array([0.5, 0.0]), np.array([0.4, 0.0]), 1.0)
    assert not limits.allow(np.zeros(2), np.array([np.nan, 0.0]), np.array([np.nan, 0.0]), 1.0)
    assert not limits.allow(np.ones(2), np.array([0.1, 0.0]), np.array([1.1, 1.0]), 1.0)


# -------------------------------------------------------------------------------------------------- what drivers may do


def raising(error):
    def given(plain):
        raise error

    return given


def nan(plain):
    return dataclasses.replace(plain, values={**plain.values, "angle": math.nan})


def ends(driver, folder, expected, error=RobotError, **more):
    """It is stopped once, the recording can be read, and the report says why."""
    with pytest.raises(error, match=expected):
        run(driver, folder, **more)
    assert driver.stops == 1
    table = table_of(folder / "log.csv")
    assert np.isfinite(table["angle [rad]"]).any() and len(table["motor [N m]"]) >= len(driver.torques)
    assert (np.load(folder / "log.loop.npz")["targets"][:, 0] == [torque for _, torque in driver.torques]).all()
    return report_of(folder)["stopped"]


def test_a_driver_that_dies_is_stopped_and_what_happened_is_kept(tmp_path):
    driver = Wheel(given={7: raising(OSError("the bus is gone"))})
    assert ends(driver, tmp_path, "^the bus is gone", OSError) == "the bus is gone"
    assert len(driver.torques) == 7


def test_a_driver_that_sends_nan_is_held_and_then_stopped(tmp_path):
    driver = Wheel(angle=0.2, given=dict.fromkeys((3, 6, 7, 8, 9), nan))
    why = ends(driver, tmp_path, "robot: stopped after 9 of 100 controls: 4 observations in a row could not be used")
    assert why.endswith("the last one was non-finite")
    assert report_of(tmp_path)["faults"] == {"missing": 0, "late": 0, "non-finite": 5}
    torques = [torque for _, torque in driver.torques]
    assert torques[3] == torques[2] and torques[4] != torques[5] == torques[6] == torques[7] == torques[8]


def test_what_is_only_recorded_may_be_missing(tmp_path):
    lost = lambda plain: dataclasses.replace(plain, values={**plain.values, "battery": math.nan})
    driver = Wheel(seen=("angle", "joint/wheel/qvel", "battery"), given=dict.fromkeys(range(10, 30), lost))
    log = run(driver, tmp_path, {"record": ["battery"], "units": {"battery": "V"}})
    assert log.faults["non-finite"] == 0 and not log.held.any()
    assert np.isnan(table_of(tmp_path / "log.csv")["battery [V]"][:-1]).sum() == 20


def test_a_driver_that_stalls_for_a_tenth_of_a_second_is_stopped_by_the_watchdog(tmp_path):
    def stall(plain):
        driver.simulated_clock.pass_by(0.101)
        return plain

    driver = Wheel(given={5: stall})
    why = ends(driver, tmp_path, "robot: observe took longer than the 0.1 s of the watchdog, which stopped it")
    assert "watchdog" in why and len(driver.torques) == 5


def test_a_driver_that_stalls_for_less_misses_deadlines_and_goes_on(tmp_path):
    def stall(plain):
        driver.simulated_clock.pass_by(0.05)
        return plain

    driver = Wheel(given={5: stall})
    log = run(driver, tmp_path)
    assert log.missed == 3 and report_of(tmp_path)["timing"]["skipped"] == 1 and len(driver.torques) == 99


def test_a_driver_that_restarts_is_stopped_at_its_second_measurement(tmp_path):
    again = {i: lambda plain, i=i: dataclasses.replace(plain, number=i - 20) for i in range(20, 100)}
    driver = Wheel(given=again)
    why = ends(driver, tmp_path, "it began anew: its measurement 1 came after 19")
    assert len(driver.torques) == 21 and why.startswith("it began anew")


def test_a_call_that_hangs_is_broken_off_and_the_robot_stopped_from_another_thread(tmp_path):
    """Checked with the system's clock."""
    stopped = []

    class Hanging(Wheel):
        def stop(self):
            super().stop()
            stopped.append((time.monotonic(), threading.current_thread() is threading.main_thread()))

    def hang(plain):
        stopped.append(time.monotonic())
        time.sleep(5.0)
        return plain

    driver = Hanging(given={3: hang})
    driver.simulated_clock = None
    began = time.monotonic()
    driver.advance = lambda: None
    driver.torques, driver.act = [], lambda controls: driver.torques.append((0.0, controls["motor"]))
    ends(driver, tmp_path, "robot: observe took longer than the 0.1 s of the watchdog, which stopped it")
    hung, (moment, by_main) = stopped
    assert 0.08 < moment - hung < 2.0 and not by_main and time.monotonic() - began < 4.0


def test_a_call_that_hangs_outside_of_the_main_thread_is_not_broken_off_but_the_robot_is_stopped():
    ended, driver = threading.Event(), Wheel(given={2: lambda plain: time.sleep(0.4) or plain})
    driver.simulated_clock = None
    driver.advance, driver.act = lambda: None, lambda controls: None
    loop = driving.Drive.of(a_policy(), clock=Monotonic(), watchdog=0.1)
    robot, loop, _ = driving.connected(loop, driver, Settings())
    errors = []

    def work():
        try:
            loop.run(robot, a_policy())
        except RobotError as error:
            errors.append((str(error), driver.stops))
        ended.set()

    threading.Thread(target=work, daemon=True).start()
    assert ended.wait(10.0) and errors[0][1] == 1 and "watchdog" in errors[0][0]


def test_an_interruption_leaves_a_recording(tmp_path):
    import os
    import signal

    driver = Wheel(given={4: lambda plain: os.kill(os.getpid(), signal.SIGINT) or plain})
    ends(driver, tmp_path, "SIGINT", Interrupted)


# ---------------------------------------------------------------------------------------------------------- recordings


@pytest.mark.parametrize("name", ["log.npz", "log.mcap", "log"])
def test_every_format_has_the_same_numbers(name, tmp_path):
    if name == "log.mcap":
        pytest.importorskip("mcap")
    if name == "log":
        pytest.importorskip("pyarrow")
    logs = pytest.importorskip("jaxlfi.envs.mujoco.logs")
    free = a_policy(prepared(controls=(dataclasses.replace(MOTOR, rate=None),)))  # which JSON has no number for
    run(Wheel(), tmp_path, name="plain.csv", policy=free)
    run(Wheel(), tmp_path, name=name, policy=free)
    plain, other = logs.read(tmp_path / "plain.csv"), logs.read(tmp_path / name)
    of = lambda log: {signal: log.units[signal] for signal in log.signals}
    assert of(plain) == of(other) == {"motor": "N m", "angle": "rad", "joint/wheel/qvel": "rad/s"}
    for signal in plain.signals:
        for one, two in zip(plain.samples(signal), other.samples(signal), strict=True):
            np.testing.assert_allclose(one, two, atol=1e-9)
    assert report_of(tmp_path)["controls"] == 100
    with pytest.raises(ValueError, match="out: expected a new recording, got "):
        recording.require_new(tmp_path / name)


def test_measurements_that_came_in_another_order_are_recorded_in_that_of_time():
    """As of a driver whose measurements are older at one time than at another; the last one of a moment counts."""
    kept = recording.Recording(
        np.array([0.0, 0.3, 0.1, 0.3]), {"a": np.array([1.0, 2.0, 3.0, 4.0])}, np.zeros(0), {}, {"a": "m"}
    )
    assert kept.times.tolist() == [0.0, 0.1, 0.3] and kept.signals["a"].tolist() == [1.0, 3.0, 4.0]
    assert recording.rollout(kept, {}).signals["observation.state"].times.tolist() == [0.0, 0.1, 0.3]
    assert recording.merged(kept)[1]["a"].tolist() == [1.0, 3.0, 4.0]


def test_only_recordings_that_are_known_are_written(tmp_path):
    with pytest.raises(ValueError, match=r"out: expected a new NAME.csv, NAME.npz, NAME.mcap or folder"):
        recording.require_new(tmp_path / "log.bag")


def test_how_the_rate_was_kept_is_told():
    """Compared with the definitions, for a period of 20 ms and one skipped slot."""
    late = np.array([0.0, 0.001, np.inf, 0.003, 0.0])
    ages = np.array([0.004, 0.006, np.nan, 0.01, 0.002])
    log = type("Log", (), {"period": 0.02, "lateness": late, "missed": 2, "held": np.zeros(5, bool), "ages": ages})()
    found = recording.timing(log)
    periods = [0.02 + 0.001, 0.02 - 0.003]
    assert found["measured_period"] == pytest.approx(np.mean(periods)) and found["skipped"] == 1
    assert found["age"] == pytest.approx(0.005)
    assert found["jitter"] == pytest.approx(np.std(periods)) and found["lateness"]["100"] == 0.003
    assert found["lateness"]["50"] == pytest.approx(np.median([0.0, 0.001, 0.003, 0.0]))


def test_a_driver_of_several_signals_is_asked_in_their_order():
    driver = Wheel()
    robot = Driven(driver, {"joint/wheel/qvel": "rad/s", "angle": "rad"}, {"motor": "N m"})
    np.testing.assert_allclose(robot.observe().values, [0.0, 0.5])
    assert SIGNALS[0].name == "angle" and MOTOR.name in driver.controls and isinstance(robot.simulated_clock, Simulated)
