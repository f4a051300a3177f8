"""The loop of a MuJoCo task: its stages, that it ends once the posterior has settled, and what the page says.

Training and inference are commands with tests of their own; here they leave what they would leave. The machine is the
one that is served, in this process.
"""

import contextlib
import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco")
pytest.importorskip("brax")

from envs_mujoco_cart import MODEL, PREPARATION, TASK
from robots.machines import a_policy

import jaxlfi
from jaxlfi.cli import loops
from jaxlfi.cli.r2s2r import main as any_loop
from jaxlfi.design import played
from jaxlfi.distributions.space import Space
from jaxlfi.envs.mujoco import excitation, logs, r2s2r, r2s2r_beside, r2s2r_machine, r2s2r_page
from jaxlfi.envs.mujoco.served import Machine
from jaxlfi.robots.clock import Simulated
from tests import browser

CONTROLS = np.column_stack([0.05 * np.arange(21), np.linspace(-7.0, 5.0, 21)])
"""What a design plays: beyond the cart's limits of -4 to 6 at first."""
PICTURE = Image.new("RGB", (1500, 400))
DESIGN = "[design]\nduration = 1.0\ninterval = 0.05\n"


class Run:
    """A posterior of a mass, as narrow as 0.02 kg either way."""

    space = Space(("body/cart/mass",), (False,))

    def __init__(self, mass):
        self.mass = mass

    def final_support(self):
        return jaxlfi.Support([1.0], [3.0])

    def draws(self):
        return np.linspace(self.mass - 0.02, self.mass + 0.02, 101)[:, None]


@pytest.fixture
def task(tmp_path, monkeypatch):
    """The file of a task, what was run, and the masses that are believed in one iteration after another."""
    (tmp_path / "cart.xml").write_text(MODEL)
    (tmp_path / "task.toml").write_text(TASK)
    ran, masses = [], [2.0, 2.3, 2.301, 2.4]

    def command(kind):
        def run(words):
            ran.append([kind, *words])
            out = Path(words[words.index("--out") + 1] if "--out" in words else words[1])
            out.mkdir(parents=True, exist_ok=True)
            (out / "config.json").write_text("{}")
            if kind == "train":
                (out / "domain/seed_000").mkdir(parents=True, exist_ok=True)
                a_policy(PREPARATION, [[-1.5]]).save(out / "domain/seed_000/policy.npz")
                (out / "table.csv").write_text("domain,seed,return,place off\ndomain,0,-0.75,0.1\n")
            if kind == "fit":
                point = {"names": ["body/cart/mass"], "theta": [2.25], "interval": [[2.125, 2.375]]}
                (out / "fit.json").write_text(json.dumps({"points": [point, {**point, "theta": [9.0]}]}))
            if kind == "design":
                played.write(out / "experiment_1", ["time [s]", "push"], CONTROLS)
            (out / "report.html").write_bytes(b"")
            for name in ("curves.png", "pairs.png", "design.png"):
                PICTURE.save(out / name)
            if kind == "infer":
                (out / "figures").mkdir(exist_ok=True)
                PICTURE.save(out / "figures/curves.png")  # of errors, and not shown
            return 0

        return run

    @contextlib.contextmanager
    def machine(arguments, config, seed, scattered=False, first=0):
        made, episodes = Machine.of(config, seed=seed, scattered=scattered), itertools.count(first)

        def driver():
            clock = Simulated()
            one = made.driver(clock, next(episodes))
            one.simulated_clock = clock
            return one

        ran.append(["machine", seed, scattered, first])
        yield driver

    def load(folder):
        return Run(masses[int(folder.parent.name.rpartition("_")[2]) - 1])

    monkeypatch.setattr(r2s2r.train, "main", command("train"))
    monkeypatch.setattr(r2s2r.command_line, "main", command("infer"))
    monkeypatch.setattr(r2s2r.command_line, "parse", lambda words: None)
    monkeypatch.setattr(r2s2r.train.main, "parser", r2s2r.train.parser, raising=False)
    monkeypatch.setattr(r2s2r_beside.mujoco_command, "main", command("fit"))
    monkeypatch.setattr(loops.design, "main", command("design"))
    monkeypatch.setattr(r2s2r_machine, "connected", machine)
    monkeypatch.setattr("jaxlfi.runs.load.load", load)
    monkeypatch.setattr(r2s2r_page, "load", load)
    return tmp_path / "task.toml", ran


