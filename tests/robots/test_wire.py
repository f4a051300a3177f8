"""The wire between a loop and a driver: who may command, what is refused, and two thousand damaged messages."""

import contextlib
import json
import math
import re
import socket
import threading
import time

import numpy as np
import pytest
from robots.machines import Wheel, a_policy, expected

from jaxlfi.rl.deployment import ControlLimits
from jaxlfi.robots import driving, server, wire
from jaxlfi.robots.client import SocketDriver, SocketRobot
from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import RobotError
from jaxlfi.robots.settings import Settings

SIGNALS, CONTROLS = {"angle": "rad", "joint/wheel/qvel": "rad/s"}, {"motor": "N m"}
LIMITS = ControlLimits(("motor",), (-2.0,), (3.0,), (60.0,))
TOKEN = "a token of this laboratory"


class Served:
    """A server in a thread."""

    def __init__(self, make=Wheel, clock=Simulated, watchdog=5.0, **more):
        self.listener, self.made, self.events = server.listen(0), [], []
        self.address = f"socket://127.0.0.1:{self.listener.getsockname()[1]}"
        words = {"limits": LIMITS, "watchdog": watchdog, "journal": self.events.append, "clock": clock, **more}
        threading.Thread(target=self.serve, args=(make, words), daemon=True).start()

    def serve(self, make, words):
        def kept(clock):
            self.made.append(make(clock))
            return self.made[-1]

        with contextlib.suppress(OSError):
            server.serve_driver(self.listener, kept, **words)

    def why(self):
        """Why each robot was stopped, once the last one was."""
        ends = time.monotonic() + 10.0
        while sum(event["event"] == "stopped" for event in self.events) < max(len(self.made), 1):
            assert time.monotonic() < ends
            time.sleep(0.005)
        return [event["why"] for event in self.events if event["event"] == "stopped"]


@pytest.fixture
def served():
    made = []

    def make(*args, **more):
        made.append(Served(*args, **more))
        return made[-1]

    yield make
    for one in made:
        one.listener.close()


def connected(address, **more):
    driver = SocketDriver(address, timeout=5.0, **more)
    driver.connect(SIGNALS, CONTROLS)
    return driver


class InLoopsTime(Wheel):
    def connect(self, signals, controls):
        super().connect(signals, controls)
        return {"simulated": True}


def test_a_driver_behind_the_wire_is_controlled_as_one_that_is_here(served):
    process = served(InLoopsTime)
    loop = driving.Drive.of(a_policy())
    robot, loop, about = driving.connected(loop, SocketDriver(process.address), Settings())
    assert about == {"simulated": True} and isinstance(loop.clock, Simulated)
    log = loop.run(robot, a_policy())
    torques, seen = expected(100)
    np.testing.assert_allclose(log.targets[:, 0], torques, atol=1e-5)
    np.testing.assert_allclose(log.observations, seen, atol=1e-5)
    assert process.why() == ["asked to"] and process.made[0].asked == SIGNALS and process.made[0].controls == CONTROLS


def test_a_driver_refuses_what_it_does_not_have_by_the_wire_too(served):
    process = served()
    with pytest.raises(RobotError, match="its driver refused hello: robot: expected signals among angle"):
        SocketDriver(process.address, timeout=5.0).connect({"height": "m"}, CONTROLS)
    assert process.made[0].stops == 1 and "got height" in process.why()[0]


def test_a_server_checks_every_control_by_its_own_clock(served):
    """The loop's clock says that seconds have passed; on the server's none has."""
    process = served(clock=Monotonic)
    for first, second, word in ((2.5, 3.1, "3.1"), (0.5, 2.9, "2.9")):
        driver = connected(process.address)
        driver.observe()
        driver.act({"motor": first})
        with pytest.raises(RobotError, match=f"expected a command within ControlLimits.*got .* to .{word}."):
            driver.act({"motor": second})
        driver.stop()
    assert [robot.stops for robot in process.made] == [1, 1]
    assert [[torque for _, torque in robot.torques] for robot in process.made] == [[2.5], [0.5]]


