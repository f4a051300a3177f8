"""The documentation's pages: their directives, links, code and tables keep up with the code."""

import ast
import dataclasses
import importlib.util
import re
import sys
from pathlib import Path

import pytest

import jaxlfi
from jaxlfi.bayessim.record import ledger_line, record
from jaxlfi.fields import declared
from jaxlfi.heuristics import Edge, Mode, Truncate
from jaxlfi.io import provenance
from jaxlfi.runs import folder

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
STUDIES = [ROOT / "experiments/README.md", *sorted((ROOT / "experiments/studies").glob("*.md"))]


def hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "docs/hooks.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def text(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def test_directives_are_replaced_by_what_they_stand_for():
    made = hooks()
    words = made.rendered(text("words.md"))
    assert "<!--" not in words
    for kind in (Edge, Mode, Truncate, jaxlfi.Settings, jaxlfi.MixtureNetwork, jaxlfi.SplineFlow):
        for name, field in declared(kind).items():
            assert f"| `{name}` |" in words and field.info.help in words
    commands = made.rendered(text("command-line.md"))
    assert "<!--" not in commands and "--zone-fraction" in commands and "--simulations" in commands
    assert "## own_heuristic.py" in made.rendered(text("examples.md"))


def test_links_hold_in_the_site():
    made, studies = hooks(), ROOT / "experiments/studies"
    for source, link, expected in (
        (ROOT / "docs/paper.md", "[a](../experiments/studies/mg1.md#x)", "[a](studies/mg1.md#x)"),
        (ROOT / "docs/index.md", "![](../experiments/results/demo/samples.png)", "![](results/demo/samples.png)"),
        (ROOT / "docs/tutorials/arm.md", "[a](../mujoco.md) [b](../../examples/mujoco)", "[a](../mujoco.md) b"),
        (studies / "sota.md", "[a](../../docs/calibration.md) [b](mg1.md)", "[a](../calibration.md) [b](mg1.md)"),
        (
            studies / "mg1.md",
            "[a](../README.md#settings) [b](../results/mg1/table.md)",
            "[a](../experiments.md#settings) b",
        ),
        (ROOT / "experiments/README.md", "[a](studies/mg1.md) [b](results)", "[a](studies/mg1.md) b"),
        (
            ROOT / "docs/paper.md",
            "[a](https://example.org) [b](no-such.md)",
            "[a](https://example.org) [b](no-such.md)",
        ),
    ):
        assert made.linked(link, source) == expected
    assert made.site_name(studies) is None and made.site_name(ROOT / "experiments/results/demo") is None


def test_every_study_is_in_the_index():
    index = (ROOT / "experiments/README.md").read_text()
    for page in STUDIES[1:]:
        (row,) = [line for line in index.splitlines() if line.startswith(f"| [{page.read_text().splitlines()[0][2:]}]")]
        cells = row.strip("| ").split(" | ")
        assert f"](studies/{page.name})" in cells[0] and len(cells) == 5 and all(cells)


def test_every_page_is_in_the_menu():
    yaml = pytest.importorskip("yaml")
    menu = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    named = set(re.findall(r"'([\w/-]+\.md)'", str(menu)))
    assert named == {path.relative_to(ROOT / "docs").as_posix() for path in PAGES} | {"experiments.md"}


@pytest.mark.parametrize("page", [*PAGES, *STUDIES], ids=lambda path: path.stem)
def test_links_and_modules_exist(page):
    body = page.read_text()
    for target in re.findall(r"\]\(([^)#\s]+)", re.sub(r"`[^`]*`", "", body)):
        assert ":" in target or (page.parent / target).exists(), target
    for module in re.findall(r"^::: (\S+)$", body, re.MULTILINE):
        assert importlib.util.find_spec(module), module
    for reference in re.findall(r"\]\[(jaxlfi[\w.]+)\]", body):
        module, _, name = reference.rpartition(".")
        found = importlib.import_module(module)
        # A module of a package is an attribute of it only once it has been imported.
        named = hasattr(found, name) or (hasattr(found, "__path__") and importlib.util.find_spec(reference))
        assert named, reference
    for snippet in re.findall(r'^--8<-- "([^"]+)"$', body, re.MULTILINE):
        assert (ROOT / snippet).exists()


