"""The command line: what it runs, what it refuses, and how it tells."""

import csv
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import jaxlfi
from jaxlfi import figures, flags, registry
from jaxlfi.bayessim import memory
from jaxlfi.bayessim.presets import HYPERPARAMETERS, METHODS, PRESETS
from jaxlfi.bayessim.settings import Settings
from jaxlfi.cli import choices, summaries
from jaxlfi.cli import parser as cli
from jaxlfi.envs.gaussian_linear import MIXING, NOISE
from jaxlfi.fields import declared
from jaxlfi.heuristics import Edge, Mode
from jaxlfi.heuristics.hyperparameters import all_declared
from jaxlfi.io import files as atomic
from jaxlfi.io import formats
from jaxlfi.io.host_devices import FLAG, processors
from jaxlfi.registry import ESTIMATORS, HEURISTICS, TASKS
from jaxlfi.runs import execute as executing
from jaxlfi.runs import folder as run_store
from jaxlfi.tasks import observation
from jaxlfi.tasks.trials import repeated
from tests.small import FLAGS, TASK, command, gaussian, whole_runs  # noqa: F401 - a fixture


def error_line(capsys, *arguments) -> str:
    """The one line that a refused command leaves on stderr."""
    capsys.readouterr()
    assert command(*arguments) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and message.endswith("\n") and "error: " in message
    return message


@pytest.mark.parametrize(
    ("name", "wanted"), [("infer", "delta"), ("compare", "SUPPORT[+HEURISTIC]"), ("grid", "NAME=V,V,...")]
)
def test_help_teaches(name, wanted, capsys):
    """`test_hostile_input.py` tests that it does not import jax."""
    assert command(name, "--help") == 0
    shown = capsys.readouterr().out
    assert "examples:" in shown and wanted in shown


def test_a_shell_is_told_what_words_can_be_completed_to(tmp_path):
    pytest.importorskip("argcomplete")
    words, answer = "jaxlfi infer lynx_hare --keep-n", tmp_path / "answer"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": words, "COMP_POINT": str(len(words)), "_ARGCOMPLETE_IFS": " "}
    script = "import sys; sys.argv[0] = 'jaxlfi'; from jaxlfi.cli.start import main; main()"
    shell = ["sh", "-c", 'exec "$@" 8>"$0" 9>/dev/null', answer, sys.executable, "-c", script]
    subprocess.run(shell, env=os.environ | asked, check=True)
    assert answer.read_text().split() == ["--keep-network"]


def test_every_setting_and_hyperparameter_has_a_documented_flag():
    choices = cli.parser()._subparsers._group_actions[0].choices
    for name in ("infer", "compare", "grid"):
        documented = {action.dest for action in choices[name]._actions if action.help}
        kinds = [
            Settings,
            *(ESTIMATORS.load(name) for name in ESTIMATORS.names()),
            *(HEURISTICS.load(rule) for rule in HEURISTICS.names()),
        ]
        fields = {field for kind in kinds for field in declared(kind)}
        assert len(kinds) >= 9 and {"rounds", "hidden", "bins", "expansion"} <= fields <= documented


def test_names_known_without_jax_are_the_real_ones():
    assert set(cli.PRESETS) == set(PRESETS) and set(cli.METHODS) == set(METHODS)


def test_version(capsys):
    assert command("--version") == 0
    assert capsys.readouterr().out == f"jaxlfi {jaxlfi.__version__}\n"