def test_the_loop_ends_once_the_posterior_has_stopped_moving(task, tmp_path, capsys):
    config, ran = task
    out = tmp_path / "loop"
    words = [f"mujoco,config={config}", "--out", str(out), "--episodes", "2", "--seed", "3", "--infer", "--rounds 2"]
    words += ["--beside", "uniform", "point"]
    assert r2s2r.main(words) == 0
    kinds = [one[0] for one in ran]
    # Its machine is excited; the second iteration moves by far, the third by a twentieth of a half-width.
    stages = ["machine", *["infer", "train", "machine"] * 2, "infer", "train"]
    assert kinds == [*stages, "train", "fit", "train", *["machine"] * 5]
    infers = [one for one in ran if one[0] == "infer"]
    logs_of = lambda one: [Path(path).name for path in one[2].partition("log=")[2].split(";")]
    assert [logs_of(one) for one in infers] == [["excitation.csv", *["rollout.csv"] * i] for i in range(3)]
    assert all("--rounds" in one and one[one.index("--first-seed") + 1] == "3" for one in infers)
    trained = [one[one.index("--domain") + 1] for one in ran if one[0] == "train"]
    assert trained == [*(str(out / f"iteration_{i}/posterior") for i in (1, 2, 3)), "uniform", "point:2.25"]
    fitted = next(one for one in ran if one[0] == "fit")
    assert fitted[2] == infers[-1][2]  # given the same recordings
    assert [one[2] for one in ran if one[0] == "machine"] == [False] * 3 + [True] * 5  # [initial] has a number
    assert "the posterior has moved by 17 half-widths" in capsys.readouterr().out
    page = (out / "page.html").read_text()
    for part in ("body/cart/mass", "<td>2.3</td>", "<td>2.5</td>", "uniform box", "iteration 3", "excitation.json"):
        assert part in page
    pictures = re.findall(r'src="([^"]*)"', page)
    iterations = [f"iteration_{i}/policy/curves.png" for i in (1, 2, 3)]
    assert pictures == [*iterations, "uniform/policy/curves.png", "point/policy/curves.png"]
    found = json.loads((out / "results.json").read_text())
    assert [one["policy"] for one in found["policies"]] == [*(f"iteration {i}" for i in (1, 2, 3)), "uniform", "point"]
    assert all(one["trained"] == -0.75 and one["episodes"] == 2 and not one["stopped"] for one in found["policies"])
    assert len({one["return"]["mean"] for one in found["policies"]}) == 1  # one policy on the same starts
    assert found["believed"][-1] == {
        "policy": "point",
        "parameter": "body/cart/mass",
        "median": "2.25",
        "90 % interval": "2.125 to 2.375",
        "last support": "",
        "truth": 2.5,
    }
    assert found["believed"][-2]["last support"] == "1 to 3" and "point of least squares (jaxlfi mujoco fit)" in page
    ran.clear()
    (out / "page.html").unlink()
    (out / "iteration_2/rollout.json").unlink()
    assert r2s2r.main(words) == 0  # all else is there
    assert [one[0] for one in ran] == ["machine"] and (out / "page.html").exists()


@pytest.mark.skipif(browser.CHROMIUM is None, reason=browser.MISSING)
def test_a_browser_finds_nothing_wrong_with_the_page(task, tmp_path):
    config, _ = task
    words = [f"mujoco,config={config}", "--out", str(tmp_path / "loop"), "--episodes", "1", "--iterations", "2"]
    assert r2s2r.main([*words, "--beside", "uniform", "point"]) == 0
    assert browser.faults([tmp_path / "loop/page.html"]) == []


def test_the_next_recording_can_be_of_the_experiment_that_tells_most(task, tmp_path, capsys):
    config, ran = task
    config.write_text(TASK + DESIGN)
    out = tmp_path / "loop"
    words = [f"mujoco,config={config}", "--out", str(out), "--episodes", "1", "--seed", "3", "--iterations", "2"]
    words += ["--beside", "--explore", "design", "--design", "--rated 16"]
    assert r2s2r.main(words) == 0
    kinds = [one[0] for one in ran]
    assert kinds[:8] == ["machine", "infer", "train", "design", "machine", "infer", "train", "machine"]
    folder = out / "iteration_1"
    designed = loops.design.parser().parse_args(next(one[1:] for one in ran if one[0] == "design"))
    assert (designed.run, designed.out, designed.rated, designed.seed) == (
        folder / "posterior",
        folder / "design",
        16,
        3,
    )
    assert ran[4] == ["machine", 4, False, 0]  # it begins where recordings begin
    assert "push is cut off at the limits of policies, [-4.0, 6.0]: by up to 3" in capsys.readouterr().out
    log = logs.read(folder / "rollout.csv")
    np.testing.assert_allclose(log.samples("push")[1], np.clip(CONTROLS[:, 1], -4.0, 6.0), atol=1e-9)
    np.testing.assert_allclose(np.diff(log.samples("push")[0]), 0.05, atol=1e-9)
    assert np.ptp(log.samples("place")[1]) > 0.05 and "iteration_1/rollout.json" in (out / "page.html").read_text()
    assert json.loads((folder / "rollout.json").read_text())["mode"] == "design"
    ran.clear()
    (folder / "rollout.json").unlink()  # as a kill leaves it
    assert r2s2r.main(words) == 0 and [one[0] for one in ran] == ["machine"]
    (folder / "design/design.png").unlink()
    (folder / "rollout.json").unlink()
    ran.clear()
    assert r2s2r.main(words) == 0 and [one[0] for one in ran] == ["design", "machine"]
    np.testing.assert_array_equal(logs.read(folder / "rollout.csv").samples("push")[1], log.samples("push")[1])


