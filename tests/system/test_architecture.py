"""What may import what, what no module does, and that public things are documented by examples that run."""

import ast
import doctest
import functools
import graphlib
import importlib
import pathlib
import subprocess
import sys
from collections.abc import Callable

import pytest

import jaxlfi

ROOT = pathlib.Path(jaxlfi.__file__).parents[1]
PACKAGES = ("jaxlfi", "envs", "experiments")
ENVS = "jaxlfi.envs"
"""What the folder envs/ is imported as."""
FORBIDDEN = {
    "jaxlfi": {ENVS, "envs", "experiments", "tests"},
    "envs": {"envs", "experiments", "tests"},
    "experiments": {"envs"},
}
"""Strictly downward: experiments -> envs -> jaxlfi; the folder envs/ is the package jaxlfi.envs, and nothing else."""
LAYERS = (
    ("distributions",),
    ("tasks",),
    ("heuristics", "estimators", "diagnostics"),
    ("bayessim", "design"),
    ("runs",),
    ("studies", "rl"),
    ("robots",),
    ("cli",),
)
"""Packages of jaxlfi, from the ground up: each imports those below it, and none beside or above it."""
LEAVES = ("io", "fields", "flags", "references", "registry")
"""Modules that every layer may import, and that import no layer."""
BESIDE = {"figures": {"figures", "io"}, "plot": {"figures"}, "__main__": {"cli"}}
"""Modules that are no part of the layers, and all of jaxlfi that they import."""
NETWORKS = ("jaxlfi.estimators", "jaxlfi.bayessim", "flax.linen", "optax")