BAD = {
    "unknown task": (["infer", "nothing"], "task: expected one of"),
    "no such module": (["infer", "no.such:task"], "cannot load 'no.such:task'"),
    "no task": (["infer", "os:getcwd"], "expected 'os:getcwd' to give a jaxlfi.Task, got str"),
    "unknown support": (["infer", TASK, "--support", "x"], "support: expected one of ['broad', 'misspecified', 'ok']"),
    "unknown heuristic": (["infer", TASK, "--heuristic", "x"], "heuristic: expected one of"),
    "unknown preset": (["infer", TASK, "--preset", "x"], "invalid choice: 'x'"),
    "unknown flag": (["infer", TASK, "--nonsense"], "unrecognized arguments"),
    "abbreviated flag": (["infer", TASK, "--seed", "3"], "unrecognized arguments: --seed"),
    "no end of networks": (["infer", TASK, "--ensemble-size", 2**63 - 1], "ensemble_size: expected a whole number in"),
    "not a number": (["infer", TASK, "--rounds", "x"], "invalid int value: 'x'"),
    "reversed": (["infer", TASK, "--support-low", "1", "1", "--support-high", "0", "2"], "low < high"),
    "not finite": (["infer", TASK, "--support-low", "nan", "0", "--support-high", "1", "2"], "finite bounds"),
    "outside Phi": (["infer", TASK, "--support-low", "-99", "0", "--support-high", "1", "2"], "feasible domain Phi"),
    "dimensions": (["infer", TASK, "--support-low", "0", "--support-high", "1"], "bounds for 2 parameters, got 1"),
    "half a box": (["infer", TASK, "--support-low", "0", "0"], "--support-low and --support-high together"),
    "two supports": (
        ["infer", TASK, "--support", "ok", "--support-low", "0", "0", "--support-high", "1", "1"],
        "expected --support NAME, or",
    ),
    "no rounds": (["infer", TASK, "--rounds", "0"], "rounds: expected a whole number in [1, 100000], got 0"),
    "small budget": (
        ["infer", TASK, "--simulation-budget", "5", "--simulations-per-round", "9"],
        "simulation_budget: expected at least the 9",
    ),
    "correction": (["infer", TASK, "--correction", "x"], "correction: expected one of"),
    "activation": (["infer", TASK, "--activation", "x"], "activation: expected one of"),
    "learning rate": (["infer", TASK, "--learning-rate", "nan"], "learning_rate: expected a number in (0, inf)"),
    "epochs and steps": (["infer", TASK, "--epochs", "5", "--steps", "5"], "epochs, steps: expected one"),
    "seeds": (["infer", TASK, "--seeds", "0"], "seeds: expected at least 1"),
    "hyperparameter length": (["infer", TASK, "--expansion", "1", "2", "3"], "expansion: expected one finite number or 2"),  # noqa: E501
    "foreign hyperparameter": (["infer", TASK, "--proximity", "0.3"], "proximity: expected a hyperparameter of edge"),
    "no file": (["infer", TASK, "--observation", "nothing.csv"], "expected a readable file, got 'nothing.csv'"),
    "no format": (["infer", TASK, "--observation", "x.txt"], "expected a .csv or .npz"),
    "configuration": (["compare", TASK, "--configurations", "ok+x"], "expected support+heuristic"),
    "configurations": (["compare", TASK, "--configurations", "ok", "ok"], "expected distinct ones"),
    "configured support": (["compare", TASK, "--configurations", "x+edge"], "support: expected one of"),
    "nothing to vary": (["grid", TASK], "arguments are required: --vary"),
    "no axis": (["grid", TASK, "--vary"], "expected at least one argument"),
    "no values": (["grid", TASK, "--vary", "tail="], "vary: expected NAME=V,V,... with numbers, got 'tail='"),
    "no numbers": (["grid", TASK, "--vary", "tail=a,b"], "vary: expected NAME=V,V,... with numbers, got 'tail=a,b'"),
    "joined axes": (["grid", TASK, "--vary", "tail=0,1,expansion=2"], "vary: expected NAME=V,V,..."),
    "unknown axis": (["grid", TASK, "--vary", "x=1"], "(zone_fraction, mass_threshold, expansion, zone_width, tail, uninformed_factor), got 'x'"),  # noqa: E501
    "another's axis": (["grid", TASK, "--heuristic", "mode", "--vary", "tail=1"], "vary: expected a hyperparameter"),
    "no hyperparameters": (["grid", TASK, "--heuristic", "centre", "--vary", "tail=1"], "it has none"),
    "axis twice": (["grid", TASK, "--vary", "tail=0,1", "--vary", "tail=0.5"], "each once, got tail, tail"),
    "value twice": (["grid", TASK, "--vary", "tail=0.5,0.50"], "tail: expected at least one value, each once"),
    "out of range": (["grid", TASK, "--vary", "tail=0.5,1.5"], "tail: expected finite numbers in [0, 1], got 0.5,1.5"),
    "axis and flag": (["grid", TASK, "--vary", "tail=0,1", "--tail", "1"], "on an axis or as a flag of its own"),
    "grid's support": (["grid", TASK, "--vary", "tail=0,1", "--support", "x"], "support: expected one of"),
    "grid's seeds": (["grid", TASK, "--vary", "tail=0,1", "--seeds", "0"], "seeds: expected at least 1"),
    "no runs": (["grid", TASK, "--vary", "tail=0,1", "--runs-per-chunk", "0"], "runs_per_chunk: expected at least 1"),
    "unknown estimator": (["infer", TASK, "--estimator", "x"], "estimator: expected one of"),
    "another family's setting": (["infer", TASK, "--bins", "4"], "bins: expected a setting of MixtureNetwork"),
    "no parameters of a flow": (["infer", TASK, "--estimator", "nsf", "--transforms", "0"], "transforms: expected a whole number in [1, inf), got 0"),  # noqa: E501
}  # fmt: skip