def test_controls_of_other_actuators_are_refused(task, tmp_path):
    config, _ = task
    played.write(tmp_path / "other", ["time [s]", "pull"], CONTROLS)
    played.write(tmp_path / "both", ["time [s]", "push", "pull"], CONTROLS[:, [0, 1, 1]])
    for name, expected in (("other", "expected controls of push, got none of push"), ("both", "got pull")):
        with r2s2r_machine.connected(None, config, 0) as driver, pytest.raises(ValueError, match=expected):
            excitation.play(driver(), config, tmp_path / "a.csv", tmp_path / f"{name}.csv")
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("", "explore: design: expected a table [design] in "),
        (DESIGN + "[design.initial]\n'rail/qpos' = [-1.0, 1.0]\n", "explore: design: expected controls only in the"),
    ],
)
def test_a_task_of_which_a_loop_can_choose_nothing_is_refused(table, expected, task, tmp_path, capsys):
    config, ran = task
    config.write_text(TASK + table)
    assert r2s2r.main([f"mujoco,config={config}", "--explore", "design", "--out", str(tmp_path / "loop")]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1 and not ran and not (tmp_path / "loop").exists()


def test_what_was_achieved_is_the_return_of_the_training(task, tmp_path):
    """Compared with the reward's own formula, for an episode on the machine."""
    config, _ = task
    with r2s2r_machine.connected(None, config, 0) as driver:
        policy = a_policy(PREPARATION, [[-1.5]]).save(tmp_path / "policy.npz")
        r2s2r_machine.controlled(driver(), policy, config, tmp_path / "a.csv")
    log = logs.read(tmp_path / "a.csv")
    assert set(log.signals) == {"push", "place", "joint/rail/qvel"}
    place, push = log.samples("place")[1], log.samples("push")[1]
    rewards = -0.1 * (2.0 * (place[1:] - 0.25) ** 2 + 0.5 * ((push - 1.0) / 5.0) ** 2)
    found = excitation.achieved(config, tmp_path / "a.csv")
    assert found["return"] == pytest.approx(rewards.sum(), rel=1e-6) and found["controls"] == 10
    assert found["place off"] == pytest.approx(abs(place[-1] - 0.25), rel=1e-6)


def test_an_interval_without_a_measurement_is_rewarded_by_the_one_before(task, tmp_path):
    """So that an episode of lost measurements does not come off better than one of all."""
    config, _ = task
    with r2s2r_machine.connected(None, config, 0) as driver:
        policy = a_policy(PREPARATION, [[-1.5]]).save(tmp_path / "policy.npz")
        one = driver()
        plain, count = one.observe, itertools.count()
        one.observe = lambda: None if next(count) in (4, 5, 10) else plain()
        r2s2r_machine.controlled(one, policy, config, tmp_path / "a.csv")
    seen = logs.read(tmp_path / "a.csv").samples("place")
    assert len(seen[0]) == 8
    ends = 0.1 * np.arange(1, 11)
    place = seen[1][np.searchsorted(seen[0], ends + 0.05) - 1]
    assert place[3] == place[4] == place[2] and place[9] == place[8]
    push = np.load(tmp_path / "a.loop.npz")["targets"][:, 0]
    rewards = -0.1 * (2.0 * (place - 0.25) ** 2 + 0.5 * ((push - 1.0) / 5.0) ** 2)
    assert excitation.achieved(config, tmp_path / "a.csv")["return"] == pytest.approx(rewards.sum(), rel=1e-6)


def test_episodes_that_were_stopped_before_their_time_are_counted_and_not_averaged(tmp_path):
    """Where rewards are costs, a robot that stops at once would seem to be the best."""
    (tmp_path / "table.csv").write_text(
        "policy,episode,return,controls,ended,stopped,place off\n"
        "point,0,-3.0,10,,,0.5\n"
        "point,1,-0.1,1,,place was measured at 9,9.0\n"
        "point,2,-5.0,8,fallen,,0.7\n"
        "uniform,0,-1.0,10,,,0.1\n"
    )
    found = r2s2r_page.achieved(tmp_path / "table.csv", "point")
    assert (found["episodes"], found["stopped"], found["ended"]) == (3, 1, {"fallen": 1})
    assert found["return"] == {"mean": -4.0, "error": 1.0}
    assert found["place off"]["mean"] == pytest.approx(0.6) and "episode" not in found
    assert r2s2r_page.achieved(tmp_path / "table.csv", "uniform")["return"] == {"mean": -1.0, "error": None}


def test_inferred_delays_are_beside_recorded_ages_and_what_was_trained_with(tmp_path):
    for name, age in (("excitation", 0.001), ("iteration_1/rollout", 0.012), ("iteration_2/rollout", None)):
        path = tmp_path / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        timing = {"missed": 0, "age": age}
        path.write_text(json.dumps({"timing": timing, "stopped": "", "controls": 9}))
    rows = [
        {"parameter": "sensor/place/delay", "median": "0.045", "90 % interval": "0.043 to 0.047"},
        {"parameter": "body/cart/mass", "median": "2", "90 % interval": "1 to 3"},
    ]
    trained = a_policy(dataclasses.replace(PREPARATION, observation_delay=(0.0, 0.02)), [[-1.5]])
    on = {"sensor/place/delay": {"low": 0.042, "high": 0.048, "unit": "s"}}
    trained = dataclasses.replace(trained, schema={**trained.schema, "trained_on": on})
    found = r2s2r_page.delays(tmp_path, rows, trained)
    assert found == {
        "inferred": {
            "sensor/place/delay": {"median": "0.045", "90 % interval": "0.043 to 0.047", "trained": [0.042, 0.048]}
        },
        "ages": {"excitation.json": 0.001, "iteration_1/rollout.json": 0.012},
        "observation_delay": [0.0, 0.02],
        "action_delay": [0.0, 0.0],
    }
    _, table = r2s2r_page._delays(found)
    for cell in ("sensor/place/delay", "0.045 (0.043 to 0.047)", "42 to 48 ms", "1 to 12 ms", "0 to 20 ms"):
        assert f"<td>{cell}</td>" in table
    assert [row["age of measurements"] for row in r2s2r_page.recorded(tmp_path)] == ["1 ms", "12 ms", ""]
    plain = r2s2r_page.delays(tmp_path, rows[1:], a_policy(PREPARATION, [[-1.5]]))
    assert r2s2r_page._delays({**plain, "ages": {"excitation.json": 0.0}}) == ()


def test_a_machine_is_excited_within_the_limits_of_its_policies(task, tmp_path):
    config, _ = task
    with r2s2r_machine.connected(None, config, 0) as driver:
        excitation.record(driver(), config, tmp_path / "a.csv", 3.0, seed=1)
    log = logs.read(tmp_path / "a.csv")
    assert set(log.signals) == {"push", "place"} and log.units == {"time": "s", "place": "m"}
    times, push = log.samples("push")
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    assert push[0] == 1.0 and -3.0 <= push.min() < 0.5 and 1.5 < push.max() <= 5.0
    place = log.samples("place")[1]
    assert place[0] == -0.5 and np.ptp(place) > 0.05
    bounds = np.array([[-4.0, 0.0], [6.0, 1.0]])
    other = excitation.sines(np.random.default_rng(2), bounds, 0.02, 500, 1.0)
    assert (other >= [-3.0, 0.1]).all() and (other <= [5.0, 0.9]).all()
    power = np.abs(np.fft.rfft(other[:, 0] - other[:, 0].mean())) ** 2
    frequencies = np.fft.rfftfreq(500, 0.02)
    assert power[(frequencies > 0.8) & (frequencies < 3.0)].sum() > 0.9 * power.sum()


def test_how_far_a_posterior_has_moved():
    assert loops.moved(Run(2.0), Run(2.045)) == pytest.approx(0.045 / (0.9 * 0.02), rel=1e-3)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["mujoco"], "task: expected mujoco,config=FILE, got 'mujoco'"),
        (["mujoco,config=none.toml"], "none.toml: expected a TOML file"),
        (["TASK", "--iterations", "0"], "iterations, episodes: expected at least 1, got 0 and 8"),
        (["TASK", "--settled", "-1"], "settled: expected a number above 0, got -1"),
        (["TASK", "--heuristic", "egde"], "heuristic: expected "),
        (["TASK", "--total-steps", "0"], "total_steps: expected "),
        (["TASK", "--beside", "point", "point"], "beside: expected each once, got point point"),
        (["TASK", "--confirm"], "remote, token, confirm: expected with --address only, got a simulated machine"),
        (["TASK", "--address", "10.0.0.7:5005"], "expected this host, such as 127.0.0.1, got '10.0.0.7'"),
        (["TASK", "--address", "10.0.0.7:5005", "--remote"], "token: expected the one that the robot at 10.0.0.7"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(words, expected, task, tmp_path, capsys):
    config, ran = task
    words = [f"mujoco,config={config}" if word == "TASK" else word for word in words]
    assert r2s2r.main([*words, "--out", str(tmp_path / "loop")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxlfi r2s2r: error: ") and expected in error and error.count("\n") == 1
    assert not (tmp_path / "loop").exists() and not ran


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('[initial]\n"rail/qpos" = -0.5\n', ""), True),
        (('"rail/qpos" = -0.5', 'from = "log"'), True),
        (('"rail/qpos" = -0.5', 'from = "model"'), False),
        (("", ""), False),
        (('[initial]\n"rail/qpos" = -0.5\n', 'measured = ["joint/rail/qvel"]\n'), False),
        (('[initial]\n"rail/qpos" = -0.5\n', '[parameters."initial/rail/qpos"]\nsupport = [-1.0, 1.0]\n'), False),
    ],
)
def test_policies_are_recorded_from_anywhere_if_recordings_say_where_they_began(change, says, task, tmp_path):
    config, _ = task
    text = TASK.replace(*change)
    config.write_text(
        text if "measured" not in text else 'measured = ["joint/rail/qvel"]\n' + TASK.replace(change[0], "")
    )
    assert excitation.says_its_start(config) is says


