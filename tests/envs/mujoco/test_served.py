"""The machine that stands for a real one: another integrator, unmodelled effects, and recordings to infer from."""

import json
import subprocess
import sys

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

import envs_mujoco_cart
from robots.machines import a_policy

from jaxlfi.envs.mujoco import config, logs
from jaxlfi.envs.mujoco.cli import main
from jaxlfi.envs.mujoco.served import Machine, MachineDriver
from jaxlfi.rl.preparation import Control, Preparation, Signal
from jaxlfi.robots import driving, sessions
from jaxlfi.robots.client import SocketDriver
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.robot import RobotError
from jaxlfi.robots.settings import Settings

MODEL = envs_mujoco_cart.MODEL.replace('timestep="0.01"', 'timestep="0.005"').replace("-4 6", "-4 4")
TASK = """
model = "cart.xml"
[parameters."body/cart/mass"]
support = [1.0, 3.0]
truth = 2.5
[parameters."control/delay"]
support = [0.0, 0.1]
truth = 0.04
[noise]
place = NOISE
[initial]
"rail/qpos" = -0.5
[policy]
interval = 0.02
duration = 2.0
observed = ["place", "joint/rail/qvel"]
[policy.targets.place]
value = 0.0
[policy.initial]
"rail/qpos" = [1.0, 2.0]
"""
PREPARATION = Preparation(
    (Signal("place", "m"), Signal("joint/rail/qvel", "m/s")), (Control("push", -4.0, 4.0),), 0.02, 100
)


@pytest.fixture
def task(tmp_path):
    def written(noise=0.0):
        (tmp_path / "cart.xml").write_text(MODEL)
        (tmp_path / "task.toml").write_text(TASK.replace("NOISE", str(noise)))
        return tmp_path / "task.toml"

    return written


def driven(machine, controls, signals=("place",), episode=0, interval=0.02):
    """What a machine measures under controls, by default one every 20 ms."""
    clock, rows = Simulated(), []
    driver = MachineDriver(machine, clock, episode)
    driver.connect(dict.fromkeys(signals, ""), {"push": ""})
    for control in controls:
        rows.append([driver.observe().values[name] for name in signals])
        driver.act({"push": control})
        clock.pass_by(interval)
    return np.array(rows)


def test_without_unmodelled_effects_it_is_the_model_of_its_truths(task):
    """Compared with the closed form of a damped mass under held forces that come 40 ms late."""
    controls = np.random.default_rng(0).uniform(-3, 4, 50)
    found = driven(Machine.of(task(), unmodelled=0.0), controls, ("place", "joint/rail/qvel"))
    place, speed, rows, mass, damping = -0.5, 0.0, [], 2.5, 5.0
    late = np.concatenate([[0.0, 0.0], controls])
    for force in late[:50]:
        rows.append((place, speed))
        rest, fade = force / damping, np.exp(-damping / mass * 0.02)
        place += rest * 0.02 + (speed - rest) * mass / damping * (1 - fade)
        speed = rest + (speed - rest) * fade
    np.testing.assert_allclose(found, rows, atol=1e-7)


def test_controls_act_at_times_that_spread_by_the_jitter(task):
    """When a constant push began follows from the speed of a damped mass, to half a step of the simulation."""
    path = task()
    jitter = '[parameters."clock/jitter"]\nsupport = [0.0, 0.02]\ntruth = 0.008\n[noise]'
    path.write_text(path.read_text().replace("[noise]", jitter))
    machine, mass, damping, force = Machine.of(path, unmodelled=0.0), 2.5, 5.0, 3.0
    speeds = np.array([driven(machine, [force] * 9, ("joint/rail/qvel",), episode)[-1, 0] for episode in range(50)])
    began = 8 * 0.02 + mass / damping * np.log(1 - speeds * damping / force)
    assert began.mean() == pytest.approx(0.04, abs=4 * 0.008 / np.sqrt(50) + 0.001)
    assert began.std() == pytest.approx(0.008, rel=4 / np.sqrt(100))