def test_a_client_shows_that_it_knows_the_token_without_sending_it(served):
    process = served(token=TOKEN)
    for token, why in ((None, "it requires a shared token, got none"), ("another token, alas", "got another")):
        with pytest.raises(RobotError, match=why):
            connected(process.address, token=token)
    assert not process.made  # a robot is not even made
    driver = connected(process.address, token=TOKEN)
    assert driver.observe().values["angle"] == 0.5
    driver.stop()
    with socket.create_connection(wire.address(process.address)) as spy, spy.makefile("rb") as file:
        spy.sendall(json.dumps(hello()).encode() + b"\n")
        challenge = json.loads(file.readline())
        assert challenge["type"] == "challenge" and len(challenge["nonce"]) == 32
        spy.sendall(json.dumps({**hello(), "proof": wire.proof(TOKEN, "f" * 32)}).encode() + b"\n")  # of another time
        assert json.loads(file.readline())["message"] == "expected proof of the shared token, got another"


def hello(**more):
    names = {"observations": list(SIGNALS), "actions": list(CONTROLS)}
    return {"type": "hello", "protocol": wire.PROTOCOL, "version": wire.VERSION, **names, **more}


def test_a_robot_that_other_hosts_reach_needs_a_token_on_both_sides():
    listener = server.listen(0, "0.0.0.0")
    with (
        listener,
        pytest.raises(ValueError, match=r"token: expected one for 0.0.0.0, an address that other hosts reach"),
    ):
        server.serve_driver(listener, Wheel)
    with pytest.raises(ValueError, match=r"token: expected the one that the robot at 10.0.0.7, another host, shares"):
        SocketRobot("socket://10.0.0.7:5005", ["a"], ["b"], remote=True)


def test_tokens_that_are_easily_guessed_are_refused(tmp_path):
    (tmp_path / "token").write_text(f"  {TOKEN}\n")
    assert wire.token_of(tmp_path / "token") == TOKEN
    for text, got in (("secret", "got 6"), ("two lines of\ntoken, each one", "expected one line")):
        (tmp_path / "token").write_text(text)
        with pytest.raises(ValueError, match=got):
            wire.token_of(tmp_path / "token")
    with pytest.raises(ValueError, match=r"token: expected a file with a token, got .*none, which cannot be read"):
        wire.token_of(tmp_path / "none")


def test_a_second_client_is_refused_and_the_robot_is_stopped(served):
    process = served(watchdog=20.0)
    first = connected(process.address)
    first.observe()
    with pytest.raises(RobotError, match=r"its driver refused hello: busy: another client came|reset by peer|closed"):
        connected(process.address)
    with pytest.raises(RobotError, match="its driver refused act: busy: another client came while one had the robot"):
        first.act({"motor": 0.5})
    with contextlib.suppress(RobotError):
        first.stop()
    assert process.why() == [wire.BUSY] and process.made[0].stops == 1 and not process.made[0].torques
    third = connected(process.address)  # the next one has it alone
    third.observe()
    third.stop()
    assert process.made[1].stops == 1


def test_a_driver_that_must_be_stopped_in_another_thread_hears_of_it_while_a_call_hangs(served):
    """The watchdog's stop goes out although observe has not been answered."""

    class Slow(Wheel):
        def observe(self):
            if self.number == 3:
                time.sleep(1.0)
            return super().observe()

    process = served(Slow, clock=Monotonic)
    loop = driving.Drive.of(a_policy(), watchdog=0.2)
    robot, loop, _ = driving.connected(loop, SocketDriver(process.address, timeout=5.0), Settings())
    began = time.monotonic()
    with pytest.raises(RobotError, match=r"observe took longer than the 0.2 s of the watchdog"):
        loop.run(robot, a_policy())
    assert time.monotonic() - began < 4.0
    process.why()
    assert process.made[0].stops == 1 and len(process.made[0].torques) == 4


# ------------------------------------------------------------------------------------------------- damaged messages


SEE, NOW = {"type": "observe", "now": 0.0}, 0.5
ACT = {"type": "act", "now": NOW, "slot": 0, "displacement": [0.25], "target": [0.25]}
NUMBERS = ("1e999", "-Infinity", "NaN", "null", "true", '"1"', "[]", "{}", "9" * 400, "9" * 5000, "1e301")
"""What is no number, in JSON or beside it."""


