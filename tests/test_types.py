"""The modules that the type checker still ignores: ever fewer, and none that users call."""

import os
import pathlib
import re
import subprocess
import sys
import tomllib

import pytest

import jaxlfi

ROOT = pathlib.Path(jaxlfi.__file__).parents[1]
CLEAN = ("bayessim", "distributions", "estimators", "fields", "heuristics", "plot", "runs", "tasks")
"""Parts of jaxlfi that users call, and the core, all without errors."""


def configuration() -> str:
    return (ROOT / "pyproject.toml").read_text()


def unchecked() -> list[str]:
    """The modules whose errors are ignored."""
    (found,) = (
        entry for entry in tomllib.loads(configuration())["tool"]["mypy"]["overrides"] if entry.get("ignore_errors")
    )
    return found["module"]


def path_of(module: str) -> pathlib.Path:
    place = ROOT / module.replace(".", "/")
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


def test_what_users_call_and_the_core_are_checked():
    homes = {jaxlfi._HOMES[name] for name in jaxlfi.__all__}
    assert {home.split(".")[1] for home in homes} <= set(CLEAN)
    assert not [module for module in unchecked() if module.split(".")[1] in CLEAN]


def test_unchecked_modules_are_named_once_and_exist():
    named = unchecked()
    assert named == sorted(set(named)) and "*" not in "".join(named)
    assert not [module for module in named if not path_of(module).is_file()]


@pytest.mark.slow
def test_a_module_without_errors_is_not_on_the_list(tmp_path):
    """Without the list, the checker finds errors in each module on it, and in no other."""
    pytest.importorskip("mypy")
    text, count = re.subn(r"^ignore_errors = true$", "ignore_errors = false", configuration(), flags=re.MULTILINE)
    assert count == 1
    (tmp_path / "pyproject.toml").write_text(text)
    words = ["--config-file", str(tmp_path / "pyproject.toml"), "--cache-dir", str(tmp_path / "cache"), "--no-pretty"]
    alone = {name: value for name, value in os.environ.items() if name != "MYPYPATH"}
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words], cwd=ROOT, env=alone, capture_output=True, text=True, timeout=900
    )
    wrong = {line.split(".py:")[0].replace("/", ".") for line in done.stdout.splitlines() if ": error:" in line}
    assert wrong, done.stdout + done.stderr
    assert wrong == set(unchecked()), "pyproject.toml: the list of tool.mypy is to be these modules"
