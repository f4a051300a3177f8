"""README's blocks run, in their order, from a fresh folder; what takes long is parsed by the real parsers."""

import re
import shlex
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.cli import parser as cli
from tests.small import SETTINGS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUN = {
    "jaxlfi tasks": "",
    "jaxlfi infer decay:task": "--rounds 2 --simulations-per-round 60 --simulation-budget 80 --epochs 5 --hidden 16 "
    "--transforms 1 --validation 0 --patience 0 --no-predictive --no-figures",
    "jaxlfi sample runs/decay": "-n 1000",
}
"""Commands that are run, and what is appended to make them quick; all others are parsed."""


def blocks(kind: str) -> list[str]:
    return [body for language, body in BLOCK.findall(README) if language == kind]


def commands() -> list[list[str]]:
    """All command lines, with continued lines joined and comments left out."""
    joined = "\n".join(blocks("sh")).replace("\\\n", " ")
    return [words for line in joined.splitlines() if (words := shlex.split(line, comments=True))]


def starting(*words: str) -> list[list[str]]:
    return [command for command in commands() if command[: len(words)] == list(words)]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """An empty working folder, for all blocks, in which small settings are the default."""
    place = tmp_path_factory.mktemp("readme")
    infer = jaxlfi.infer
    with pytest.MonkeyPatch.context() as patch, jax.debug_key_reuse(False):
        patch.chdir(place)
        patch.syspath_prepend(str(place))
        patch.setattr(jaxlfi, "infer", lambda *given, **named: infer(*given, **({"settings": SETTINGS} | named)))
        yield place


def parse(words: list[str]) -> None:
    """By the parser that the command itself uses."""
    if command := cli.foreign_command(words[0]):
        command.parser().parse_args(words[1:])
    else:
        cli.parse(words)


@pytest.mark.filterwarnings("ignore::jaxlfi.SupportWarning")
def test_python_blocks_and_quick_commands_run_in_order(fresh, capsys):
    namespace, ran = {}, []
    for language, body in BLOCK.findall(README):
        if language == "python" and (name := re.match(r"# (\w+\.py)\n", body)):
            (fresh / name[1]).write_text(body)
        elif language == "python":
            exec(compile(body, "README.md", "exec"), namespace)
        for line in body.replace("\\\n", " ").splitlines() if language == "sh" else ():
            words = shlex.split(line, comments=True)
            if found := [start for start in RUN if words[: len(start.split())] == start.split()]:
                assert cli.main([*words[1:], *RUN[found[0]].split()]) == 0, capsys.readouterr().err
                ran += found
    assert sorted(ran) == sorted(RUN)
    assert (fresh / "runs/spring/posterior.npz").exists()
    assert len((fresh / "runs/decay/posterior.csv").read_text().splitlines()) == 1001
    run, runs, first = namespace["run"], namespace["runs"], namespace["first"]
    loaded = jaxlfi.load("runs/spring", namespace["task"])
    np.testing.assert_allclose(loaded.mixture.means, run.mixture.means, rtol=1e-5)
    assert runs.belief.support.low.shape == (3, 2) and isinstance(first.warnings, list)


@pytest.mark.parametrize("words", starting("jaxlfi"), ids=" ".join)
def test_every_command_is_understood(words):
    parse(words[1:])


def test_a_flag_that_does_not_exist_is_not():
    with pytest.raises(SystemExit):
        parse(["infer", "lynx_hare", "--no-such-flag", "--out", "runs/x"])


def test_other_lines_are_those_of_the_installation():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands():
        if words[0] == "make":
            assert words[1] in targets
        elif words[:2] == ["pip", "install"] and words[2] == "-e":
            extras = re.findall(r"\w+", words[3].removeprefix("."))
            assert extras and set(extras) <= set(project["optional-dependencies"])
        else:
            assert words[0] == "jaxlfi" or words[:2] in (["pip", "install"], ["python3.11", "-m"], [".", words[1]])


def test_no_result_is_written_twice_and_what_is_read_was_written():
    written = set()
    for words in commands():
        if words[0] != "jaxlfi":
            continue
        if words[1] in ("sample", "diagnose", "report", "resume"):
            assert words[2] in written
        if "--out" in words:
            out = words[words.index("--out") + 1]
            assert out not in written
            written.add(out)


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


def test_readme_is_short():
    assert len(README.splitlines()) < 200