@pytest.mark.parametrize("page", [*PAGES, *STUDIES], ids=lambda path: path.stem)
def test_rows_of_a_table_have_as_many_cells_as_its_heading(page):
    prose = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"`[^`\n]*`|\\\|", "", prose)
    for table in re.findall(r"(?:^\|.*\n)+", prose + "\n", re.MULTILINE):
        assert len({row.count("|") for row in table.splitlines()}) == 1, table


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_python_in_pages_is_python_and_names_what_exists(page):
    for body in re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
        if "--8<--" in body:
            continue
        for node in ast.walk(ast.parse(body)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "jaxlfi":
                assert hasattr(jaxlfi, node.attr), node.attr


def keys_of_return(function) -> set[str]:
    """The literal keys of the dictionary that a function returns."""
    import inspect

    tree = ast.parse(inspect.getsource(function))
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Dict)]
    return {key.value for key in found[0].keys if isinstance(key, ast.Constant)}


def described(section: str) -> set[str]:
    """Names in the first column of a section's table of the page on run folders."""
    (body,) = re.findall(rf"^## {re.escape(section)}\n(.*?)(?=^## |\Z)", text("run-folders.md"), re.M | re.S)
    rows = [line.split("|")[1] for line in body.splitlines() if line.startswith("| `")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


def test_every_array_of_a_round_is_described():
    assert keys_of_return(record) <= described("history.npz") | {"final_trajectory", "final_x"}
    assert {"failed", "support_low", "support_high", "proposal_low", "proposal_high"} <= described("ledger.jsonl")
    assert keys_of_return(ledger_line) <= described("ledger.jsonl")


def test_every_key_of_a_configuration_is_described():
    assert keys_of_return(folder.run_config) | keys_of_return(provenance.environment) <= described("config.json")


def test_every_array_of_a_written_run_is_described():
    import inspect

    source = ast.parse(inspect.getsource(folder.write_run))
    dictionaries = [node for node in ast.walk(source) if isinstance(node, ast.Dict)]
    names = {key.value for node in dictionaries for key in node.keys if isinstance(key, ast.Constant)}
    parts = ("posterior.npz", "dataset.npz", "history.npz", "observation.npz")
    assert names <= set().union(*(described(part) for part in parts))
    assert {"theta", "x", "round", "weight"} <= described("dataset.npz")


def test_every_public_name_is_in_the_index():
    index = text("api/index.md")
    exceptions = {"SimulatorError", "SupportWarning", "MisspecificationWarning"}
    missing = [name for name in jaxlfi.__all__ if name not in exceptions and not re.search(rf"\b{name}`", index)]
    assert missing == []


def test_settings_of_the_pages_are_fields():
    fields = {field.name for field in dataclasses.fields(jaxlfi.Settings)} | set(declared(jaxlfi.MixtureNetwork))
    for name in re.findall(r"`Settings\.(\w+)", "".join(page.read_text() for page in PAGES)):
        assert name in fields


def test_contributing_names_files_that_exist():
    for name in re.findall(
        r"(?<![\w/])((?:tests|experiments|examples|docs)/[\w./]*\w)", (ROOT / "CONTRIBUTING.md").read_text()
    ):
        assert (ROOT / name).exists() or "NAME" in name, name


@pytest.mark.parametrize(
    ("page", "start"),
    [("calibration.md", "import numpy"), ("quickstart.md", "import numpy"), ("recordings.md", "import numpy")],
)
def test_short_blocks_of_pages_run(page, start, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```$", text(page), re.MULTILINE | re.DOTALL)
    (body,) = [block for block in blocks if block.startswith(start)]
    exec(compile(body, page, "exec"), {})
    assert capsys.readouterr().out or (tmp_path / "pairs.png").exists()
