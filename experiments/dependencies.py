"""The library's dependencies, with licences and last releases: `python -m experiments.dependencies`.

It prints the table of docs/dependencies.md, except for the release dates: requirements and reasons from pyproject.toml,
licences from the installed packages, and the last versions that pip finds for this Python.
"""

import argparse
import dataclasses
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
SELF = ("test", "bench", "docs", "dev")
"""Extras for those who work on the library or its experiments."""
LICENCES = {
    "Apache-2.0": r"apache",
    "MIT": r"\bmit\b",
    "BSD-3-Clause": r"3-clause|new bsd|\bbsd license",
    "MIT-CMU": r"mit-cmu|hpnd",
    "PSF-based": r"python software foundation|psf",
}
"""Patterns of licence texts of packages without an SPDX expression."""


@dataclasses.dataclass(frozen=True)
class Dependency:
    """One direct dependency.

    Attributes:
        name: name of the package.
        needed: oldest version, as in pyproject.toml.
        extras: extras that require it; none if every installation does.
        why: reason, from its comment in pyproject.toml.
    """

    name: str
    needed: str
    extras: tuple[str, ...]
    why: str


def dependencies() -> list[Dependency]:
    """The dependencies of users: first those of every installation, then those of extras."""
    text = PYPROJECT.read_text()
    project = tomllib.loads(text)["project"]
    asked: dict[str, tuple[str, list[str]]] = {}
    groups = {"": project["dependencies"]} | project["optional-dependencies"]
    for extra, requirements in groups.items():
        for requirement in requirements if extra not in SELF else ():
            name, needed = re.match(r"([A-Za-z0-9_.-]+)(?:\[.*\])?(.*)", requirement).groups()
            asked.setdefault(name, (needed, []))[1].append(extra)
    return [
        Dependency(name, needed, tuple(filter(None, extras)), _why(name, text))
        for name, (needed, extras) in asked.items()
    ]


def _why(name: str, text: str) -> str:
    """The comment after the first requirement of a package outside the extras of `SELF`."""
    extra = ""
    for line in text.splitlines():
        if begun := re.match(r"(\w+) = \[", line):
            extra = begun[1]
        requirements, _, comment = line.partition("#")
        if extra not in SELF and comment and re.search(rf'"{re.escape(name)}[^A-Za-z0-9-]', requirements):
            return comment.strip()
    return ""


def licence(name: str) -> str:
    """The licence that an installed package declares, by its SPDX name."""
    fields = metadata.metadata(name)
    if expression := fields.get("License-Expression"):
        return expression
    classifiers = [text for text in fields.get_all("Classifier", []) if text.startswith("License ::")]
    declared = " ".join([*classifiers, (fields.get("License") or "")[:200]]).lower()
    return next((spdx for spdx, pattern in LICENCES.items() if re.search(pattern, declared)), "not declared")


def last_release(name: str) -> str:
    """The last version that pip finds."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "index", "versions", name]
    return version(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def version(found: str) -> str:
    """The version at the beginning of the output of `pip index versions`: "NAME (VERSION)"."""
    return re.match(r"\S+ \((\S+)\)", found)[1]


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print("| package | needed | for | licence | last release | why |\n|---|---|---|---|---|---|")
    for one in dependencies():
        extras = ", ".join(f"`{extra}`" for extra in one.extras) or "everything"
        cells = one.name, one.needed, extras, licence(one.name), last_release(one.name), one.why
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