def host_simulate(rng, theta):
    """The Gaussian task in NumPy."""
    return theta @ MIXING.T + NOISE * rng.normal(size=theta.shape)


class Alike:
    """A host simulator's function, equal to any other: what is compiled around one serves them all."""

    def __init__(self, simulate):
        self.simulate = simulate

    def __call__(self, rng, theta):
        return self.simulate(rng, theta)

    def __eq__(self, other):
        return isinstance(other, Alike)

    def __hash__(self):
        return 0


def on_host(simulate):
    """The Gaussian task with a host simulator and an observation of its own."""
    simulator = jaxlfi.HostSimulator(Alike(simulate))
    return dataclasses.replace(gaussian(), simulate=simulator, truth=None, observation=[0.8, -0.6])


def wrong_shape():
    """Gives one trajectory too few."""
    return on_host(lambda rng, theta: host_simulate(rng, theta)[1:])


def failing():
    """Never succeeds."""
    return on_host(lambda rng, theta: (host_simulate(rng, theta), np.zeros(len(theta), bool)))


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_writes_nothing(case, tmp_path, capsys):
    arguments, expected = BAD[case]
    assert expected in error_line(capsys, *arguments, "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_more_runs_than_memory_are_refused_before_anything_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda devices: 2e4)
    arguments = ("grid", TASK, *FLAGS, "--vary", "tail=0,0.5,1", "--runs-per-chunk", "9", "--out", tmp_path / "out")
    assert "runs_per_chunk: expected fewer runs than fill the memory: 9 need" in error_line(capsys, *arguments)
    assert not list(tmp_path.iterdir())


def test_a_grid_has_as_many_devices_as_it_was_begun_with(tmp_path, monkeypatch):
    vary = ["--vary", "tail=0,1", "expansion=1,2,3"]
    begun = cli.parser().parse_args(["grid", TASK, *vary, "--vary", "zone_width=0", "--seeds", "4", "--out", "x"])
    assert cli._runs(begun) == 24
    atomic.write_json(tmp_path / "config.json", {"format": formats.GRID, "axes": [{}], "devices": 7})
    monkeypatch.setenv("XLA_FLAGS", "")
    cli.prepare_jax(cli.parser().parse_args(["resume", str(tmp_path), "--no-cache"]))
    assert os.environ["XLA_FLAGS"] == "--xla_force_host_platform_device_count=7"


@pytest.mark.parametrize("damaged", ["7", {}, -7, 0, None, 10**9, 1.5])
def test_a_damaged_number_of_devices_is_not_asked_for(damaged, tmp_path, monkeypatch):
    atomic.write_json(tmp_path / "config.json", {"format": formats.GRID, "axes": [{}], "devices": damaged})
    monkeypatch.setenv("XLA_FLAGS", "")
    cli.prepare_jax(cli.parser().parse_args(["resume", str(tmp_path), "--no-cache"]))
    assert os.environ["XLA_FLAGS"] in ("", *(f"--{FLAG}={n}" for n in (1, processors())))  # of one run, or more


def test_report_refuses_a_grid_that_is_not_finished(tmp_path, capsys):
    atomic.write_json(tmp_path / "config.json", {"format": formats.GRID, "version": formats.VERSION})
    assert "expected a finished grid, found no grid.npz" in error_line(capsys, "report", tmp_path)


@pytest.mark.parametrize("name", ["file", "folder"])
def test_nothing_is_overwritten(name, tmp_path, capsys):
    out = tmp_path / "out"
    if name == "file":
        out.write_text("mine")
    else:
        out.mkdir()
        (out / "mine.txt").write_text("mine")
    message = error_line(capsys, "infer", TASK, "--out", out)
    assert "jaxlfi resume" in message and "another name" in message
    assert (out if name == "file" else out / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("verb", ["resume", "report"])
def test_foreign_folders_are_refused(verb, tmp_path, capsys):
    (tmp_path / "file.txt").write_text("mine")
    assert "expected a run folder" in error_line(capsys, verb, tmp_path)
    assert "not a folder" in error_line(capsys, verb, tmp_path / "nowhere")
    (tmp_path / "config.json").write_text('{"format": "jaxlfi-run", "version": 2, "runs": [{}]}')
    if verb == "resume":
        assert "complete description" in error_line(capsys, verb, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "file.txt"]


@pytest.fixture(scope="module")
def comparison(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A small comparison."""
    out = tmp_path_factory.mktemp("compare") / "out"
    configurations = ("ok", "misspecified", "misspecified+edge")
    assert command("compare", TASK, "--configurations", *configurations, *FLAGS, "--seeds", "2", "--out", out) == 0
    return out


def test_compare_writes_its_table(comparison):
    with (comparison / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert tuple(lines[0]) == run_store.TABLE_COLUMNS
    assert [(line["configuration"], line["seed"]) for line in lines] == [
        (configuration, str(seed)) for configuration in ("ok", "misspecified", "misspecified+edge") for seed in (0, 1)
    ]
    for line in lines:
        folder = comparison / line["configuration"] / f"seed_{int(line['seed']):03d}"
        error = atomic.read_arrays(folder / "history.npz")["sample_theta_error"][-1]
        assert float(line["theta_error"]) == pytest.approx(error.sum(-1).mean(), rel=1e-5)
        assert float(line["success_rate"]) == 1.0 and float(line["seconds"]) > 0
    assert figures.read_table(comparison / "table.csv")[0].configuration == "ok"


def test_a_seed_has_one_observation_in_all_configurations(comparison):
    seen = [
        atomic.read_arrays(comparison / name / seed / "observation.npz")["trajectory"]
        for seed in ("seed_000", "seed_001")
        for name in ("ok", "misspecified+edge")
    ]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])


@pytest.mark.slow  # bayessim/test_batch.py compares batches with loops
def test_a_run_of_a_comparison_is_the_one_by_itself(comparison):
    """In one program with runs by another rule, whose evidence is not its own; to what training makes of rounding."""
    ok, edge = (comparison / name / "seed_001" for name in ("ok", "misspecified+edge"))
    observed = atomic.read_arrays(edge / "observation.npz")["trajectory"]
    own = {"support": "misspecified", "heuristic": Edge(), "settings": jaxlfi.load(edge).settings}
    alone = jaxlfi.infer(1, gaussian(), observed, **own).history
    found, other = (atomic.read_arrays(folder / "history.npz") for folder in (edge, ok))
    for name in ("theta", "means", "support_low", "support_high", "evidence/mass_right"):
        np.testing.assert_allclose(found[name], alone[name], rtol=1e-2, atol=1e-2, err_msg=name)
    evidence = lambda history: {name for name in history if name.startswith("evidence/")}
    assert evidence(found) == {"evidence/mass_left", "evidence/mass_right"} and evidence(other) == set()


def test_compare_warns_of_posteriors_beyond_the_bounds_of_fixed_supports(comparison):
    names = [run["folder"] for run in run_store.read_config(comparison)["runs"]]
    runs = [jaxlfi.load(comparison / name) for name in names]
    specs = tuple(run.spec for run in runs)
    plan = executing.BatchPlan(formats.COMPARE, TASK, runs[0].task, None, runs[0].settings, specs)
    warnings = summaries.support_warnings(plan, runs)
    assert any(text.startswith("misspecified: first reaches its upper bound 0 (in 2 of 2 runs") for text in warnings)
    assert not any(text.startswith("misspecified+edge") for text in warnings)


def test_compare_warns_in_one_line_of_observations_unlike_all_simulations(comparison):
    names = [run["folder"] for run in run_store.read_config(comparison)["runs"]]
    runs = [jaxlfi.load(comparison / name) for name in names]
    plan = executing.BatchPlan(
        formats.COMPARE, TASK, runs[0].task, None, runs[0].settings, tuple(run.spec for run in runs)
    )
    assert summaries.observation_warnings(plan, runs) == []
    foreign = [run.replace(x=run.x + 1e6) if run.origin.configuration == "ok" else run for run in runs]
    (text,) = summaries.observation_warnings(plan, foreign)
    assert re.match(r"ok: observation: x_[12] is 1e\+06", text) and text.endswith("(in 2 of 2 runs, this is the first)")
    assert text in summaries.warnings(plan, foreign)


def test_resuming_what_is_complete_says_so(comparison, capsys):
    for folder in (comparison, comparison / "ok" / "seed_000"):
        assert command("resume", folder) == 0
        assert "is complete" in capsys.readouterr().out


def test_results_alone_for_programs_and_for_the_quiet(tmp_path, capsys):
    out, flags = tmp_path / "run", (*FLAGS, "--no-figures")
    assert command("infer", TASK, *flags, "--json", "--out", out) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "summary.json").read_text())
    assert "compiled in" in printed.err and f"results: {out}" in printed.err
    assert command("resume", out, "--json", "--quiet") == 0
    again = capsys.readouterr()
    assert again.out == printed.out and again.err == ""
    assert command("infer", TASK, *flags, "--quiet", "--out", tmp_path / "quiet") == 0
    quiet = capsys.readouterr()
    assert all(name in quiet.out for name in ("first", "second", "narrower"))
    assert not any(word in quiet.out for word in ("compiled", "round 1", "results:", "warning:"))
    assert all(line.startswith("warning: ") for line in quiet.err.splitlines())


def test_json_of_several_runs_is_by_folder(comparison, capsys):
    capsys.readouterr()
    assert command("resume", comparison, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {run["folder"] for run in run_store.read_config(comparison)["runs"]}
    name, one = next(iter(found.items()))
    assert one == json.loads((comparison / name / "summary.json").read_text())


def test_report_names_what_it_drew(comparison, monkeypatch, capsys):
    monkeypatch.setattr(figures, "report", lambda folder: [folder / "report.html"])
    assert command("report", comparison) == 0
    assert "report.html" in capsys.readouterr().out


def test_an_observation_can_come_from_a_file(tmp_path):
    (tmp_path / "real.csv").write_text("x\n0.8\n-0.6\n")
    np.savez(tmp_path / "real.npz", trajectory=np.array([0.8, -0.6], np.float32))
    for kind in ("csv", "npz"):
        file = tmp_path / f"real.{kind}"
        assert command("infer", TASK, *FLAGS, "--observation", file, "--out", tmp_path / kind) == 0
    first, second = (atomic.read_arrays(tmp_path / kind / "posterior.npz") for kind in ("csv", "npz"))
    np.testing.assert_array_equal(first["means"], second["means"])
    seen = atomic.read_arrays(tmp_path / "csv" / "observation.npz")
    np.testing.assert_allclose(seen["trajectory"], [0.8, -0.6], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1,2\n3,4\n", [[1, 2], [3, 4]]),
        ("hare,lynx\n1,2\n3,4\n", [[1, 2], [3, 4]]),
        ("# a comment\nYear,hare,lynx\n1900,1,2\n1901,3,4\n", [[1, 2], [3, 4]]),
        ("1\n2\n", [[1], [2]]),
    ],
)
def test_csv_layouts(text, expected, tmp_path):
    (tmp_path / "x.csv").write_text(text)
    assert observation.read(tmp_path / "x.csv").tolist() == expected


@pytest.mark.parametrize("text", ["", "a,b\n", "1,2\n3\n", "1,x\n", "1,2\nnan,1\n", "1,2,3\n"])
def test_csv_files_that_cannot_be_an_observation(text, tmp_path, capsys):
    (tmp_path / "x.csv").write_text(text)
    arguments = ("infer", TASK, "--observation", tmp_path / "x.csv", "--out", tmp_path / "out")
    assert "observation: " in error_line(capsys, *arguments)
    assert not (tmp_path / "out").exists()


def test_npz_files_that_cannot_be_an_observation(tmp_path, capsys):
    np.savez(tmp_path / "two.npz", a=np.zeros(2), b=np.zeros(2))
    np.savez(tmp_path / "pickled.npz", trajectory=np.array([{}, None]))
    (tmp_path / "broken.npz").write_bytes(b"PK not really")
    for name in ("two", "pickled", "broken"):
        arguments = ("infer", TASK, "--observation", tmp_path / f"{name}.npz", "--out", tmp_path / "out")
        assert "expected a readable file" in error_line(capsys, *arguments)


@pytest.mark.slow
def test_a_simulator_that_breaks_its_contract_leaves_nothing(tmp_path, capsys):
    for name, expected in (("wrong_shape", "expected numbers of shape"), ("failing", "got none (failed: 25")):
        task = f"tests.cli.test_cli:{name}"
        assert expected in error_line(capsys, "infer", task, *FLAGS, "--out", tmp_path / name)
        assert not list(tmp_path.iterdir())


KILLED = """
import os, signal, sys
from jaxlfi.cli import parser
from jaxlfi.runs.checkpoint import Checkpoint

write = Checkpoint.write_round
Checkpoint.write_round = lambda *arguments: write(*arguments) or os.kill(os.getpid(), signal.SIGKILL)
parser.main(sys.argv[1:])
"""
"""A command whose process dies as it has made a round."""


@pytest.mark.slow  # in runs/, a process is killed that simulates on the host, and writes fail at any moment of others
def test_a_killed_process_resumes_to_the_same_bits(tmp_path, capsys):
    arguments = ["infer", TASK, *FLAGS, "--out"]
    words = [sys.executable, "-c", KILLED, *arguments, str(tmp_path / "killed")]
    assert subprocess.run(words, stdout=subprocess.DEVNULL, check=False).returncode == -signal.SIGKILL
    assert not (tmp_path / "killed" / "posterior.npz").exists()
    capsys.readouterr()
    assert command("resume", tmp_path / "killed", "--no-figures") == 0
    printed = capsys.readouterr()
    assert printed.err == "" and "1 of 2 rounds to do" in printed.out
    assert command(*arguments, tmp_path / "whole") == 0
    for name in ("posterior.npz", "dataset.npz"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_an_interrupt_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(executing, "execute", interrupted)
    assert command("infer", TASK, *FLAGS, "--out", tmp_path / "out") == 130
    assert f"jaxlfi resume {tmp_path / 'out'}" in capsys.readouterr().err


@pytest.fixture
def registered(monkeypatch):
    """One task that works and one whose package is broken."""
    points = [
        EntryPoint("linear", "jaxlfi.envs.gaussian_linear:task", TASKS.group),
        EntryPoint("broken", "no.such.module:task", TASKS.group),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)


def test_tasks_are_listed_also_beside_a_broken_package(registered, capsys):
    assert command("tasks") == 0
    out = capsys.readouterr().out
    assert "linear" in out and "first, second" in out and "cannot load 'broken'" in out


def shouting(words):
    print(" ".join(words).upper())
    return 7


def test_packages_add_commands(monkeypatch, capsys):
    point = EntryPoint("shout", "tests.cli.test_cli:shouting", "jaxlfi.commands")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    assert cli.main(["shout", "whip", "--help"]) == 7
    assert capsys.readouterr().out == "WHIP --HELP\n"
    assert "shout" in cli.parser().format_help()


def oven(heat: float = 1.5, rounds: int = 3):
    """A task with options, which asks for a setting and a hyperparameter."""
    return dataclasses.replace(
        gaussian(),
        name=f"oven at {heat}",
        settings={"rounds": rounds, "learning_rate": 0.25},
        hyperparameters={"edge": {"mass_threshold": (0.125, 0.5), "expansion": 0.75}},
    )


def test_tasks_take_options():
    assert TASKS.load("tests.cli.test_cli:oven").name == "oven at 1.5"
    assert TASKS.load("tests.cli.test_cli:oven,heat=3,rounds=4").name == "oven at 3.0"
    with pytest.raises(ValueError, match=r"expected options among heat, rounds, got 'tests.cli.test_cli:oven,colour="):
        TASKS.load("tests.cli.test_cli:oven,colour=red")
    with pytest.raises(ValueError, match="failed: ValueError: heat: expected a value of type float, got 'much'"):
        TASKS.load("tests.cli.test_cli:oven,heat=much")
    with pytest.raises(ValueError, match="expected options among none"):
        TASKS.load("jaxlfi.envs.gaussian_linear:task,object=dlo-0")
    for wrong in (
        "tests.cli.test_cli:oven,heat",
        "tests.cli.test_cli:oven,heat=",
        "tests.cli.test_cli:oven,heat=1,heat=2",
    ):
        with pytest.raises(ValueError, match="expected options as NAME,key=value"):
            TASKS.load(wrong)


def test_an_object_is_an_option_of_the_task(tmp_path, capsys):
    message = error_line(capsys, "infer", TASK, "--object", "dlo-0", *FLAGS, "--out", tmp_path / "out")
    assert "expected options among none" in message and "object=dlo-0" in message


def several(object: tuple[str, ...] | str | None = None, pooling: Literal["all", "mean"] = "all"):
    """A task that knows objects, and an option that all tasks have besides."""
    return dataclasses.replace(gaussian(), name=f"{object} {pooling}")


def test_several_objects_are_an_option_of_the_task(tmp_path, capsys):
    words = "--object", "a b.npz", "c", "--object", "d", *FLAGS, "--out", tmp_path / "out"
    assert "object=a b.npz;c;d" in error_line(capsys, "infer", TASK, *words)  # which has no objects
    reference = "tests.cli.test_cli:several"
    assert TASKS.load(f"{reference},object=a b.npz;c;d").name == "('a b.npz', 'c', 'd') all"
    assert TASKS.load(f"{reference},object=a").name == "('a',) all"
    message = error_line(capsys, "infer", TASK, "--object", "a,b", "c;d", *FLAGS, "--out", tmp_path / "out")
    assert f'got \'{TASK},object="a,b";"c;d"\'' in message
    assert TASKS.load(f'{reference},object="a,b";"c;d"').name == "('a,b', 'c;d') all"


def test_a_pooling_is_the_tasks_own_unless_there_are_trials():
    reference = "tests.cli.test_cli:several,object=a"
    assert TASKS.load(f"{reference},pooling=mean").name == "('a',) mean"
    assert TASKS.load(f"{reference},pooling=mean,trials=2") == repeated(TASKS.load(reference), 2, "mean")
    with pytest.raises(ValueError, match=r"pooling: expected one of \['all', 'mean'\], got 'moments'"):
        TASKS.load(f"{reference},pooling=moments")


def test_what_a_task_asks_for_comes_before_the_preset_and_after_the_command_line(tmp_path):
    task = oven()
    parse = lambda *words: cli.parser().parse_args(["infer", TASK, "--out", str(tmp_path), *words])
    settings = choices.build_settings(parse(), task)
    assert (settings.rounds, settings.estimator.learning_rate) == (3, 0.25)
    assert settings.estimator.hidden == PRESETS["quick"].estimator.hidden
    given = choices.build_settings(parse("--rounds", "7"), task)
    assert (given.rounds, given.estimator.learning_rate) == (7, 0.25)
    assert choices.build_settings(parse("--method", "npe"), task).rounds == 1  # of all simulations of the three
    kinds = {"edge": Edge, "mode": Mode}
    edge = choices.build_heuristic(parse("--expansion", "0.1"), "edge", kinds, settings, task)
    np.testing.assert_array_equal(edge.mass_threshold, [0.125, 0.5])
    assert edge.expansion == 0.1
    mode = choices.build_heuristic(parse(), "mode", kinds, PRESETS["paper"], task)
    assert mode == Mode()
    assert jaxlfi.settings_for(task) == settings  # the same in Python


def test_the_paper_s_threshold_comes_with_its_preset(tmp_path):
    parse = lambda *words: cli.parser().parse_args(["infer", TASK, "--out", str(tmp_path), *words])
    build = lambda task, *words: choices.build_heuristic(parse(*words), "edge", {"edge": Edge}, PRESETS["paper"], task)
    edge = lambda task, *words: build(task, *words).mass_threshold
    assert edge(gaussian()) == Edge().mass_threshold == 0.12  # more than a uniform posterior has along a bound
    assert edge(gaussian(), "--preset", "paper") == 0.005
    assert edge(gaussian(), "--preset", "paper", "--mass-threshold", "0.3") == 0.3
    np.testing.assert_array_equal(edge(oven(), "--preset", "paper"), [0.125, 0.5])  # the task's own
    for given in HYPERPARAMETERS.values():
        for name, values in given.items():
            assert set(values) <= set(all_declared(HEURISTICS.load(name)))


def test_a_setting_that_a_task_asks_for_and_nothing_has_is_refused():
    task = dataclasses.replace(gaussian(), name="oven", settings={"transforms": 3, "degrees": 7})
    with pytest.raises(
        ValueError, match="oven: settings: expected names of Settings or of an estimator, got 'degrees'"
    ):
        jaxlfi.settings_for(task)
    task = dataclasses.replace(task, settings={"transforms": 3})  # of flows: the mixture network has none
    assert jaxlfi.settings_for(task, "npe").estimator.transforms == 3
    assert jaxlfi.settings_for(task, preset="paper") == PRESETS["paper"]
    with pytest.raises(ValueError, match="method: expected one of bayessim, tsnpe, apt, npe, snle, got 'abc'"):
        jaxlfi.settings_for(task, "abc")
    with pytest.raises(ValueError, match="preset: expected one of quick, paper, got 'slow'"):
        jaxlfi.settings_for(task, preset="slow")


def test_one_task_is_described(registered, capsys):
    assert command("tasks", "linear") == 0
    out = capsys.readouterr().out
    assert "[-3, 0]" in out and "Phi" in out and "truth" in out
    assert "cannot load 'broken'" in error_line(capsys, "tasks", "broken")
    assert "expected one of ['broken', 'linear']" in error_line(capsys, "tasks", "other")


def test_default_configurations_are_the_matrix_of_the_paper():
    assert choices.default_configurations(gaussian()) == [
        "ok", "misspecified", "broad", "misspecified+edge", "misspecified+mode", "misspecified+centre",
    ]  # fmt: skip


def test_no_folder_is_made_that_a_path_only_passes_through(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert flags.output("runs/a/../b") == Path("runs/b")
    assert flags.output("../b") == Path("../b")
    (tmp_path / "elsewhere/inner").mkdir(parents=True)
    (tmp_path / "link").symlink_to("elsewhere/inner")
    assert flags.output("link/../b") == Path("elsewhere/b")
    assert flags.output("link/b") == Path("link/b")
