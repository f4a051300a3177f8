"""Tutorials run as the site runs them, and their commands are understood."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from jaxlfi.cli import parser as cli

ROOT = Path(__file__).parents[2]
TUTORIALS = {path.stem: path.read_text() for path in sorted((ROOT / "docs/tutorials").glob("*.md"))}
SAYS = {
    "arm": r"body/payload/mass[ │]+0\.5",
    "choosing": r"npe +width / exact width: \[",
    "diagnostics": r"too narrow +verdict: too narrow;.*\n.*verdict: too wide;.*\n.*verdict: biased low",
    "policy": r"trained on the posterior misses the mark by 0\.[01]\d m",
    "program": r"rate,room\n0\.0",
    "sir": r"infections per case: [34]\.\d",
    "unidentified": r"Ridge: no experiment within the bounds determines .*\n(.*\n)*.*Ridge: broken",
    "spring": r"The first guess of 1 to 4 N/m for stiffness was wrong: EDGE moved its upper bound",
}
"""What the outputs of each have in them."""


def runner():
    spec = importlib.util.spec_from_file_location("docs_tutorials", ROOT / "docs/tutorials.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_outputs_and_pictures_stand_below_their_blocks():
    page = """```text title="numbers.txt"
1 2
```

```python
print(open("numbers.txt").read().split())
```

Words.

```sh
cp numbers.txt other.png
```

```python
value = 3
```
"""
    made, pictures = runner().executed(page)
    assert made == page.replace("split())\n```", "split())\n```\n\n```text title=\"Output\"\n['1', '2']\n```").replace(
        "other.png\n```", "other.png\n```\n\n![other](other.png)"
    )
    assert pictures == {"other.png": b"1 2\n"}


@pytest.mark.parametrize("block", ["```python\nassert False\n```", "```sh\nfalse\n```"], ids=["python", "sh"])
def test_a_block_that_fails_is_an_error(block):
    with pytest.raises(RuntimeError, match="a block failed"):
        runner().executed(block)


@pytest.mark.slow
@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_runs(name):
    made, _ = runner().executed(TUTORIALS[name])
    assert re.search(SAYS[name], made)


@pytest.mark.parametrize("name", TUTORIALS)
def test_commands_of_a_tutorial_are_understood(name):
    for body in re.findall(r"^```sh\n(.*?)^```$", TUTORIALS[name], re.MULTILINE | re.DOTALL):
        for line in body.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] != ["jaxlfi"]:
                continue
            if command := cli.foreign_command(words[1]):
                command.parser().parse_args(words[2:])
            else:
                cli.parse(words[1:])
