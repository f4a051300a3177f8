"""Names, numbers, folders and files that a user may well give: each is right as written, or refused in one line."""

import csv
import dataclasses
import json
import resource
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi import figures
from jaxlfi.cli import parser as cli
from jaxlfi.io import files as atomic
from jaxlfi.runs import execute as executing
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, whole_runs  # noqa: F401 - a fixture

COMMANDS = ("tasks", "infer", "compare", "grid", "resume", "sample", "diagnose", "report")
HERE = "tests.cli.test_hostile_input"


def error_line(capsys, *arguments) -> str:
    """The one line that a refused command leaves on stderr."""
    capsys.readouterr()
    assert command(*arguments) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and message.startswith("jaxlfi") and "error: " in message
    return message


# ------------------------------------------------------------------------------------------------------- --help


def test_every_command_is_asked_for_help():
    assert set(COMMANDS) <= set(cli.parser()._subparsers._group_actions[0].choices)


@pytest.mark.parametrize("words", [[], *([name] for name in COMMANDS)], ids=lambda words: " ".join(words) or "jaxlfi")
def test_help_answers_without_jax_or_numpy(words):
    """In a process of its own; 0.2 s of processor time on an idle machine."""
    script = (
        "import atexit, sys; heavy = ('jax', 'numpy', 'flax', 'optax', 'rich', 'matplotlib'); "
        "atexit.register(lambda: print('imported:', [name for name in heavy if name in sys.modules])); "
        f"import jaxlfi.cli.parser as cli; cli.main({[*words, '--help']!r})"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.stdout.startswith("usage: jaxlfi") and done.stdout.endswith("imported: []\n")
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2.0


# ------------------------------------------------------------------------------------------------------- refused


def supported(label: str = "a/../../zz"):
    """A support whose name would lead out of the folder."""
    return dataclasses.replace(gaussian(), supports={label: gaussian().supports["ok"]})


def raising():
    """A host simulator that breaks when it is called."""

    def simulate(rng, theta):
        raise RuntimeError("no licence\nfor this machine")

    return dataclasses.replace(gaussian(), simulate=jaxlfi.HostSimulator(simulate), truth=None, observation=[0.8, -0.6])


REFUSED = {
    "a negative step": (["infer", TASK, "--expansion", "-1"], "expansion: expected a number in [0, inf), got -1"),
    "a negative step in a grid": (["grid", TASK, "--vary", "tail=0,1", "--expansion", "-1"], "expansion: expected a number in [0, inf), got -1"),  # noqa: E501
    "negative steps on an axis": (["grid", TASK, "--vary", "expansion=-1,1"], "expansion: expected finite numbers in [0, inf)"),  # noqa: E501
    "a fraction above one": (["infer", TASK, "--tail", "2"], "tail: expected a number in [0, 1], got 2"),
    "a support that leads elsewhere": (["compare", f"{HERE}:supported"], "supports: expected names of letters, digits"),
    "the same by an option": (["infer", f"{HERE}:supported,label=.."], "supports: expected names of letters, digits"),
    "a file for a module": (["infer", "bbv.py:task"], "leave out '.py' and run from the file's folder"),
    "too many rounds": (["infer", TASK, "--rounds", "3000000000"], "rounds: expected a whole number in [1, 100000]"),
    "too many simulations": (["infer", TASK, "--simulations-per-round", "1000000000000"], "simulations_per_round: expected a whole number"),  # noqa: E501
    "no transforms": (["infer", TASK, "--estimator", "nsf", "--transforms", "0"], "transforms: expected a whole number in [1, "),  # noqa: E501
    "no units": (["infer", TASK, "--hidden", "0"], "hidden: expected a whole number in [1, inf), got 0"),
    "no patience left": (["infer", TASK, "--patience", "-1"], "patience: expected a whole number in [0, inf), got -1"),
    "gradients of length none": (["infer", TASK, "--clip-norm", "0"], "clip_norm: expected a number in (0, inf]"),
    "all pruned": (["infer", TASK, "--prune", "2"], "prune: expected a number in [0, 0.5], got 2"),
    "all held out": (["infer", TASK, "--validation", "0.999"], "validation: expected a number in [0, 0.9], got 0.999"),
    "no seeds left": (["infer", TASK, "--first-seed", "2147483648"], "first_seed at least 0, got 1 and 2147483648"),
    "seeds below zero": (["compare", TASK, "--first-seed", "-1"], "first_seed at least 0, got 4 and -1"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_is_one_line_and_leaves_nothing(case, tmp_path, capsys):
    arguments, expected = REFUSED[case]
    assert expected in error_line(capsys, *arguments, "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["infer", TASK], ["grid", TASK, "--vary", "tail=0,1"]], ids=["infer", "grid"])
def test_a_link_to_nothing_is_no_new_folder(arguments, tmp_path, capsys):
    out = tmp_path / "out"
    out.symlink_to(tmp_path / "nowhere")
    assert "a broken symbolic link" in error_line(capsys, *arguments, "--out", out)
    assert [path.name for path in tmp_path.iterdir()] == ["out"] and out.is_symlink()


def test_a_simulator_that_raises_is_one_line_and_leaves_nothing(tmp_path, capsys):
    message = error_line(capsys, "infer", f"{HERE}:raising", *FLAGS, "--out", tmp_path / "out")
    assert "simulate: RuntimeError: no licence for this machine" in message
    assert not list(tmp_path.iterdir())


def test_any_failure_before_the_first_round_leaves_no_folder(tmp_path, monkeypatch):
    def fail(*_):
        raise MemoryError("no room")

    monkeypatch.setattr(executing, "execute", fail)
    with pytest.raises(MemoryError):
        command("infer", TASK, *FLAGS, "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------------- names

NAMES = ("ln k[/m]", "c,d[bold]x")


def marked():
    """Names and units that rich would take for markup; neither parameter is a logarithm."""
    return dataclasses.replace(gaussian(), name="[/task]", names=NAMES, units=("[m]", "[/red]"))


@pytest.fixture(scope="module")
def named(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A run of a task whose parameters have such names."""
    run = jaxlfi.infer(jax.random.key(3), marked(), settings=SETTINGS)
    return run.save(tmp_path_factory.mktemp("named") / "run"), run


@pytest.mark.slow
def test_samples_have_the_names_and_values_of_the_parameters(named, tmp_path, capsys):
    """A name that begins with "ln " is no logarithm, and a comma in a name is no second column."""
    folder, run = named
    draws = np.asarray(run.posterior.sample(jax.random.key(0), 1000))
    assert command("sample", folder, "-n", 1000, "--out", tmp_path / "draws.csv") == 0
    with (tmp_path / "draws.csv").open(newline="") as file:
        heading, *rows = csv.reader(file)
    assert tuple(heading) == NAMES
    np.testing.assert_allclose(np.array(rows, float), draws, rtol=1e-6)
    capsys.readouterr()
    assert command("sample", folder, "-n", 1000, "--out", "-") == 0
    assert capsys.readouterr().out == (tmp_path / "draws.csv").read_text()
    assert command("sample", folder, "-n", 1000, "--out", tmp_path / "draws.npz") == 0
    arrays = atomic.read_arrays(tmp_path / "draws.npz")
    assert tuple(arrays["names"]) == NAMES
    np.testing.assert_allclose(arrays["theta"], draws, rtol=1e-6)


def test_markup_in_names_is_printed_as_it_is(tmp_path, monkeypatch, capsys):
    assert command("tasks", f"{HERE}:marked") == 0
    output = capsys.readouterr().out
    assert all(text in output for text in ("[/task]", *NAMES, "[m]", "[/red]"))
    out = tmp_path / "[bold]run"
    assert command("infer", f"{HERE}:marked", *FLAGS, "--out", out) == 0
    output = capsys.readouterr().out
    assert "[/task]: 1 run: 2 of 2 rounds to do" in output and f"results: {out}" in output
    assert command("sample", out, "-n", 1000) == 0
    assert f"samples: {out / 'samples.csv'}" in capsys.readouterr().out
    monkeypatch.setattr(figures, "report", lambda folder: [folder / "[/x].png"])
    assert command("report", out) == 0
    assert f"figure: {out / '[/x].png'}" in capsys.readouterr().out
    assert "[/nothing]" in error_line(capsys, "infer", TASK, "--support", "[/nothing]", "--out", tmp_path / "new")


# ------------------------------------------------------------------------------------------------------- edited files


def drop(name):
    return lambda config: config.pop(name)


def put(**values):
    return lambda config: config.update(values)


EDITS = {
    "no settings": drop("settings"),
    "settings of another kind": put(settings=[1]),
    "an unknown setting": lambda config: config["settings"].update(colour="red"),
    "a setting out of range": lambda config: config["settings"].update(rounds=0),
    "a setting of another type": lambda config: config["settings"].update(rounds="many"),
    "an estimator that is a number": lambda config: config["settings"].update(estimator=10**30),
    "an estimator that is not there": lambda config: config["settings"]["estimator"].update(name="gone"),
    "a heuristic that is not there": lambda config: config["heuristic"].update(name="gone"),
    "no heuristic": drop("heuristic"),
    "reversed bounds": lambda config: config["support"].update(low=[5.0, 5.0]),
    "bounds of another length": lambda config: config["support"].update(low=[-3.0], high=[3.0]),
    "no bounds of Phi": drop("feasible_low"),
    "no names": drop("parameters"),
    "other numbers of names": put(parameters=["one"], log=[False]),
    "no logarithms": drop("log"),
    "no seed": drop("seed"),
    "a seed that is none": put(seed="first"),
    "a seed below zero": put(seed=-1),
    "another version": put(version=1),
    "no version": drop("version"),
    "no format": drop("format"),
    "not finished": put(status="running"),
}


@pytest.mark.parametrize("case", EDITS)
def test_an_edited_description_is_refused_in_one_line(case, named, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(named[0], copy)
    config = json.loads((copy / "config.json").read_text())
    EDITS[case](config)
    (copy / "config.json").write_text(json.dumps(config))
    error_line(capsys, "sample", copy)
    assert not (copy / "samples.csv").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"text"', "{}"])
def test_a_description_that_is_none_is_refused_in_one_line(text, named, tmp_path, capsys):
    copy = tmp_path / "run"
    shutil.copytree(named[0], copy)
    (copy / "config.json").write_text(text)
    assert "expected a run folder" in error_line(capsys, "sample", copy)


@pytest.mark.parametrize("arguments", [["-n", 0], ["-n", -5], ["-n", 2.5], ["--seed", -1], ["--seed", 2**63]])
def test_numbers_of_samples_and_seeds_that_are_none(arguments, named, tmp_path, capsys):
    error_line(capsys, "sample", named[0], *arguments, "--out", tmp_path / "draws.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", ["-1", str(2**63), "9" * 5000, "1e3"])
@pytest.mark.parametrize(
    "words",
    ["sample run", "evaluate line policy.npz --domain median", "whip control policy.npz --robot dlo-0 --out out.npz"],
)
def test_seeds_out_of_range_are_refused(words, seed, capsys):
    assert "--seed: expected a number from 0 to 2^63 - 1, got" in error_line(capsys, *words.split(), f"--seed={seed}")