def damaged(rng):
    """A message that no server may take, and its kind."""
    kind = KINDS[rng.integers(len(KINDS))]
    return kind(rng), kind.__name__


def noise(rng):
    return rng.integers(0, 256, rng.integers(1, 200), np.uint8).tobytes().replace(b"\n", b"?") + b"\n"


def cut(rng):
    """Short of its end, and so no JSON."""
    text = json.dumps(ACT if rng.random() < 0.5 else SEE).encode()
    return text[: rng.integers(1, len(text))] + b"\n"


def changed(rng):
    """A byte that is one of JSON's own is another."""
    text = bytearray(json.dumps(ACT).encode())
    places = [place for place, byte in enumerate(text) if byte in b'{}[]:"']
    text[places[rng.integers(len(places))]] = b"#%&~"[rng.integers(4)]
    return bytes(text) + b"\n"


def no_number(rng):
    """Where one is expected."""
    word = NUMBERS[rng.integers(len(NUMBERS))]
    where = ("now", "slot", "displacement", "target")[rng.integers(4)]
    other = word if where in ("now", "slot") else f"[{word}]"
    text = ", ".join(f'"{key}": {other if key == where else json.dumps(value)}' for key, value in ACT.items())
    return f"{{{text}}}\n".encode()


def too_many(rng):
    """Another number of them than there are controls."""
    size = int(rng.choice([0, 2, 3, 1000]))
    return json.dumps({**ACT, "displacement": [0.25] * size, "target": [0.25] * size}).encode() + b"\n"


def too_far(rng):
    """A set-point beyond a limit, or where the displacement does not lead."""
    far = float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(0.6, 200))
    other = {"target": [0.25 + 0.01 * far]} if rng.random() < 0.3 and abs(far) < 1e3 else {"target": [far]}
    return json.dumps({**ACT, **other, **({} if len(other) == 2 else {"displacement": [far]})}).encode() + b"\n"


def unknown(rng):
    """Another request, or none."""
    word = rng.choice(["hello", "Act", "", "stop ", "\ud800", "x" * 2000, "__class__"])
    message = [{**ACT, "type": str(word)}, {"now": 0.0}, {"type": 7}, {"type": None}, [ACT], "act", 3, None, True]
    return json.dumps(message[rng.integers(len(message))]).encode() + b"\n"


def deep(rng):
    """Nested deeper than anybody reads."""
    depth = int(rng.integers(2_000, 3_500))
    return (b"[" * depth + b"]" * depth if rng.random() < 0.5 else b'{"type":' * depth + b"1" + b"}" * depth) + b"\n"


def endless(rng):
    """More than a line may have, without an end."""
    return rng.choice([b"x", b" ", b"[", b"\x00"]) * (LONGEST + int(rng.integers(1, 200)))


KINDS = (noise, cut, changed, no_number, too_many, too_far, unknown, deep, endless)
LONGEST = 8192
"""Of a line, here."""
COUNT = 1500
"""Damaged requests; and a third as many damaged replies."""


def test_damaged_requests_are_refused_and_the_robot_is_stopped_each_time(monkeypatch):
    """1,500 of them, each after a greeting and an observation: nothing is commanded, the stop is called once."""
    monkeypatch.setattr(wire, "LONGEST", LONGEST)
    rng, listener, seen = np.random.default_rng(0), server.listen(0), {}
    begin = b"".join(json.dumps(one).encode() + b"\n" for one in (hello(), SEE))
    with Interrupts() as interrupts, listener:
        for _ in range(COUNT):
            made, events = [], []
            kind = server._Named(lambda clock, made=made: made.append(Wheel(clock)) or made[0], LIMITS)
            ours, theirs = socket.socketpair()
            with ours, theirs:
                message, name = damaged(rng)
                theirs.sendall(begin + message)
                theirs.shutdown(socket.SHUT_WR)
                ours.settimeout(5.0)
                session = server._Session(kind, Simulated(), events.append, interrupts, listener, None)
                session.run(wire.Lines(ours))
                ours.shutdown(socket.SHUT_WR)
                replies = [json.loads(line) for line in theirs.makefile("rb")]
            assert made[0].stops == 1 and not made[0].torques, message[:200]
            assert [reply["type"] for reply in replies] == ["hello", "observation", "error"], message[:200]
            assert [event["event"] for event in events] == ["begun", "stopped"]
            assert len(replies[-1]["message"]) <= 1000 and "\n" not in replies[-1]["message"]
            seen[name] = seen.get(name, 0) + 1
    assert len(seen) == len(KINDS) and min(seen.values()) > COUNT / len(KINDS) / 2