def test_a_late_sensor_gives_out_what_it_measured_before_and_the_others_what_they_measure_now(task):
    path, signals = task(), ("place", "joint/rail/qvel")
    controls = np.random.default_rng(1).uniform(-3, 4, 40)
    now = driven(Machine.of(path), np.repeat(controls, 2), signals, interval=0.01)
    late = '[parameters."sensor/place/delay"]\nsupport = [0.0, 0.1]\ntruth = 0.05\n[noise]'
    path.write_text(path.read_text().replace("[noise]", late))
    found = driven(Machine.of(path), controls, signals)
    before = np.maximum(2 * np.arange(40) - 5, 0)
    np.testing.assert_allclose(found, np.stack([now[before, 0], now[::2, 1]], axis=1), atol=1e-7)
    assert np.abs(found[:, 0] - now[::2, 0]).max() > 0.004


def test_unmodelled_effects_are_those_that_are_described(task):
    """Where a constant force leads: loss, damping and drag balance it; friction has fallen to nothing."""
    found = driven(Machine.of(task()), [3.0] * 250, ("joint/rail/qvel",))
    speed = np.roots([0.1 * 5.0, 5.0, -0.98 * 3.0]).max()
    np.testing.assert_allclose(found[-1], speed, rtol=2e-3)
    slow = driven(Machine.of(task()), [0.01] * 100, ("joint/rail/qvel",))
    assert 0 < slow[-1] < 0.01 * 0.98 / 5.0 / 1.5  # friction of up to 0.04 N holds most of the force


def test_sensors_have_the_noise_of_the_task_and_a_seed_of_their_own(task):
    rest = [0.0] * 250
    one = driven(Machine.of(task(0.02), seed=1), rest)
    assert np.std(one + 0.5) == pytest.approx(0.02, rel=0.2) and abs(np.mean(one + 0.5)) < 0.004
    assert (one != driven(Machine.of(task(0.02), seed=2), rest)).all()


def test_scattered_episodes_begin_where_those_of_the_training_do(task):
    machine = Machine.of(task(), scattered=True)
    begins = [driven(machine, [0.0], episode=episode)[0, 0] for episode in range(20)]
    assert all(1.0 <= place <= 2.0 for place in begins) and max(begins) - min(begins) > 0.3
    assert begins[7] == driven(machine, [0.0], episode=7)[0, 0]  # whatever went before it