def test_a_machine_that_moves_can_wait_for_an_operator(monkeypatch):
    """The operator is prompted before each recording; without a terminal, nothing moves."""
    words = ["mujoco", "--out", "runs/loop", "--address", "127.0.0.1:5005", "--confirm"]
    arguments, prompts = r2s2r.parser().parse_args(words), []
    monkeypatch.setattr("builtins.input", lambda text: prompts.append(text) or "")
    for scattered in (False, True):
        with r2s2r_machine.connected(arguments, Path("task.toml"), 0, scattered) as driver:
            assert driver()._address == "127.0.0.1:5005"
    assert [text.partition(",")[0] for text in prompts] == [
        "bring the machine to where recordings begin",
        "bring the machine to where policies' episodes begin",
    ]

    def ended(text):
        raise EOFError

    monkeypatch.setattr("builtins.input", ended)
    with r2s2r_machine.connected(arguments, Path("task.toml"), 0) as driver:
        with pytest.raises(ValueError, match="confirm: expected Enter on a terminal before each recording"):
            driver()


def test_the_folder_of_another_loop_is_refused(task, tmp_path, capsys):
    config, _ = task
    words = [f"mujoco,config={config}", "--out", str(tmp_path / "loop"), "--episodes", "1", "--iterations", "1"]
    assert r2s2r.main(words) == 0
    assert r2s2r.main([*words, "--seed", "4"]) == 2
    assert "out: expected a new folder, or one of the same command" in capsys.readouterr().err
    assert json.loads((tmp_path / "loop/config.json").read_text())["asked"]["seed"] == "0"


def test_the_first_word_says_whose_loop_it_is(monkeypatch, capsys):
    from jaxlfi.cli import r2s2r as dispatch

    calls = {}
    monkeypatch.setattr(
        dispatch.LOOPS.__class__, "find", lambda family, name: lambda words: calls.update({name: words}) or 0
    )
    for words, name, rest in (
        (["mujoco,config=a.toml", "--out", "b"], "mujoco", ["mujoco,config=a.toml", "--out", "b"]),
        (["--object", "dlo-0"], "whip", ["--object", "dlo-0"]),
        (["whip", "--object", "dlo-0"], "whip", ["--object", "dlo-0"]),
        (["mujoco", "--help"], "mujoco", ["--help"]),
    ):
        calls.clear()
        assert any_loop(words) == 0 and calls == {name: rest}
    monkeypatch.undo()
    assert any_loop(["no_such_loop,config=a"]) == 2
    assert re.search(r"loop: expected one of .* or module:command, got 'no_such_loop'", capsys.readouterr().err)
