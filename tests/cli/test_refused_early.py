"""What can be seen to be wrong is refused before jax starts, which takes seconds."""

import json
import subprocess
import sys

import pytest

from jaxlfi.fields import Declared, FieldInfo
from jaxlfi.flags import _require

WRONG = {
    "infer lotka_volterra --out there": "out: expected a new or empty folder",
    "compare lotka_volterra --out there": "out: expected a new or empty folder",
    "grid lotka_volterra --vary expansion=0.1 --out there": "out: expected a new or empty folder",
    "infer no_such_task --out new": "task: expected one of",
    "infer lotka_volterra,object --out new": "task:",
    "infer lotka_volterra --rounds 0 --out new": "rounds: expected a whole number in [1, 100000], got 0",
    "infer lotka_volterra --learning-rate nan --out new": "learning_rate: expected a number in (0, inf), got nan",
    "infer lotka_volterra --expansion 0.1 -3 --out new": "expansion: expected a number in [0, inf), got -3.0",
    "infer lotka_volterra --schedule linear --out new": "schedule: expected one of constant, cosine, got 'linear'",
}
SCRIPT = """
import json, sys
from jaxlfi.cli import parser
for words in json.loads(sys.argv[1]):
    assert parser.main(words.split()) == 2, words
assert "jax" not in sys.modules
"""


def test_wrong_arguments_are_refused_before_jax_is_imported(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "something").touch()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(list(WRONG))], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == len(WRONG), done.stderr
    for line, wanted in zip(lines, WRONG.values(), strict=True):
        assert line.startswith(f"jaxlfi: error: {wanted}"), line
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_value_that_one_of_several_classes_takes_is_not_refused():
    """Which of them is used is known later."""
    low, high = (Declared("x", 0.5, FieldInfo("x", low=a, high=a + 1), False) for a in (0, 2))
    _require({"low": low, "high": high}, [0.5, 2.5])
    for wrong in (1.5, [0.5, 9.0]):
        with pytest.raises(ValueError, match=r"x: expected a number in \[0, 1\]"):
            _require({"low": low, "high": high}, wrong)
