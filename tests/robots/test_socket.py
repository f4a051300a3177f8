"""A robot in a process of its own: a thousand steps with lost and late frames, damaged messages, and sudden deaths.

What was safe is judged by the journal of the robot's own process.
"""

import itertools
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from robots.fakes import LIMITS, PERIOD, Robot, a_policy

from jaxlfi.robots import server, simulated, wire
from jaxlfi.robots.client import SocketRobot
from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.loop import Loop
from jaxlfi.robots.robot import Command, RobotError

NAMES = (tuple("abcde"), tuple("uv"))
FAULTS = {"dropped": 0.05, "delayed": 0.05, "spoiled": 0.02, "jitter": 0.03}
STEPS = 1000


class Server:
    """A simulated robot's process."""

    def __init__(self, folder, *words):
        self.policy, self.journal = folder / "policy.npz", folder / "journal.jsonl"
        a_policy(STEPS).save(self.policy)
        command = [sys.executable, "-m", "jaxlfi.robots.simulated", str(self.policy), "--journal", str(self.journal)]
        self.process = subprocess.Popen([*command, *words], stdout=subprocess.PIPE, text=True)
        self.address = self.process.stdout.readline().split()[-1]

    def sessions(self):
        """What happened in each connection, as the robot tells it."""
        events = [json.loads(line) for line in self.journal.read_text().splitlines()] if self.journal.exists() else []
        begins = [place for place, event in enumerate(events) if event["event"] == "begun"]
        return [events[i:j] for i, j in itertools.pairwise([*begins, None])]

    def last(self, until=lambda events: events[-1]["event"] == "stopped", after=0, patience=20.0):
        """The last connection's events, once there are these in one that came after so many others."""
        ends = time.monotonic() + patience
        while not ((sessions := self.sessions()[after:]) and until(sessions[-1])):
            assert time.monotonic() < ends, sessions[-1:]
            time.sleep(0.01)
        return sessions[-1]

    def end(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture(scope="module")
def robot_process(tmp_path_factory):
    chances = [word for name, value in FAULTS.items() for word in (f"--{name}", str(value))]
    process = Server(tmp_path_factory.mktemp("server"), "--watchdog", "20", *chances)
    yield process
    process.end()


def connected(process, **more):
    clock = Simulated()
    return SocketRobot(process.address, *NAMES, clock=clock, **{"timeout": 20.0, **more}), clock


def stops(events):
    return [event["why"] for event in events if event["event"] == "stopped"]


def test_a_thousand_steps_with_lost_late_and_spoiled_frames_are_safe(robot_process):
    robot, clock = connected(robot_process)
    policy = a_policy(STEPS, gain=3.0)
    log = Loop.of(policy, clock=clock).run(robot, policy)
    assert log.stopped == "" and len(log.actions) == STEPS and log.missed == 0
    assert STEPS * PERIOD <= clock.now() + 1e-9 < (STEPS + 4) * PERIOD  # the first frames may be lost, too
    assert 0.05 * STEPS < log.held.sum() < 0.2 * STEPS
    assert all(5 <= count < 150 for count in log.faults.values())

    events = robot_process.last()
    acts = [event for event in events if event["event"] == "act"]
    displacement, target = (np.array([event[name] for event in acts]) for name in ("displacement", "target"))
    seconds = np.diff([event["now"] for event in acts])
    np.testing.assert_allclose(seconds, PERIOD, atol=1e-9)
    assert (np.abs(displacement) <= np.array(LIMITS.step) + 1e-9).all()
    assert (np.linalg.norm(displacement[1:], axis=1) <= LIMITS.speed * seconds + 1e-9).all()
    assert (target >= np.array(LIMITS.low) - 1e-9).all() and (target <= np.array(LIMITS.high) + 1e-9).all()
    np.testing.assert_allclose(np.diff(target, axis=0), displacement[1:], atol=1e-9)
    assert (np.abs(np.asarray(log.asked)[~log.held]) > LIMITS.step).mean() > 0.1  # the limits had something to do
    assert events[-1]["event"] == "stopped" and stops(events) == ["asked to"]


def test_the_same_seed_gives_the_same_frames():
    def seen(seed):
        clock = Simulated()
        robot = simulated.PointRobot(a_policy(), clock, seed=seed, **FAULTS)
        log = Loop.of(a_policy(60), clock=clock, steps=60).run(robot, a_policy())
        return log.observations, log.times

    for one, other in zip(seen(4), seen(4), strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(seen(4)[0]) != len(seen(5)[0]) or (seen(4)[0] != seen(5)[0]).any()


def test_frames_are_lost_and_late_as_often_as_said():
    """Each frame is asked for a little after it was taken, and the next one at the end."""
    clock = Simulated()
    robot = simulated.PointRobot(a_policy(), clock, dropped=0.3, delayed=0.2, jitter=0.01)
    numbers, ages = [], []
    for _ in range(2000):
        found = robot.observe()
        numbers.append(None if found is None else found.number)
        ages.append(None if found is None else found.age)
        clock.pass_by(PERIOD)
    fresh = np.array([number == place for place, number in enumerate(numbers)])
    # A frame that is delayed by up to 2.5 periods comes within its quarter of a period in a tenth of all cases.
    assert abs(fresh.mean() - 0.7 * (0.8 + 0.2 / 10)) < 0.03
    on_time = np.array(ages, float)[fresh]
    assert on_time.min() >= 0.25 * PERIOD - 0.011 and on_time.max() <= 0.25 * PERIOD + 0.011
    known = [number for number in numbers if number is not None]
    assert known == sorted(known)


def test_it_moves_towards_its_set_point_and_not_at_once():
    clock = Simulated()
    robot = simulated.PointRobot(a_policy(), clock)
    middle = robot.observe().values[[1, 3]]
    np.testing.assert_allclose(middle, np.add(LIMITS.low, LIMITS.high) / 2)
    robot.act(Command(0, np.array([0.04, -0.02]), np.add(middle, [0.04, -0.02])))
    moved = []
    for _ in range(6):
        clock.pass_by(PERIOD)
        moved.append(robot.observe().values[[1, 3]] - middle)
    # The first frame is taken three quarters of a period after the command.
    np.testing.assert_allclose(moved[0], np.array([0.04, -0.02]) * (1 - np.exp(-0.75 * PERIOD / 0.08)), rtol=1e-6)
    np.testing.assert_allclose(moved[-1], [0.04, -0.02], atol=1e-5)


# ------------------------------------------------------------------------------------------------------- sudden deaths


def test_a_server_that_dies_is_an_error_and_the_robot_is_told_to_stop(tmp_path):
    process = Server(tmp_path)
    robot, clock = connected(process)
    policy, calls = a_policy(), []

    def act(observation):
        calls.append(1)
        if len(calls) == 5:
            process.end()
        return policy(observation)

    with pytest.raises(RobotError, match=r"^robot 127.0.0.1:\d+: .*; and stopping the robot failed: "):
        Loop.of(policy, clock=clock).run(robot, act)
    assert len(calls) == 5
    with pytest.raises(RobotError, match=r"expected a driver that listens, got: .*refused"):
        connected(process)


LOOP = """
import sys
sys.modules["jax"] = sys.modules["mujoco"] = sys.modules["brax"] = None
from jaxlfi.rl.policy import load
from jaxlfi.robots.client import SocketRobot
from jaxlfi.robots.loop import Loop
policy = load(sys.argv[1])
robot = SocketRobot(sys.argv[2], policy.observed["names"], policy.acted["names"], timeout=20.0)
Loop.of(policy, rate=100.0, holds=10**9, max_age=10.0, steps=10**6).run(robot, policy)
"""


@pytest.mark.parametrize(
    ("number", "why"),
    [(signal.SIGINT, "asked to"), (signal.SIGTERM, "asked to"), (signal.SIGKILL, "the connection ended")],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_loop_that_is_told_to_end_or_dies_leaves_a_robot_that_was_stopped(robot_process, number, why):
    """It runs where there is no JAX."""
    words = [sys.executable, "-c", LOOP, str(robot_process.policy), robot_process.address]
    before = len(robot_process.sessions())
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    robot_process.last(lambda events: len(events) > 4, after=before)
    process.send_signal(number)
    error = process.communicate(timeout=20)[1]
    events = robot_process.last(after=before)
    assert stops(events) == [why] and events[-1]["event"] == "stopped"
    assert process.returncode != 0 and (number == signal.SIGKILL or f"Interrupted: {number.name}" in error)


# ---------------------------------------------------------------------------------------------------- damaged messages


HELLO = {"type": "hello", "protocol": wire.PROTOCOL, "version": wire.VERSION, "about": {}}


class Driver:
    """A driver in a thread that answers hello as it should, and then by these lines."""

    def __init__(self, *answers, hello=HELLO):
        self.answers = [json.dumps(hello).encode() + b"\n", *answers]
        self.heard, self.listener = [], server.listen(0)
        self.address = f"socket://127.0.0.1:{self.listener.getsockname()[1]}"
        self.thread = threading.Thread(target=self.talk, daemon=True)
        self.thread.start()

    def talk(self):
        connection, _ = self.listener.accept()
        with connection, connection.makefile("rb") as file:
            for answer in self.answers:
                self.heard.append(json.loads(file.readline() or b"{}").get("type"))
                if answer is None:
                    return
                connection.sendall(answer)
            while line := file.readline():
                self.heard.append(json.loads(line)["type"])

    def close(self):
        self.thread.join(timeout=5)
        self.listener.close()


SEEN = {"type": "observation", "number": 0, "age": 0.01, "values": [0.5, 0.4, 0.5, 0.3, 0.0]}


def line(**changes):
    return json.dumps({**SEEN, **changes}).encode() + b"\n"


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (b"\xff\x00garbage\n", "expected a line of JSON, got "),
        (b"[1, 2]\n", "expected an object with a type"),
        (b'{"type": 3}\n', "expected an object with a type"),
        (line(type="done"), "expected observation or nothing as the reply to observe, got 'done'"),
        (line(values="far"), "expected numbers as 'values' of 'observation', got far"),
        (line(values=[0.5, "x", 0, 0, 0]), "expected numbers as 'values'"),
        (line(number=None), "expected a number as 'number' of 'observation', got None"),
        (line(age=True), "expected a number as 'age'"),
        (line(extras=[1]), "expected an object as 'extras' of 'observation', got .1."),
        (line(values=[0.5] * 4), r"expected observations of 5 numbers, got shape \[4\]"),
        (line(type="error", message="a joint is hot"), "its driver refused observe: a joint is hot"),
        (b"x" * (wire.LONGEST + 10), f"expected a line of at most {wire.LONGEST} bytes"),
        (b'{"type": "observ', "timed out"),
        (None, "the connection was closed|reset by peer"),
    ],
)  # fmt: skip
def test_a_driver_that_answers_wrongly_is_told_to_stop(answer, expected):
    driver = Driver(answer)
    clock = Simulated()
    robot = SocketRobot(driver.address, *NAMES, timeout=0.1, clock=clock)
    with pytest.raises((RobotError, ValueError), match=expected) as error:
        Loop.of(a_policy(), clock=clock).run(robot, a_policy())
    assert str(error.value).startswith("robot") and "\n" not in str(error.value)
    driver.close()
    assert driver.heard[:2] == ["hello", "observe"]
    assert answer is None or driver.heard[2:] == ["stop"]


def test_numbers_that_a_driver_does_not_know_are_not_finite():
    driver = Driver(line(values=[0.5, 0.4, None, 0.3, 0.0], target=[0.41, 0.31], extras={"seen": [1, 0]}))
    robot = SocketRobot(driver.address, *NAMES, timeout=0.1)
    found = robot.observe()
    np.testing.assert_array_equal(found.values, [0.5, 0.4, np.nan, 0.3, 0.0])
    assert found.target.tolist() == [0.41, 0.31] and found.extras == {"seen": [1, 0]} and found.age == 0.01
    with pytest.raises(RobotError, match="no answer to stop"):
        robot.stop()
    driver.close()


@pytest.mark.parametrize(
    ("hello", "expected"),
    [
        ({**HELLO, "version": 2}, "expected hello of jaxlfi-robot of version 1, got hello jaxlfi-robot 2"),
        ({**HELLO, "protocol": "ros"}, "got hello ros 1"),
        ({**HELLO, "about": "a Franka"}, "expected an object as 'about' of 'hello', got a Franka"),
        ({"type": "error", "message": "busy"}, "its driver refused hello: busy"),
    ],
)
def test_other_protocols_and_versions_are_refused(hello, expected):
    driver = Driver(hello=hello)
    with pytest.raises(RobotError, match=expected):
        SocketRobot(driver.address, *NAMES, timeout=0.5)
    driver.close()


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("socket://10.0.0.7:5005", "expected this host, such as 127.0.0.1, got '10.0.0.7'; --remote allows others"),
        ("socket://127.0.0.1", "expected socket://HOST:PORT"),
        ("socket://127.0.0.1:99999", "expected socket://HOST:PORT"),
        ("socket://:80", "expected socket://HOST:PORT"),
    ],
)
def test_other_addresses_are_refused(address, expected):
    with pytest.raises(ValueError, match=f"robot: {expected}"):
        wire.address(address)
    assert wire.address("socket://10.0.0.7:5005", remote=True) == ("10.0.0.7", 5005)
    assert wire.address("socket://localhost:80") == ("127.0.0.1", 80)


