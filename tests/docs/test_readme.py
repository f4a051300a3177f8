"""README's example runs and says what is printed below it; commands are understood, links lead somewhere."""

import re
import shlex
import tomllib
from pathlib import Path

import jax
import pytest

from jaxlfi.cli import parser as cli

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(kind: str) -> list[str]:
    return [body for language, body in BLOCK.findall(README) if language == kind]


def commands() -> list[list[str]]:
    """All command lines, with continued lines joined and comments left out."""
    joined = "\n".join(blocks("sh")).replace("\\\n", " ")
    return [words for line in joined.splitlines() if (words := shlex.split(line, comments=True))]


def starting(*words: str) -> list[list[str]]:
    return [command for command in commands() if command[: len(words)] == list(words)]


def parse(words: list[str]) -> None:
    """Parse words with the parser that the command itself uses."""
    if command := cli.foreign_command(words[0]):
        command.parser().parse_args(words[1:])
    else:
        cli.parse(words)


def table(summary: str) -> dict[str, list[float]]:
    """Median and ends of both intervals by parameter."""
    rows = re.findall(r"^(\w+) +([\d.]+) [^\[]*\[([\d.]+), ([\d.]+)\] +\[([\d.]+), ([\d.]+)\]", summary, re.MULTILINE)
    return {name: list(map(float, numbers)) for name, *numbers in rows}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxlfi.SupportWarning")
def test_the_example_says_what_is_printed(capsys):
    """As nearly as another processor and another thread count may differ."""
    (code,), (printed,) = blocks("python"), blocks("text")
    with jax.debug_key_reuse(False):
        exec(compile(code, "README.md", "exec"), {})
    made = capsys.readouterr().out
    expected, found = table(printed), table(made)
    assert expected.keys() == found.keys() == {"stiffness", "damping"}
    for name, numbers in expected.items():
        width = numbers[4] - numbers[3]
        assert found[name] == pytest.approx(numbers, abs=width), name
    verdict = "The first guess of 1 to 4 N/m for stiffness was wrong: EDGE moved its upper bound to"
    assert verdict in printed and verdict in made


@pytest.mark.parametrize("words", starting("jaxlfi"), ids=" ".join)
def test_every_command_is_understood(words):
    parse(words[1:])


def test_a_flag_that_does_not_exist_is_not():
    with pytest.raises(SystemExit):
        parse(["infer", "lynx_hare", "--no-such-flag", "--out", "runs/x"])


def test_other_lines_are_those_of_the_installation():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = re.findall(r"`make (\w+)`", README)
    assert named and set(named) <= set(targets)
    for words in commands():
        if words[:3] == ["pip", "install", "-e"]:
            extras = re.findall(r"\w+", words[3].removeprefix("."))
            assert extras and set(extras) <= set(project["optional-dependencies"])
        else:
            assert words[0] == "jaxlfi" or words[:2] == ["python3.11", "-m"]


def test_no_result_is_written_twice_and_what_is_read_was_written():
    written = set()
    for words in commands():
        if words[0] != "jaxlfi":
            continue
        read = (
            [words[3]] if words[1] == "mujoco" else [words[words.index("--domain") + 1]] if "--domain" in words else []
        )
        assert set(read) <= written
        out = words[words.index("--out") + 1]
        assert out not in written
        written.add(out)


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


def test_readme_is_short():
    assert len(README.splitlines()) <= 72