def test_a_robot_in_the_loops_time_does_not_leap_ahead_for_hours():
    made, far = [], {**SEE, "now": 1e12}
    kind = server._Named(lambda clock: made.append(Wheel(clock)) or made[0], LIMITS)
    ours, theirs = socket.socketpair()
    with ours, theirs, server.listen(0) as listener, Interrupts() as interrupts:
        theirs.sendall(b"".join(json.dumps(one).encode() + b"\n" for one in (hello(), SEE, far)))
        theirs.shutdown(socket.SHUT_WR)
        ours.settimeout(5.0)
        server._Session(kind, Simulated(), lambda event: None, interrupts, listener, None).run(wire.Lines(ours))
        ours.shutdown(socket.SHUT_WR)
        last = [json.loads(line) for line in theirs.makefile("rb")][-1]
    assert last["message"] == "expected a time within 3600 s of 0 s, got 1e+12 s" and made[0].stops == 1


def test_a_message_that_is_not_damaged_is_taken_so(monkeypatch):
    """The requests above are refused for what is wrong with them."""
    made = []
    kind = server._Named(lambda clock: made.append(Wheel(clock)) or made[0], LIMITS)
    ours, theirs = socket.socketpair()
    with ours, theirs, server.listen(0) as listener, Interrupts() as interrupts:
        theirs.sendall(b"".join(json.dumps(one).encode() + b"\n" for one in (hello(), SEE, ACT, {"type": "stop"})))
        ours.settimeout(5.0)
        server._Session(kind, Simulated(), lambda event: None, interrupts, listener, None).run(wire.Lines(ours))
    assert [torque for _, torque in made[0].torques] == [0.25] and made[0].stops == 1


def test_damaged_replies_end_a_loop_with_one_line_and_a_stop(monkeypatch):
    """500 of them, in the place of an observation."""
    monkeypatch.setattr(wire, "LONGEST", LONGEST)
    rng = np.random.default_rng(1)
    greeting = json.dumps({"type": "hello", "protocol": wire.PROTOCOL, "version": wire.VERSION, "about": {}}).encode()
    plain = {"type": "observation", "number": 0, "age": 0.0, "values": [0.5, 0.0]}
    for _ in range(COUNT // 3):
        word, where = NUMBERS[rng.integers(len(NUMBERS))], ("number", "age", "values")[rng.integers(3)]
        wrong = word if where != "values" else f"[{word}, {word}, 0.0]"
        text = ", ".join(f'"{key}": {wrong if key == where else json.dumps(value)}' for key, value in plain.items())
        kind = (noise, cut, deep, endless, unknown)[rng.integers(5)]
        message = f"{{{text}}}\n".encode() if rng.random() < 0.5 else kind(rng)
        ours, theirs = socket.socketpair()
        monkeypatch.setattr(socket, "create_connection", lambda address, timeout, ours=ours: ours)
        with ours, theirs:
            ours.settimeout(5.0)
            theirs.sendall(greeting + b"\n" + message)
            theirs.shutdown(socket.SHUT_WR)
            driver = SocketDriver("socket://127.0.0.1:5")
            driver.connect(SIGNALS, CONTROLS)
            with pytest.raises(RobotError) as error:
                driver.observe()
            assert "\n" not in str(error.value) and len(str(error.value)) < 500
            with contextlib.suppress(RobotError):  # nobody answers
                driver.stop()
            sent = [json.loads(line)["type"] for line in theirs.makefile("rb")]
        assert sent == ["hello", "observe", "stop"]


def test_numbers_of_a_message_are_finite_and_no_larger_than_a_float():
    message = {"type": "act", "a": 10**400, "b": math.inf, "c": True, "d": 1e301, "e": -2}
    assert wire.number(message, "e") == -2
    for name in "abcd":
        with pytest.raises(RobotError, match=re.escape(f"expected a number as {name!r} of 'act', got ")):
            wire.number(message, name)