def files(*packages: str) -> list[pathlib.Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def name_of(path: pathlib.Path) -> str:
    first, *rest = path.relative_to(ROOT).with_suffix("").parts
    parts = [ENVS if first == "envs" else first, *rest]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def tree_of(path: pathlib.Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


@functools.cache
def imported(path: pathlib.Path) -> frozenset[str]:
    """Full names of all that a file imports, anywhere in it: modules, and names from modules."""
    return frozenset(imported_by(tree_of(path), path))


def imported_by(tree: ast.AST, path: pathlib.Path) -> set[str]:
    """The same of a part of a file."""
    names = set()
    for node in ast.walk(tree):
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


def of_each(paths: list[pathlib.Path]) -> Callable:
    """Make a check of one file a test of many, which names those that fail: thousands of tests would take longer."""

    def decorate(check: Callable[[pathlib.Path], None]) -> Callable[[], None]:
        def test():
            wrong = {}
            for path in paths:
                try:
                    check(path)
                except AssertionError as error:
                    wrong[identify(path)] = str(error)
            assert paths and not wrong

        test.__name__, test.__doc__ = check.__name__, check.__doc__
        return test

    return decorate


everywhere = of_each(files(*PACKAGES))


def test_there_is_something_to_check():
    assert {name_of(path) for path in files(*PACKAGES)} > {
        "jaxlfi",
        "jaxlfi.bayessim.algorithm",
        "jaxlfi.heuristics.edge",
        f"{ENVS}.lynx_hare",
    }
    assert "jaxlfi.distributions.support.Support" in imported(ROOT / "jaxlfi/distributions/belief.py")


@everywhere
def test_imports_go_downwards(path):
    package = path.relative_to(ROOT).parts[0]
    upwards = {name for name in imported(path) for above in FORBIDDEN[package] if within(name, above)}
    assert not upwards


def part(name: str) -> str:
    """The layer, leaf or other part of jaxlfi that a full name belongs to; "" for jaxlfi itself."""
    return name.split(".")[1] if "." in name else ""


def height(name: str) -> int | None:
    """The layer's place from the ground up; None for what is no layer."""
    return next((place for place, layer in enumerate(LAYERS) if part(name) in layer), None)


def parts_used(path: pathlib.Path) -> dict[str, str]:
    """The parts of jaxlfi that a file imports from, other than its own, with a name of each."""
    names = {name for name in imported(path) if within(name, "jaxlfi") and part(name)}
    # "from jaxlfi import diagnostics" and "from jaxlfi.diagnostics import c2st" alike; public names have homes.
    homes = {name: jaxlfi._HOMES.get(part(name), name) for name in names}
    return {part(home): name for name, home in homes.items() if part(home) != part(name_of(path))}


def test_every_part_of_the_library_has_its_place():
    parts = {part(name_of(path)) for path in files("jaxlfi")} - {""}
    assert parts == {*(name for layer in LAYERS for name in layer), *LEAVES, *BESIDE}


@of_each(files("jaxlfi"))
def test_layers_import_what_is_below_them(path):
    used, own = parts_used(path), part(name_of(path))
    if own in LEAVES:
        assert set(used) <= set(LEAVES)
    elif own in BESIDE:
        assert set(used) <= BESIDE[own]
    elif own:
        place = height(name_of(path))
        below = {name for layer in LAYERS[:place] for name in layer}
        assert set(used) <= {*LEAVES, *below, *(["figures"] if own == "cli" else [])}
    else:
        assert not used  # the package itself loads public names when they are asked for


def test_layers_that_would_be_wrong_are_seen(tmp_path):
    """The test above reads every way to import."""
    for text, expected in (
        ("import jaxlfi.runs.load", {"runs"}),
        ("from jaxlfi import studies", {"studies"}),
        ("from jaxlfi.cli import parser as p", {"cli"}),
        ("from jaxlfi import Run", {"runs"}),
        ("def f():\n    from jaxlfi.bayessim import batch", {"bayessim"}),
        ("from ..estimators import base", {"estimators"}),
    ):
        path = ROOT / "jaxlfi" / "tasks" / "nothing.py"
        names = imported_by(ast.parse(text), path)
        homes = {jaxlfi._HOMES.get(part(name), name) for name in names if part(name)}
        assert {part(home) for home in homes} == expected, text


def at_import(tree: ast.AST) -> list[ast.AST]:
    """The statements that import something while a module is imported, and not when a function is called."""
    found = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.append(node)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            found += [each for other in node.orelse for each in at_import(other)]
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            found += at_import(node)
    return found


def test_modules_do_not_import_one_another_in_a_circle():
    """Neither while they are loaded nor later, in a function."""
    modules = {name_of(path): path for path in files(*PACKAGES)}
    graph = {
        # A package's names come from its modules, which do not need those names.
        name: imported(path) & modules.keys() - {name} if path.name != "__init__.py" else set()
        for name, path in modules.items()
    }
    graphlib.TopologicalSorter(graph).prepare()


@of_each(files("jaxlfi/heuristics"))
def test_heuristics_see_beliefs_and_no_network(path):
    assert not {name for name in imported(path) for network in NETWORKS if within(name, network)}


@of_each(files("jaxlfi/figures"))
def test_figures_know_no_task(path):
    """A figure is a function of saved arrays: no task, simulator or network, and no JAX to bring one in."""
    plain = ("jaxlfi.figures", "jaxlfi.io.files", "jaxlfi.io.shell", "jaxlfi.io.run_summary", "jaxlfi.io.web_page")
    own = {name for name in imported(path) if within(name, "jaxlfi")} - {"jaxlfi", "jaxlfi.io"}
    assert not {name for name in own if not any(within(name, package) for package in plain)}
    assert not {name for name in imported(path) for library in ("jax", "flax", ENVS) if within(name, library)}


ON_ROBOTS = {
    *("jaxlfi.robots", "jaxlfi.rl.policy", "jaxlfi.rl.deployment", "jaxlfi.rl.preparation", "jaxlfi.rl.termination"),
    "jaxlfi.registry",
    *("jaxlfi.io.files", "jaxlfi.io.lerobot", "jaxlfi.io.mcap", "jaxlfi.io.rollout", "jaxlfi.io.serialise"),
    *("jaxlfi.io.units", "numpy"),
}
"""Modules of ours and others that a robot's computer needs, besides Python's own."""


@of_each(files("jaxlfi/robots"))
def test_robots_need_numpy_and_no_jax(path):
    """What they import imports no more at run time: tests/robots run where there is no JAX."""
    modules = {name for node in at_import(tree_of(path)) for name in imported_by(node, path)}
    others = {name for name in modules if name.split(".")[0] not in sys.stdlib_module_names} - {
        "jaxlfi.rl",
        "jaxlfi.io",
    }
    assert not {name for name in others if not any(within(name, known) for known in ON_ROBOTS)}


ASKED = {
    "closed_form": {
        "jaxlfi.estimators.base": "declares it: a mixture of Gaussians needs no fit, and no key to be read off",
        "jaxlfi.estimators.mixture_network": "is one",
        "jaxlfi.bayessim.settings": "refuses the paper's correction, a quotient of Gaussians, for other densities",
        "jaxlfi.bayessim.presets": "leaves such a correction out of a preset whose estimator is replaced",
        "jaxlfi.bayessim.batch": "spends more time on compiling what computes with other densities",
        "jaxlfi.runs.folder": "a folder keeps the networks that its posterior cannot do without",
        "jaxlfi.runs.load": "and reads them",
        "jaxlfi.runs.execute": "a mixture of Gaussians can be polished, and no other density",
    },
    "is_likelihood": {
        "jaxlfi.estimators.base": "declares it: the density is that of the summary, and its network has the prior",
        "jaxlfi.estimators.likelihood": "is one",
        "jaxlfi.bayessim.settings": "refuses corrections, which a likelihood does not need",
        "jaxlfi.bayessim.widths": "says that its widths do not hang on the proposals",
        "jaxlfi.runs.load": "needs the prior, which is not saved",
    },
    "on_host": {
        "jaxlfi.tasks.task": "declares it",
        "jaxlfi.tasks.experiments": "gives a simulator another design, inside of what calls it",
        "jaxlfi.design.simulations": "calls it for one design after another",
        "jaxlfi.design.choosing": "judges safety by fewer simulations outside JAX",
        "jaxlfi.design.fisher": "differentiates a response outside JAX by differences",
        "jaxlfi.design.contrastive": "knows the likelihood of a response in JAX",
        "jaxlfi.design.recommendation": "asks slower simulators for less",
        "jaxlfi.tasks.executors": "refuses one that JAX compiles",
        "jaxlfi.tasks.simulation": "calls a host simulator for many parameters at once",
        "jaxlfi.tasks.observation": "asks it for shapes, which JAX's simulators tell without being run",
        "jaxlfi.tasks.trials": "repeats it by one call for all trials",
        "jaxlfi.tasks.presimulated": "compares given trajectories with the shape that a simulator of JAX tells",
        "jaxlfi.bayessim.host": "chooses the engine",
        "jaxlfi.runs.infer": "cannot trace it",
        "jaxlfi.runs.run": "summarises other observations in double precision",
        "jaxlfi.studies.calibration.truths": "keeps its simulations in double precision",
        "jaxlfi.cli.commands": "lets it clean up after Ctrl-C",
        "jaxlfi.studies.calibration.plan": "asks for shapes",
    },
}
"""Modules that may ask how a density or a simulator is made, and why; all others treat them alike."""


@pytest.mark.parametrize("word", ASKED)
def test_who_asks_how_a_density_or_a_simulator_is_made(word):
    asking = {name_of(path) for path in files("jaxlfi") if word in words_of(path)}
    assert asking == set(ASKED[word])


@functools.cache
def words_of(path: pathlib.Path) -> set[str]:
    """All names in a file's code."""
    nodes = ast.walk(tree_of(path))
    return {word for node in nodes for word in (getattr(node, "attr", None), getattr(node, "id", None), name_in(node))}


def name_in(node: ast.AST) -> str | None:
    """The name a definition or a keyword gives."""
    return getattr(node, "name", None) or getattr(node, "arg", None)


@everywhere
def test_nobody_asks_for_black_boxes_or_flows(path):
    assert not words_of(path) & {"black_box", "is_flow", "blackbox"}


SPLITTING = {"jaxlfi.bayessim.keys", "jaxlfi.bayessim.algorithm"}
"""Where keys are split: by purpose, and for the three draws that one batch of proposals is made of."""


@of_each(files("jaxlfi/bayessim", "jaxlfi/runs", "jaxlfi/cli", "jaxlfi/studies/grid"))
def test_the_keys_of_a_run_are_split_in_one_module(path):
    nodes = ast.walk(tree_of(path))
    calls = [node.lineno for node in nodes if isinstance(node, ast.Attribute) and node.attr in ("split", "fold_in")
             and isinstance(node.value, ast.Attribute) and node.value.attr == "random"]  # fmt: skip
    assert not calls or name_of(path) in SPLITTING


@everywhere
def test_who_may_import_which_library(path):
    """Plots are drawn by modules called figures, physics is MuJoCo's, policies are Brax's; experiments may do all."""
    allowed = {
        "matplotlib": ("jaxlfi.figures", f"{ENVS}.whip.figures", f"{ENVS}.mujoco.figures", "experiments"),
        "mujoco": (f"{ENVS}.whip", f"{ENVS}.mujoco", f"{ENVS}.opengl", "experiments"),
        "gymnasium": ("jaxlfi.rl.gym", "experiments"),
        "stable_baselines3": ("experiments",),
        "brax": ("jaxlfi.rl",),
        "onnx": ("jaxlfi.rl", f"{ENVS}.whip.vision.export"),
        "tensorboardX": ("jaxlfi.rl.tensorboard",),
        "pyarrow": ("jaxlfi.io.lerobot",),
        "mcap": ("jaxlfi.io.mcap",),
        "distributed": ("jaxlfi.tasks.executors",),
        "cloudpickle": ("jaxlfi.tasks.host", "jaxlfi.tasks.worker"),  # from a run to the processes that it starts
    }
    forbidden = dict.fromkeys(("pickle", "dill", "joblib"), ())
    for library, packages in (allowed | forbidden).items():
        if not any(within(name_of(path), package) for package in packages):
            assert not {name for name in imported(path) if within(name, library)}, library


@everywhere
def test_what_prints_as_it_is_imported_is_imported_unprinted(path):
    """Otherwise each command that needs MJX or Brax begins by saying that it could not import Warp."""
    quiet = {
        inner
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.With) and "quiet_imports()" in {ast.unparse(item.context_expr) for item in node.items}
        for inner in ast.walk(node)
    }
    for node in set(ast.walk(tree_of(path))) - quiet:
        if isinstance(node, ast.Import | ast.ImportFrom):
            printing = {name for name in imported_by(node, path) if within(name, "brax") or within(name, "mujoco.mjx")}
            assert not printing, f"line {node.lineno}"


@everywhere
def test_nothing_is_unpickled(path):
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert isinstance(node.value, ast.Constant) and node.value.value is False, f"line {node.value.lineno}"


@of_each(files(*PACKAGES, "tests"))
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


@of_each(files("jaxlfi", "envs"))
def test_everything_public_is_documented(path):
    tree = tree_of(path)
    assert ast.get_docstring(tree), "module"
    assert not undocumented(tree, name_of(path))


def with_examples() -> list[pathlib.Path]:
    return [path for path in files("jaxlfi", "envs") if ">>> " in path.read_text()]


LONG = (
    "jaxlfi/rl/from_brax.py", "envs/whip/episode.py", "envs/whip/gym.py", "jaxlfi/estimators/posterior.py",
    "jaxlfi/distributions/truncated_mixture.py",
)  # fmt: skip
"""Modules whose examples compile for three seconds and more what whole files of tests are of."""


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] * (identify(path) in LONG)) for path in with_examples()],
    ids=identify,
)
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


def test_nothing_is_loaded_that_is_not_needed():
    """Importing jaxlfi loads next to nothing; infer brings JAX but no plots, nor what takes long by itself."""
    script = (
        "import sys, jaxlfi; assert 'jax' not in sys.modules, 'jax'; jaxlfi.infer; jaxlfi.Edge; "
        "import jaxlfi.cli.commands; "
        "assert 'jax' in sys.modules; assert 'matplotlib' not in sys.modules, 'matplotlib'; "
        "assert not {'distrax', 'tensorflow_probability', 'scipy.stats'} & set(sys.modules), 'slow'; "
        f"assert not any((name + '.').startswith('{ENVS}.') for name in sys.modules), 'envs'"
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
