"""A loop that is killed, interrupted or left by its machine keeps what was recorded, and goes on from there.

The loop runs in a process of its own; inference and training are complete before it starts. The machine is served from
here, and holds the loop up in the midst of an episode.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("brax")

from envs_mujoco_cart import MODEL, PREPARATION, TASK
from robots.machines import a_policy

from jaxlfi.envs.mujoco import logs, r2s2r, r2s2r_machine, r2s2r_page
from jaxlfi.envs.mujoco.served import Machine
from jaxlfi.robots import server
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.robot import RobotError

EPISODES = 4


class Served:
    """A machine that hangs at one observation of one of its connections until it is released.

    Attributes:
        reached: is set there.
        released: is waited for.
        connections: so far.
    """

    def __init__(self, config, connection, observation):
        self.machine, self.hangs, self.connections = Machine.of(config, scattered=True), (connection, observation), 0
        self.reached, self.released = threading.Event(), threading.Event()
        self.listener = server.listen(0)
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with contextlib.suppress(OSError):  # once the listener is closed
            server.serve_driver(self.listener, self._driver, self.machine.limits(), 60.0, clock=Simulated)

    def _driver(self, clock):
        connection, self.connections = self.connections, self.connections + 1
        driver, count, plain = self.machine.driver(clock, connection), 0, None
        plain = driver.observe

        def observe():
            nonlocal count
            if (connection, count) == self.hangs:
                self.reached.set()
                assert self.released.wait(60)
            count += 1
            return plain()

        driver.observe = observe
        return driver


@pytest.fixture
def loop(tmp_path):
    """The words of a loop whose inference and training are complete, and its folder."""
    (tmp_path / "cart.xml").write_text(MODEL)
    (tmp_path / "task.toml").write_text(TASK)
    out = tmp_path / "loop"
    words = [f"mujoco,config={tmp_path / 'task.toml'}", "--iterations", "1", "--episodes", str(EPISODES)]
    words += ["--beside", "--out", str(out)]
    arguments = r2s2r.parser().parse_args([*words, "--address", "127.0.0.1:1"])
    r2s2r._begin(arguments, tmp_path / "task.toml")
    policy = out / "iteration_1/policy/domain/seed_000/policy.npz"
    policy.parent.mkdir(parents=True)
    a_policy(PREPARATION, [[-1.5]]).save(policy)
    (out / "iteration_1/policy/curves.png").write_bytes(b"")
    (out / "iteration_1/posterior").mkdir()
    (out / "iteration_1/posterior/report.html").write_bytes(b"")
    return words, out


def killed(words, served, number):
    """End a loop by a signal while its machine hangs; its exit status and what it said."""
    command = [sys.executable, "-c", "import sys; from jaxlfi.envs.mujoco.r2s2r import main; sys.exit(main())"]
    process = subprocess.Popen(
        [*command, *words, "--address", served.address],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    try:
        assert served.reached.wait(120)
        process.send_signal(number)
        if number == signal.SIGKILL:
            process.wait()
        served.released.set()
        said, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    return process.returncode, said


def whole(out):
    """When each recording that is complete was written, by name."""
    found = {path.stem: path for path in [*out.glob("*.json"), *out.glob("deployed/*.json")] if path.stem != "config"}
    kept = {name: path for name, path in found.items() if not json.loads(path.read_text()).get("failed")}
    return {name: path.stat().st_mtime_ns for name, path in kept.items()}


@pytest.mark.parametrize(
    ("number", "connection", "observation"),
    [
        pytest.param(signal.SIGKILL, 3, 4),
        pytest.param(signal.SIGINT, 0, 20, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, 0, 20, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, 3, 4, marks=pytest.mark.slow),
    ],
)
def test_a_loop_goes_on_from_where_it_was_ended(number, connection, observation, loop, monkeypatch, tmp_path):
    """In the excitation, and in the third episode of the policy."""
    words, out = loop
    served = Served(tmp_path / "task.toml", connection, observation)
    status, said = killed(words, served, number)
    before = whole(out)
    assert len(before) == connection, said
    broken = out / "excitation.csv" if connection == 0 else out / "deployed/iteration_1_2.csv"
    if number == signal.SIGINT:
        assert status == 130 and "interrupted; the same command goes on from here" in said
        assert logs.read(broken).signals["place"].shape == (observation + 1,)  # the call that hung has returned
        assert json.loads(broken.with_suffix(".json").read_text())["stopped"] == "SIGINT"
    else:
        assert status == -signal.SIGKILL and not broken.with_suffix(".json").exists()
    monkeypatch.setattr(r2s2r_page, "write", lambda *arguments: out / "page.html")
    again = Served(tmp_path / "task.toml", -1, 0)  # another port is no other loop
    assert r2s2r.main([*words, "--address", again.address]) == 0
    after = whole(out)
    assert len(after) == 1 + EPISODES and {name: after[name] for name in before} == before
    assert again.connections == 1 + EPISODES - connection
    aside = sorted(path.relative_to(out) for path in out.glob("**/*.cut-1/*.csv"))
    cut = {0: Path("excitation.cut-1/excitation.csv"), 3: Path("deployed/iteration_1_2.cut-1/iteration_1_2.csv")}
    assert aside == ([cut[connection]] if number == signal.SIGINT else [])
    for listening in (served, again):
        listening.listener.close()


def test_a_machine_that_dies_leaves_what_it_measured(tmp_path, monkeypatch, capsys):
    """The loop says so; the next time the recording is made anew, and the first one is kept beside it."""
    (tmp_path / "cart.xml").write_text(MODEL)
    (config := tmp_path / "task.toml").write_text(TASK)
    policy = a_policy(PREPARATION, [[-1.5]]).save(tmp_path / "policy.npz")
    dies = 6

    @contextlib.contextmanager
    def connected(arguments, config, seed, scattered=False, first=0):
        def driver():
            clock, count = Simulated(), 0
            one = Machine.of(config).driver(clock)
            one.simulated_clock, plain = clock, one.observe

            def observe():
                nonlocal count
                count += 1
                if count == dies:
                    raise RobotError("robot 127.0.0.1:5005: it closed the connection")
                return plain()

            one.observe = observe
            return one

        yield driver

    monkeypatch.setattr(r2s2r_machine, "connected", connected)
    arguments = r2s2r.parser().parse_args(["mujoco", "--out", str(tmp_path), "--seed", "3"])
    path = tmp_path / "rollout.csv"
    with pytest.raises(RobotError, match=rf"it closed the connection; the measurements until then are in {path}$"):
        r2s2r_machine.rolled_out(arguments, config, policy, path, 1)
    assert logs.read(path).signals["place"].shape == (5,)
    with pytest.raises(
        RobotError, match=r"it closed the connection; the measurements until then are in .*excited.csv$"
    ):
        r2s2r_machine.excited(arguments, config, tmp_path / "excited.csv")
    dies = 0
    assert r2s2r_machine.rolled_out(arguments, config, policy, path, 1) == path
    assert (
        f"{path} was cut short: it is kept in {tmp_path / 'rollout.cut-1'}, and recorded again"
        in capsys.readouterr().out
    )
    assert len(np.load(path.with_suffix(".loop.npz"))["targets"]) == 10
    assert logs.read(tmp_path / "rollout.cut-1/rollout.csv").signals["place"].shape == (5,)
    written = path.stat().st_mtime_ns
    assert r2s2r_machine.rolled_out(arguments, config, policy, path, 1) == path and path.stat().st_mtime_ns == written


def test_a_recording_of_its_beginning_only_is_nothing_to_infer_from(tmp_path, monkeypatch):
    (tmp_path / "cart.xml").write_text(MODEL)
    (config := tmp_path / "task.toml").write_text(TASK + "[robot.limits]\nplace = [0.0, 1.0]\n")
    arguments = r2s2r.parser().parse_args(["mujoco", "--out", str(tmp_path)])

    @contextlib.contextmanager
    def connected(arguments, config, seed, scattered=False, first=0):
        def driver():
            one = Machine.of(config).driver(clock := Simulated())
            one.simulated_clock = clock
            return one

        yield driver

    monkeypatch.setattr(r2s2r_machine, "connected", connected)
    expected = r"expected at least 2 controls to infer from, got 0: place was measured at -0.5, outside of its limits"
    with pytest.raises(ValueError, match=expected):
        r2s2r_machine.excited(arguments, config, tmp_path / "excited.csv")
