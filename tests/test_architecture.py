"""What may import what, what no module does, and that public things are documented by examples that run."""

import ast
import doctest
import importlib
import pathlib
import subprocess
import sys

import pytest

import jaxlfi

ROOT = pathlib.Path(jaxlfi.__file__).parents[1]
PACKAGES = ("jaxlfi", "envs", "experiments")
FORBIDDEN = {
    "jaxlfi": {"jaxlfi.envs", "envs", "experiments", "tests"},
    "envs": {"envs", "experiments", "tests"},
    "experiments": {"envs"},
}
"""Strictly downward: experiments -> envs -> jaxlfi; the folder envs/ is the package jaxlfi.envs, and nothing else."""
NETWORKS = {
    f"jaxlfi.{name}" for name in "mdn estimator fitting losses normalise posterior npe bayessim correction".split()
}


def files(*packages: str) -> list[pathlib.Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def name_of(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = ("jaxlfi", *parts) if parts[0] == "envs" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def tree_of(path: pathlib.Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def imported(path: pathlib.Path) -> set[str]:
    """Full names of all that a file imports, anywhere in it: modules, and names from modules."""
    names = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            package = name_of(path).split(".") if path.name == "__init__.py" else name_of(path).split(".")[:-1]
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def identify(path: pathlib.Path) -> str:
    return str(path.relative_to(ROOT))


everywhere = pytest.mark.parametrize("path", files(*PACKAGES), ids=identify)


def test_there_is_something_to_check():
    assert {name_of(path) for path in files(*PACKAGES)} > {
        "jaxlfi",
        "jaxlfi.bayessim.algorithm",
        "jaxlfi.heuristics.edge",
        "jaxlfi.envs.lynx_hare",
    }
    assert "jaxlfi.distributions.support.Support" in imported(ROOT / "jaxlfi/distributions/belief.py")


@everywhere
def test_imports_go_downwards(path):
    package = path.relative_to(ROOT).parts[0]
    upwards = {name for name in imported(path) for above in FORBIDDEN[package] if within(name, above)}
    assert not upwards


@pytest.mark.parametrize("path", files("jaxlfi/heuristics"), ids=identify)
def test_heuristics_see_beliefs_and_no_network(path):
    assert not {name for name in imported(path) for network in NETWORKS if within(name, network)}
    assert not {name for name in imported(path) if within(name, "flax.linen") or within(name, "optax")}


FIGURES_READ = ("jaxlfi.figures",)
"""What of jaxlfi figures may import: one another. They read config.json and .npz files themselves, with NumPy."""


@pytest.mark.parametrize("path", files("jaxlfi/figures"), ids=identify)
def test_figures_know_no_task(path):
    """A figure is a function of saved arrays: no task, simulator or network, and no JAX to bring one in."""
    own = {name for name in imported(path) if within(name, "jaxlfi")} - {"jaxlfi"}
    assert not {name for name in own if not any(within(name, module) for module in FIGURES_READ)}
    assert not {name for name in imported(path) for library in ("jax", "flax", "envs") if within(name, library)}


@everywhere
def test_who_may_import_which_library(path):
    """Plots are drawn by modules called figures, physics is jaxlfi.envs.whip's; experiments may do both."""
    allowed = {
        "matplotlib": ("jaxlfi.figures", "jaxlfi.envs.whip.figures", "experiments"),
        "mujoco": ("jaxlfi.envs.whip", "experiments"),
        "gymnasium": ("jaxlfi.envs.whip",),
    }
    forbidden = dict.fromkeys(("brax", "pickle", "cloudpickle", "dill", "joblib"), ())
    for library, packages in (allowed | forbidden).items():
        if not any(within(name_of(path), package) for package in packages):
            assert not {name for name in imported(path) if within(name, library)}, library


@everywhere
def test_nothing_is_unpickled(path):
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert isinstance(node.value, ast.Constant) and node.value.value is False, f"line {node.value.lineno}"


@pytest.mark.parametrize("path", [*files(*PACKAGES), *files("tests")], ids=identify)
def test_keys_are_typed(path):
    old = [
        node.lineno
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Attribute | ast.Name) and getattr(node, "attr", getattr(node, "id", "")) == "PRNGKey"
    ]
    assert not old


def undocumented(node: ast.AST, prefix: str) -> list[str]:
    """Public functions, classes and methods without a docstring."""
    found = []
    for child in getattr(node, "body", []):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        if child.name.startswith("_"):
            continue
        if ast.get_docstring(child) is None:
            found.append(f"{prefix}.{child.name}")
        if isinstance(child, ast.ClassDef):
            found += undocumented(child, f"{prefix}.{child.name}")
    return found


@pytest.mark.parametrize("path", files("jaxlfi", "envs"), ids=identify)
def test_everything_public_is_documented(path):
    tree = tree_of(path)
    assert ast.get_docstring(tree), "module"
    assert not undocumented(tree, name_of(path))


def with_examples() -> list[pathlib.Path]:
    return [path for path in files("jaxlfi", "envs") if ">>> " in path.read_text()]


@pytest.mark.parametrize("path", with_examples(), ids=identify)
def test_examples_run(path):
    results = doctest.testmod(importlib.import_module(name_of(path)), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert results.failed == 0


def test_examples_are_found():
    """A parser that found none would pass the test above."""
    finder = doctest.DocTestFinder()
    examples = {
        name_of(path): sum(len(test.examples) for test in finder.find(importlib.import_module(name_of(path))))
        for path in with_examples()
    }
    assert min(examples.values()) >= 1 and examples["jaxlfi.distributions.support"] >= 2


def test_the_library_runs_without_matplotlib():
    """Importing jaxlfi loads next to nothing; infer brings JAX but no plots."""
    script = (
        "import sys, jaxlfi; assert 'jax' not in sys.modules, 'jax'; jaxlfi.infer; jaxlfi.Edge; "
        "assert 'jax' in sys.modules; assert 'matplotlib' not in sys.modules, 'matplotlib'; "
        "assert not any(name.startswith('jaxlfi.envs') for name in sys.modules), 'envs'"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_public_names_are_what_they_are_called():
    for name in jaxlfi.__all__:
        value = getattr(jaxlfi, name)
        assert getattr(value, "__name__", name) == name
    assert set(jaxlfi.__all__) <= set(dir(jaxlfi))
    with pytest.raises(AttributeError, match="module 'jaxlfi' has no attribute 'Edgy'"):
        _ = jaxlfi.Edgy
