"""Run the tests affected by changes since main, nearest first, until the time is up: a part of `make check`.

The distance of a test from a change is the number of imports between them: a test that imports the changed module comes
before one that imports it indirectly. A file that is not a Python module is next to the tests that name it. The
examples in the docstrings of changed modules are run first.

    python -m tests.affected --since main --seconds 35
"""

import argparse
import ast
import os
import pathlib
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping

import jaxlfi
from tests.system.test_architecture import ROOT, files, identify, imported_by, name_of, test_examples_run

MOST = 30
"""Largest number of test files that are run, as loading them takes time, too."""
EXAMPLES = f"tests/system/test_architecture.py::{test_examples_run.__name__}"
PUBLIC = re.compile(rf"(?<![\w.])jaxlfi\.({'|'.join(jaxlfi._HOMES)})\b")
QUOTED = re.compile(r"[\"']((?:jaxlfi|experiments)(?:\.\w+)+)")


def changed(since: str) -> set[pathlib.Path]:
    """Files that differ from the commit where this branch left another, committed or not, and new files."""
    git = lambda *words: subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    base = git("merge-base", since, "HEAD").strip()
    names = git("diff", "--name-only", base) + git("ls-files", "--others", "--exclude-standard")
    return {ROOT / name for name in names.splitlines()}


def used(path: pathlib.Path) -> set[str]:
    """Full names of a file's imports, of the library's public names that it uses, and of modules that it quotes."""
    names, source = set(), text(path)
    blocks: list[ast.AST] = [ast.parse(source)]
    while blocks:  # statements only: there are ten times as many expressions
        for node in ast.iter_child_nodes(blocks.pop()):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names |= imported_by(node, path)
            elif isinstance(node, ast.stmt | ast.excepthandler):
                blocks.append(node)
    names |= set(QUOTED.findall(source)) | {f"jaxlfi.{name}" for name in PUBLIC.findall(source)}
    return {jaxlfi._HOMES.get(name.removeprefix("jaxlfi."), name) for name in names}


def users() -> dict[pathlib.Path, set[pathlib.Path]]:
    """The files that use each file."""
    modules = {name_of(path): path for path in files("jaxlfi", "envs", "experiments", "tests")}
    modules |= {path.stem: path for path in (ROOT / "tests").glob("*.py")}  # pytest has this folder on its path
    found: dict[pathlib.Path, set[pathlib.Path]] = {path: set() for path in modules.values()}
    for path in found:
        for name in used(path):
            while name and name not in modules:
                name = name.rpartition(".")[0]
            if name and modules[name] != path:
                found[modules[name]].add(path)
    return found


def nearest(
    changes: Iterable[pathlib.Path], graph: Mapping[pathlib.Path, set[pathlib.Path]]
) -> dict[pathlib.Path, int]:
    """Test files that changes can make fail, with the number of imports between them and a change, nearest first.

    Args:
        changes: changed files, of any kind.
        graph: the files that use each file.
    """
    modules = {path for path in changes if path in graph}
    distance = dict.fromkeys(modules, 0)
    for path in set(changes) - modules:
        named = re.compile(rf"(?<![\w-]){re.escape(path.name)}(?!\w)")
        distance |= {test: 1 for test in graph if test not in distance and is_test(test) and named.search(text(test))}
    border = list(distance)
    while border:
        beyond = {user: distance[path] + 1 for path in border for user in graph[path] if user not in distance}
        distance |= beyond
        border = list(beyond)
    parts = {path.parent.name for path in modules}
    tests = [path for path in distance if is_test(path) and path.exists()]
    tests.sort(key=lambda path: (distance[path], path.parent.name not in parts, path))
    return {path: distance[path] for path in tests}


def is_test(path: pathlib.Path) -> bool:
    """Whether pytest finds tests in a file."""
    return path.name.startswith("test_") and path.is_relative_to(ROOT / "tests")


def text(path: pathlib.Path) -> str:
    """The content of a file."""
    return path.read_text(encoding="utf-8")


def main() -> int:
    """Run the tests; returns pytest's exit status, or 0 if nothing is affected."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--since", default="main", help="the branch to compare with")
    parser.add_argument("--seconds", type=float, default=35, help="tests begin for so long")
    parser.add_argument("--list", action="store_true", help="only print the files of tests, with their distance")
    arguments = parser.parse_args()
    changes = changed(arguments.since)
    tests = nearest(changes, users())
    if arguments.list:
        print("\n".join(f"{distance} {identify(path)}" for path, distance in tests.items()))
        return 0
    modules = sorted(path for path in changes & set(files("jaxlfi", "envs")) if ">>> " in text(path))
    if not tests and not modules:
        print("No test is affected.")
        return 0
    words = [*(f"{EXAMPLES}[{identify(path)}]" for path in modules), *map(identify, [*tests][:MOST])]
    print(f"{len(tests)} files of tests are affected; running the nearest for {arguments.seconds:g} s:")
    options = ["-q", "-m", "not slow", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", "-p", "tests.until"]
    sys.stdout.flush()
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, *words],
        cwd=ROOT,
        env=os.environ | {"TESTS_SECONDS": str(arguments.seconds)},
    ).returncode


if __name__ == "__main__":
    sys.exit(main())
