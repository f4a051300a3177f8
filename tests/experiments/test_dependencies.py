"""The table of what the library depends on: that of pyproject.toml and of the installed packages."""

from importlib import metadata
from pathlib import Path

import pytest

from experiments import dependencies

PAGE = Path(__file__).parents[2] / "docs" / "dependencies.md"
ROWS = {
    cells[0]: cells
    for cells in (line.strip("| \n").split(" | ") for line in PAGE.read_text().splitlines() if "|" in line)
}


def test_the_table_has_what_pyproject_asks_for():
    found = dependencies.dependencies()
    assert list(ROWS)[2:] == [one.name for one in found]
    for one in found:
        extras = ", ".join(f"`{extra}`" for extra in one.extras) or "everything"
        _, needed, of, _, last, why = ROWS[one.name]
        assert (needed, of, why) == (one.needed, extras, one.why) and why
        assert len(last.split(", ")[1]) == len("2026-11-24")


@pytest.mark.parametrize("name", list(ROWS)[2:])
def test_licences_are_those_of_the_installed_packages(name):
    """The first of several, as other versions carry other parts."""
    try:
        assert dependencies.licence(name).split(" AND ")[0] == ROWS[name][3].split(" AND ")[0] != "not declared"
    except metadata.PackageNotFoundError:
        pytest.skip("not installed")


def test_the_version_that_pip_begins_with():
    found = "jaxlib (0.12.0.1)\nAvailable versions: 0.12.0.1, 0.12.0\n  INSTALLED: 0.9.2\n"
    assert dependencies.version(found) == "0.12.0.1"
