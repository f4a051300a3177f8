"""`jaxlfi control`: from the words of a command to a recording, and what is refused before anything moves."""

import json
import re
import threading
import time

import numpy as np
import pytest
from robots.machines import Wheel, a_policy, expected, prepared

from jaxlfi.cli.control import main
from jaxlfi.rl.termination import parsed
from jaxlfi.robots import server
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.interrupts import Interrupted

TABLE = """
[robot.limits]
angle = [-0.2, 0.6]

[robot.controls]
motor = { rate = 30.0 }
"""


class Failing(Wheel):
    """Its bus fails at once."""

    def connect(self, signals, controls):
        raise OSError("no such port")


class Hanging(Wheel):
    """A robot on the system's clock, whose bus hangs at the fourth observation."""

    def __init__(self):
        super().__init__(given={3: lambda plain: time.sleep(5.0)})
        self.simulated_clock = None

    def advance(self):
        pass

    def act(self, controls):
        pass


class Armed(Wheel):
    """Only what the first driver interface has."""

    connect = None


@pytest.fixture
def folder(tmp_path):
    a_policy().save(tmp_path / "policy.npz")
    (tmp_path / "task.toml").write_text(TABLE)
    return tmp_path


def words(folder, *more, robot="robots.test_control_command:Wheel", out="log.csv"):
    given = [] if robot is None else ["--robot", robot]
    return [str(folder / "policy.npz"), *given, "--out", str(folder / out), *more]


def test_a_command_controls_and_records(folder, capsys):
    assert main(words(folder)) == 0
    out = capsys.readouterr().out
    assert out.startswith("100 controls at 50 Hz: a period of 20 ms") and out.endswith(f"wrote {folder / 'log.csv'}\n")
    np.testing.assert_allclose(np.load(folder / "log.loop.npz")["targets"][:, 0], expected(100)[0], atol=1e-5)
    assert json.loads((folder / "log.json").read_text())["policy"] == str(folder / "policy.npz")


def test_a_termination_ends_a_command_with_status_0(folder, capsys):
    a_policy(prepared(terminations={"turned": parsed("angle < -0.2")})).save(folder / "policy.npz")
    assert main(words(folder)) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(
        r"the episode ended after \d+ of 100 controls, as in training: turned \(angle < -0.2: .*\)", last
    )


def test_options_change_what_a_robot_is_let(folder, capsys):
    more = ["--config", str(folder / "task.toml"), "--rate", "25", "--duration", "0.4", "--dry-run"]
    assert main(words(folder, *more)) == 0
    report = json.loads((folder / "log.json").read_text())
    assert report["controls"] == 10 and report["timing"]["period"] == 0.04 and report["mode"] == "dry run"
    assert report["limits"]["rate"] == [30.0] and report["settings"]["limits"] == {"angle": [-0.2, 0.6]}
    # The wheel rests where it began, as nothing is commanded.
    assert set(np.load(folder / "log.loop.npz")["observations"][:, 0]) == {0.5}


def test_a_robot_that_leaves_its_bounds_is_an_error_with_a_recording(folder, capsys):
    assert main(words(folder, "--config", str(folder / "task.toml"))) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "angle was measured at -0.2" in error and "robot: stopped after" in error
    assert (folder / "log.csv").exists()


def test_a_driver_that_hangs_is_an_error_with_a_recording(folder, capsys):
    began = time.monotonic()
    assert main(words(folder, robot="robots.test_control_command:Hanging")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "observe took longer than the 0.1 s of the watchdog" in error
    assert time.monotonic() - began < 4.0 and len((folder / "log.csv").read_text().splitlines()) >= 4
    assert "watchdog" in json.loads((folder / "log.json").read_text())["stopped"]


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"out": "log.txt"}, "out: expected a new NAME.csv, NAME.npz, NAME.mcap or folder without a suffix"),
        ({"out": "policy.npz"}, "out: expected a new recording, got"),
        ({"words": ["--config", "policy.npz"]}, "expected a TOML file, got a missing or damaged one"),
        ({"words": ["--config", "empty.toml"]}, "empty.toml: expected a table [robot], got none"),
        ({"words": ["--config", "bad.toml"]}, "bad.toml: robot: limits: angle: expected [LOW, HIGH], got 3"),
        ({"words": ["--config", "other.toml"]}, "limits: expected some of motor, got rotor"),
        ({"words": ["--command", "goal=1"]}, "commands: expected some of none, got goal"),
        ({"words": ["--command", "goal"]}, "argument --command: expected NAME=VALUE, got 'goal'"),
        ({"words": ["--watchdog", "0"]}, "argument --watchdog: expected a number above 0, got '0'"),
        ({"words": ["--holds", "-1"]}, "holds: expected at least 0, got -1"),
        ({"words": ["--dry-run", "--shadow"]}, "not allowed with argument --dry-run"),
        ({"words": ["--remote"]}, "--remote, --token: expected with --address only, got --robot"),
        ({"robot": None}, "one of the arguments --robot --address is required"),
        ({"robot": "wheel"}, "driver: expected one of"),
        ({"robot": "robots.test_control_command:Failing"}, "no such port"),
        ({"robot": "robots.test_control_command:Armed"}, "robot: expected one with connect, observe, act and stop"),
        ({"robot": "math:pi"}, "robot: expected 'math:pi' to have observe, act and stop, got float"),
        ({"robot": None, "words": ["--address", "10.0.0.7:5005"]}, "expected this host, such as 127.0.0.1, got"),
        ({"robot": None, "words": ["--address", "10.0.0.7:5", "--remote"]}, "token: expected the one that the robot"),
        ({"robot": None, "words": ["--address", "127.0.0.1:1"]}, "expected a driver that listens, got"),
        ({"robot": None, "words": ["--address", "127.0.0.1:1", "--token", "short"]}, "expected one line of at least"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(more, expected, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "empty.toml").write_text("model = 'a.xml'\n")
    (folder / "bad.toml").write_text("[robot.limits]\nangle = 3\n")
    (folder / "other.toml").write_text("[robot.controls]\nrotor = { rate = 1.0 }\n")
    (folder / "short").write_text("secret\n")
    before = set(folder.iterdir())
    given = {key: value for key, value in more.items() if key != "words"}
    try:
        status = main(words(folder, *more.get("words", []), **given))
    except SystemExit as end:
        status = end.code
    error = capsys.readouterr().err
    assert status == 2 and expected in error and error.count("\n") == 1
    assert set(folder.iterdir()) == before


def test_a_driver_in_another_process_is_controlled_by_its_address(folder, capsys):
    listener, made = server.listen(0), []

    def make(clock):
        made.append(Wheel(clock))
        made[-1].connect = lambda signals, controls: {"simulated": True, "name": "served"}
        return made[-1]

    threading.Thread(target=serve, args=(listener, make), daemon=True).start()
    address = f"127.0.0.1:{listener.getsockname()[1]}"
    assert main(words(folder, "--address", address, robot=None)) == 0
    np.testing.assert_allclose(np.load(folder / "log.loop.npz")["targets"][:, 0], expected(100)[0], atol=1e-5)
    report = json.loads((folder / "log.json").read_text())
    assert report["robot"]["name"] == "served" and made[0].stops == 1 and len(made[0].torques) == 100
    listener.close()


def serve(listener, make):
    """Until the listener is closed."""
    try:
        server.serve_driver(listener, make, clock=Simulated, watchdog=5.0)
    except (OSError, Interrupted):
        return