# --------------------------------------------------------------------------------------------- what a server refuses


def ask(process, *messages):
    """The replies of a server to lines."""
    host, port = wire.address(process.address)
    replies = []
    with socket.create_connection((host, port), timeout=20) as connection, connection.makefile("rb") as file:
        for message in messages:
            connection.sendall(message if isinstance(message, bytes) else json.dumps(message).encode() + b"\n")
            replies.append(json.loads(file.readline()))
    return replies


NAMED = {**HELLO, "observations": list("abcde"), "actions": list("uv")}
SEE = [{"type": "observe", "now": now} for now in (0.0, 0.5)]  # the first frame comes late
ACT = {"type": "act", "now": 0.5, "slot": 0, "displacement": [0.01, 0.02], "target": [0.4475, 0.32]}
"""From the middle of the limits, where the robot begins."""


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([{**NAMED, "version": 7}], "expected hello of jaxlfi-robot of version 1"),
        ([{**NAMED, "observations": list("abcd")}], r"expected observations \['a', 'b', 'c', 'd', 'e'\], got"),
        ([NAMED, b"nothing\n"], "expected a line of JSON"),
        ([NAMED, {"type": "jump"}], "expected observe, act or stop, got 'jump'"),
        ([NAMED, ACT], "expected an observation before the first command, got none"),
        ([NAMED, *SEE, {**ACT, "displacement": [0.07, 0.0], "target": [0.5075, 0.3]}], "expected a command within"),
        ([NAMED, *SEE, {**ACT, "displacement": [0.05, 0.05], "target": [0.4875, 0.35]}], "expected a command"),
        ([NAMED, *SEE, {**ACT, "target": [0.4575, 0.32]}], "expected a command within Limits"),  # 1 cm more
        ([NAMED, *SEE, {**ACT, "target": [0.4]}], "expected 2 set-points"),
        ([NAMED, *SEE, {**ACT, "target": [0.4, None]}], "expected a command within Limits"),
        ([NAMED, *SEE, ACT, {**ACT, "now": 0.66, "target": [0.4675, 0.34]}], "expected a command within Limits"),
        ([NAMED, *SEE, ACT, {**ACT, "now": 0.51, "target": [0.4575, 0.34]}], "expected a command within Limits"),
    ],
)  # fmt: skip
def test_a_server_stops_its_robot_before_it_does_what_it_should_not(robot_process, messages, expected):
    replies = ask(robot_process, *messages, {"type": "stop"})
    assert [reply["type"] for reply in replies[-2:]] == ["error", "stopped"]
    events = robot_process.last()
    assert stops(events) == [replies[-2]["message"]]
    assert sum(event["event"] == "act" for event in events) == messages[:-1].count(ACT)
    assert re.search(expected, replies[-2]["message"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_server_that_is_told_to_end_stops_its_robot(number, tmp_path):
    process = Server(tmp_path)
    robot, _ = connected(process)
    assert robot.observe() is not None
    process.process.send_signal(number)
    assert stops(process.last()) == ["the server was ended"]
    assert process.process.wait(timeout=20) == 130
    process.end()


def served(make, journal=lambda event: None, clock=Monotonic):
    """The address of a server in a thread, where Python lets signals alone."""
    listener = server.listen(0)
    words = (make, *NAMES, (1, 3), LIMITS, 5.0, journal, clock)
    threading.Thread(target=server.serve, args=(listener, *words), daemon=True).start()
    return f"socket://127.0.0.1:{listener.getsockname()[1]}"


def test_a_robot_that_raises_is_stopped_and_the_next_one_is_served():
    events, made = [], []

    class Hot(Robot):
        def __init__(self):
            super().__init__(on_act=lambda command: 1 / 0)
            made.append(self)

    address = served(lambda clock: Hot(), events.append, Simulated)
    for count in (1, 2):
        clock = Simulated()
        with pytest.raises(RobotError, match="its driver refused act: division by zero"):
            Loop.of(a_policy(), clock=clock).run(SocketRobot(address, *NAMES, timeout=20.0, clock=clock), a_policy())
        assert [robot.stops for robot in made] == [1] * count
    assert stops(events) == ["division by zero"] * 2


@pytest.mark.parametrize(
    ("displacement", "target", "count"),
    [([0.03, 0.0], [0.46, 0.3], 1), ([0.0, 0.0], [0.6, 0.5], 1), ([0.03, 0.0], [0.43, 0.3], 2)],
)
def test_a_server_believes_neither_the_clock_nor_the_place_of_a_loop(displacement, target, count):
    """What it measures is where the first command begins, and its own clock says how fast set-points move."""
    robot, clock = Robot(), Simulated()
    client = SocketRobot(served(lambda clock: robot), *NAMES, timeout=20.0, clock=clock)
    client.observe()
    if count == 2:
        client.act(Command(0, np.array([0.03, 0.0]), np.array([0.43, 0.3])))
        clock.pass_by(PERIOD)  # of the loop; none has passed
        target = [0.46, 0.3]
    with pytest.raises(RobotError, match="its driver refused act: expected a command within Limits"):
        client.act(Command(1, np.array(displacement), np.array(target)))
    assert robot.stops == 1 and len(robot.commands) == count - 1


def test_a_robot_that_is_not_ready_ends_its_connection_and_not_the_server():
    ready, events = [False, True], []

    def make(clock):
        if not ready.pop(0):
            raise OSError("the arm is not ready")
        return Robot()

    address = served(make, events.append)
    with pytest.raises(RobotError, match="its driver refused hello: the arm is not ready"):
        SocketRobot(address, *NAMES, timeout=20.0)
    SocketRobot(address, *NAMES, timeout=20.0).stop()
    assert stops(events) == ["the arm is not ready", "asked to"]


def test_a_journal_that_fails_stops_the_robot_and_not_the_server():
    made = [Robot(), Robot()]

    def journal(event):
        if event["event"] != "begun":
            raise OSError("the disk is full")

    left = list(made)
    address = served(lambda clock: left.pop(0), journal)
    for robot in made:
        client = SocketRobot(address, *NAMES, timeout=20.0)
        client.observe()
        with pytest.raises(RobotError, match="its driver refused act: the disk is full"):
            client.act(Command(0, np.array([0.03, 0.0]), np.array([0.43, 0.3])))
        assert robot.stops == 1 and not robot.commands


def test_a_message_that_comes_byte_by_byte_is_late_all_the_same():
    one, other = socket.socketpair()
    ended = threading.Event()

    def trickle():
        while not ended.wait(0.02):
            other.sendall(b"x")

    thread = threading.Thread(target=trickle, daemon=True)
    thread.start()
    one.settimeout(0.2)
    began = time.monotonic()
    with pytest.raises(TimeoutError):
        wire.Lines(one).receive()
    assert 0.15 < time.monotonic() - began < 5.0 and one.gettimeout() == 0.2
    ended.set()
    thread.join()
    one.close(), other.close()


def test_a_robot_is_stopped_when_nobody_asks_for_anything(tmp_path):
    process = Server(tmp_path, "--watchdog", "0.1")
    robot, _ = connected(process)
    robot.observe()
    assert stops(process.last()) == ["no request came in time"]
    with pytest.raises(RobotError, match="its driver refused observe: no request came in time"):
        robot.observe()
    robot.stop()
    process.end()


def test_a_simulated_robot_of_nothing_is_refused(tmp_path, capsys):
    path = a_policy().save(tmp_path / "policy.npz")
    for words, expected in (
        ([str(tmp_path / "none.npz")], "expected a complete .npz file"),
        ([str(path), "--dropped", "1.5"], r"dropped: expected a number in [0, 1], got 1.5"),
        ([str(path), "--jitter", "0.1"], "jitter: expected at most 0.04 s"),
        ([str(path), "--port", "99999"], "port: expected a number from 0 to 65535, got 99999"),
        ([str(path), "--watchdog", "-1"], "watchdog: expected a positive number of seconds, got -1.0"),
        ([str(path), "--journal", str(tmp_path / "nowhere" / "j")], "No such file or directory"),
    ):
        with pytest.raises(SystemExit) as end:
            simulated.main(words)
        error = capsys.readouterr().err
        assert end.value.code == 2 and expected in error and error.count("\n") == 1
