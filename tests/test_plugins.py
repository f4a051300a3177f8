"""Names that several packages register, malformed names, and paths in references."""

from pathlib import Path

import pytest
from test_fields import package, path  # noqa: F401  a fixture

from jaxlfi import references
from jaxlfi.cli import parser as cli
from jaxlfi.registry import ENVIRONMENTS, HEURISTICS, TASKS

TWIN = """
    from jaxlfi import Heuristic, hyperparameter
    from jaxlfi.heuristics import Fixed

    class Same(Fixed):
        pass

    def task():
        raise AssertionError

    def main(words):
        raise AssertionError
"""
POINTS = """
    [jaxlfi.heuristics]
    same = {name}.own:Same
    {name}_alone = {name}.own:Same

    [jaxlfi.estimators]
    same = {name}.own:Same

    [jaxlfi.tasks]
    same = {name}.own:task

    [jaxlfi.environments]
    same = {name}.own:task

    [jaxlfi.commands]
    same = {name}.own:main
    infer = {name}.own:main
"""


@pytest.fixture
def twins(path):  # noqa: F811
    """Two packages that register the same names in every group, and the name of one of our commands."""
    for name in ("anna", "bert"):
        package(path, name, POINTS.format(name=name), own=TWIN)


def used(kind: str) -> None:
    """Use a name that two packages register."""
    {
        "heuristic": lambda: HEURISTICS.load("same"),
        "task": lambda: TASKS.load("same"),
        "environment": lambda: ENVIRONMENTS.load("same,size=3"),
        "command": lambda: cli.foreign_command("same"),
    }[kind]()


@pytest.mark.parametrize("kind", ["heuristic", "task", "environment", "command"])
def test_a_clash_is_an_error_where_the_name_is_used(kind, twins):
    with pytest.raises(ValueError, match=rf"^{kind}: expected one package that registers 'same', got ") as error:
        used(kind)
    assert "anna (anna.own:" in str(error.value) and "bert (bert.own:" in str(error.value)


def test_the_command_line_names_both_packages_of_a_clash(twins, tmp_path, capsys):
    out = str(tmp_path / "out")
    for words in (
        ["infer", "gaussian_linear", "--out", out],
        ["same"],
        ["compare", "gaussian_linear", "--configurations", "ok+same", "--out", out],
        ["grid", "gaussian_linear", "--heuristic", "same", "--vary", "expansion=0.1,0.2", "--out", out],
        ["compare", "gaussian_linear", "--estimator", "same", "--no-such-flag", "3", "--out", out],
    ):
        assert cli.main(words) == 2
        said = capsys.readouterr().err
        assert "anna" in said and "bert" in said and len(said.splitlines()) == 1, said
        assert ("jaxlfi and anna" in said) == (words[0] == "infer")  # one of our commands


def test_a_clash_is_nothing_to_those_who_do_not_use_the_name(twins):
    shown = cli.parser().format_help()
    assert shown.count("\n    infer ") == 1 and "jaxlfi same --help" in shown
    assert cli.Families().rules["same"] == {}
    assert HEURISTICS.load("edge").__name__ == "Edge" and TASKS.load("gaussian_linear").name == "gaussian_linear"
    assert HEURISTICS.load("anna_alone").__name__ == "Same"
    kind = HEURISTICS.load("bert.own:Same")
    assert HEURISTICS.name_of(kind) == "bert_alone"  # the name that leads back to it
    assert "same" in HEURISTICS.names()


def test_one_object_by_two_packages_is_no_clash(path):  # noqa: F811
    package(path, "home", "[jaxlfi.tasks]\nmine = jaxlfi.envs.gaussian_linear:task\n")
    package(path, "renamed", "[jaxlfi.tasks]\nmine = jaxlfi.envs.gaussian_linear:task\n")
    assert TASKS.load("mine").name == "gaussian_linear"


def test_names_that_lead_nowhere_hurt_nobody_else(path, capsys):  # noqa: F811
    package(path, "odd", "[jaxlfi.heuristics]\nodd = no reference at all!\n[jaxlfi.commands]\n100%s = odd\n")
    assert "100%s --help" in " ".join(cli.parser().format_help().split())
    assert cli.Families().rules["odd"] == {}
    with pytest.raises(ValueError, match=r"^heuristic: cannot load 'odd' \(no reference at all!\): "):
        HEURISTICS.load("odd")
    assert cli.main(["100%s"]) == 2 and "command: cannot load '100%s' (odd)" in capsys.readouterr().err


NAMES = ["monday,rope.npz", "a;b.npz", "a=b.npz", "k=1,v=2.npz", "x,trials=3", "two  spaces", "größe.npz", '"q".npz',
         'a,"b";c', "semi;", ",comma", "don't.npz", "#1%20.npz", "-dash"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_values_pass_untouched_whatever_they_contain(name):
    for kind in (tuple[str, ...], tuple[str, ...] | str | None):
        reference = references.with_option("whip", "object", name, "other", name)
        found, options = references.parse(references.with_option(reference, "trials", "2"))
        assert found == "whip" and list(options) == ["object", "trials"]
        assert references.convert(options["object"], kind, "object") == (name, "other", name)
    options = references.parse(references.with_option("mujoco", "config", name))[1]
    assert references.convert(options["config"], Path, "config") == Path(name)
    assert references.convert(options["config"], str, "config") == name


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(('"', ","))])
def test_a_path_that_exists_needs_no_quotation_marks(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    assert references.parse(f"mujoco,config={name},engine=mjx") == ("mujoco", {"config": name, "engine": "mjx"})
    options = references.parse(f"whip,object={name}")[1]
    assert references.convert(options["object"], tuple[str, ...], "object") == (name,)
    assert references.convert(f"first;{name};other", tuple[str, ...], "object") == ("first", name, "other")


def test_a_path_with_a_comma_that_begins_no_option_needs_none_either():
    assert references.parse("mujoco,config=a,b.toml,engine=mjx")[1] == {"config": "a,b.toml", "engine": "mjx"}
    for wrong in ("config=a,b", "config=a, engine=mjx", "config=a,engine=", "config=a,b=1,b=2", "a,b.toml"):
        with pytest.raises(ValueError, match=r"^task: expected options as NAME,key=value"):
            references.parse(f"mujoco,{wrong}")


def test_the_command_line_passes_names_of_files_on(tmp_path, monkeypatch):
    arguments = cli.parser().parse_args(
        ["infer", "whip", "--object", *NAMES[:-1], "--observation", "a,b.csv", "c d.csv", "--out", "x"]
    )
    name, options = references.parse(cli._reference(arguments))
    assert name == "whip" and options["trials"] == "2"
    assert references.convert(options["object"], tuple[str, ...], "object") == tuple(NAMES[:-1])