def test_a_served_machine_begins_at_any_episode_and_ends_with_who_started_it(task):
    path = task()
    words = [sys.executable, "-m", "jaxlfi.envs.mujoco.cli", "serve", str(path), "--scattered", "--until-closed"]
    words += ["--seed", "2", "--first-episode", "4"]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        address, found = process.stdout.readline().split()[-1], []
        for _ in range(2):
            driver = SocketDriver(address)
            driver.connect({"place": "m"}, {"push": ""})
            found.append(driver.observe().values["place"])
            driver.stop()
        machine = Machine.of(path, seed=2, scattered=True)
        assert found == [driven(machine, [0.0], episode=episode)[0, 0] for episode in (4, 5)]
        process.stdin.close()
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_machine_in_another_process_is_controlled_and_its_recording_is_a_task(task, tmp_path):
    """What a policy records is read as it is, by the names and the units of the task."""
    path = task(0.001)
    words = [sys.executable, "-m", "jaxlfi.envs.mujoco.cli", "serve", str(path), "--truth", "body/cart/mass=1.5"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().split()[-1]
        policy = a_policy(PREPARATION, weights=[[-12.0], [-2.0]])
        log = sessions.of(policy, Settings()).run(SocketDriver(address), tmp_path / "real.csv", {})

        class Dying(SocketDriver):
            """Its process is killed before the sixth observation."""

            seen = 0

            def observe(self):
                self.seen += 1
                if self.seen == 6:
                    process.kill()
                    process.wait()
                return super().observe()

        with pytest.raises(RobotError, match=r"^robot 127.0.0.1:\d+: .*; and stopping the robot failed: "):
            sessions.of(policy, Settings()).run(Dying(address), tmp_path / "died.csv", {})
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert len(log.targets) == 100 and logs.read(tmp_path / "died.csv").signals["push"].shape == (5,)
    assert "closed" in (told := json.loads((tmp_path / "died.json").read_text())["stopped"]) or "reset" in told
    assert abs(log.observations[-1, 0]) < abs(log.observations[0, 0]) / 3
    read = logs.read(tmp_path / "real.csv")
    assert set(read.signals) == {"place", "joint/rail/qvel", "push"}
    assert read.units == {"time": "s", "place": "m", "joint/rail/qvel": "m/s"}
    made = config.read(path, [tmp_path / "real.csv"])
    assert made.channels == ("place [m]", "joint/rail/qvel [m/s]") and made.observation.shape == (101, 2)
    np.testing.assert_allclose(made.observation[:, 0], log.observations[:, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--truth", "body/cart/weight=1"], "truth: expected parameters of "),
        (["--truth", "body/cart/mass"], "argument --truth: expected NAME=VALUE, got 'body/cart/mass'"),
        (["--unmodelled", "-1"], "unmodelled: expected a number of at least 0, got -1"),
        (["--port", "70000"], "port: expected a number from 0 to 65535, got 70000"),
        (["--host", "0.0.0.0"], "token: expected one for 0.0.0.0, an address that other hosts reach, got none"),
        (["--token", "none"], "token: expected a file with a token, got none"),
    ],
)
def test_what_is_no_machine_is_refused(words, expected, task, capsys):
    try:
        status = main(["serve", str(task()), *words])
    except SystemExit as end:
        status = end.code
    error = capsys.readouterr().err
    assert status == 2 and expected in error and error.count("\n") == 1


def test_a_task_without_truths_needs_them(task):
    path = task()
    path.write_text(path.read_text().replace("truth = 2.5\n", ""))
    with pytest.raises(ValueError, match="truth: expected one of each parameter, as --truth NAME=VALUE, got none"):
        Machine.of(path)
    assert Machine.of(path, {"body/cart/mass": 2.0}).truth == {"body/cart/mass": 2.0, "control/delay": 0.04}
    with pytest.raises(ValueError, match="robot: expected controls among push, got pull"):
        MachineDriver(Machine.of(path, {"body/cart/mass": 2.0}), Simulated()).connect({}, {"pull": ""})


def test_policies_carry_what_a_robot_keeps_to_with_the_units_of_the_model(task):
    environment = pytest.importorskip("jaxlfi.envs.mujoco.environment").environment
    path = task()
    table = """
[robot.limits]
"joint/rail/qvel" = [-2.0, 2.0]
"body/cart/pos[0]" = [-1.5, 2.5]
[robot.controls]
push = { rate = 100.0 }
"""
    plain = path.read_text()
    path.write_text(plain + table)
    made = environment(path)
    assert made.robot["units"] == {"body/cart/pos[0]": "m"}
    loop = driving.Drive.of(a_policy(made.preparation, [[0.0], [0.0]], made.robot))
    assert loop.asked == {"place": "m", "joint/rail/qvel": "m/s", "body/cart/pos[0]": "m"}
    assert loop.bounds["body/cart/pos[0]"] == (-1.5, 2.5) and loop.limits.rate == (100.0,)
    for change, expected in (
        (("body/cart/pos[0]", "body/car/pos[0]"), r"robot: 'body/car/pos\[0\]': expected one such as cart, got"),
        (("push = {", "pull = {"), "robot: limits: expected some of push, got pull"),
        (("[robot.controls]", "[robot.control]"), "robot: expected keys among controls, "),
    ):
        path.write_text(plain + table.replace(*change))
        with pytest.raises(ValueError, match=expected):
            environment(path)
