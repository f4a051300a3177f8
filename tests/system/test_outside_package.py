"""A package of four files adds a heuristic, an estimator, a task and a command; ours take them, and none knows them.

It is installed into an environment of its own, as pip would install a wheel of it: the files, and a dist-info folder
with the entry points of its pyproject.toml. (The environment borrows the packages of the running one by a .pth file, so
that nothing is downloaded and nothing needs to be built.)
"""

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import textwrap
import time
import tomllib
import venv
from pathlib import Path

import numpy as np
import pytest

import jaxlfi

pytestmark = pytest.mark.slow

CHECKOUT = Path(jaxlfi.__file__).parents[1]

PYPROJECT = """
    [project]
    name = "outside"
    version = "1.0"
    dependencies = ["jaxlfi"]

    [project.entry-points."jaxlfi.heuristics"]
    widen = "outside.rule:Widen"

    [project.entry-points."jaxlfi.estimators"]
    independent = "outside.network:IndependentNetwork"

    [project.entry-points."jaxlfi.tasks"]
    line = "outside.problem:task"

    [project.entry-points."jaxlfi.commands"]
    slope = "outside.tool:slope"
"""
RULE = '''
    """A support that widens wherever the posterior's mean is near a bound."""

    from jaxlfi.fields import hyperparameter
    from jaxlfi.heuristics import Heuristic, adapted, stretch


    class Widen(Heuristic):
        """Both bounds move away from the posterior's mean where it is near."""

        gain: float = hyperparameter(default=0.5, help="how far a bound moves", symbol="kappa", low=0, high=2)
        margin: float = hyperparameter(default=0.4, help="how near the mean has to be", low=0, high=1)

        def __call__(self, previous, posterior, feasible):
            box = previous.support
            place = (posterior.weights @ posterior.means - box.low) / box.width
            support = stretch(box, feasible, place < self.margin, place > 1 - self.margin, self.gain)
            return adapted(previous, posterior, support, {"place": place})
'''
NETWORK = '''
    """A Gaussian of independent parameters, by a network of one hidden layer."""

    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    from flax import struct

    from jaxlfi.estimators.base import Estimator
    from jaxlfi.fields import option


    @struct.dataclass
    class Independent:
        """Independent normal parameters."""

        mean: jax.Array
        log_scale: jax.Array

        def log_prob(self, theta):
            """Log-density at theta."""
            z = (theta - self.mean) / jnp.exp(self.log_scale)
            return jnp.sum(-0.5 * z**2 - self.log_scale - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

        def sample(self, key, n):
            """n draws."""
            return self.mean + jnp.exp(self.log_scale) * jax.random.normal(key, (n, *self.mean.shape))


    class Layers(nn.Module):
        """A network from a summary to the density."""

        dim: int
        units: int

        @nn.compact
        def __call__(self, x):
            hidden = nn.tanh(nn.Dense(self.units)(x))
            return Independent(nn.Dense(self.dim)(hidden), nn.Dense(self.dim)(hidden))


    class IndependentNetwork(Estimator):
        """Settings: those that all estimators have, and one."""

        units: int = option(default=16, low=1, help="units of the hidden layer")

        def module(self, dim):
            """The network."""
            return Layers(dim, self.units)
'''
PROBLEM = '''
    """A line, seen at four places through noise."""

    import jax
    import jax.numpy as jnp

    from jaxlfi import Support, Task


    def task(noise: float = 0.1, points: int = 4):
        """A line of an offset and a positive slope."""

        def simulate(key, theta):
            at = jnp.linspace(0.0, 1.0, points)
            return theta[0] + theta[1] * at + noise * jax.random.normal(key, (points,))

        return Task(
            simulate,
            name=f"line seen at {points} places",
            names=("offset", "slope"),
            supports={"tight": Support([-1.0, 0.1], [0.0, 1.0]), "wide": Support([-2.0, 0.1], [2.0, 4.0])},
            feasible=Support([-4.0, 0.01], [4.0, 10.0]),
            truth=[0.5, 0.7],
            log=("slope",),
        )
'''
TOOL = '''
    """What a run says of the line's slope."""

    from pathlib import Path

    from jaxlfi.cli.command import Command


    def arguments(parser):
        """Its only argument."""
        parser.add_argument("folder", type=Path, metavar="DIR", help="the folder of a run")


    def run(arguments):
        """Print the mean."""
        import jaxlfi

        print("slope", float(jaxlfi.load(arguments.folder).draws()[:, 1].mean()))


    slope = Command("slope", "say how steep a line is", arguments, run, epilog="It reads a folder.")
'''
SESSION = """
    import contextlib, io, json, sys

    channel, sys.stdout = sys.stdout, sys.stderr  # what is printed by the way
    for line in sys.stdin:
        output, errors = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            try:
                exec(json.loads(line), {})
                status = 0
            except SystemExit as stop:
                status = stop.code
        print(json.dumps([status, output.getvalue(), errors.getvalue()]), file=channel, flush=True)
"""
"""A process that executes one script after another, and so compiles what they share once."""
TINY = (
    "--estimator independent --units 4 --learning-rate 1e-2 --steps 40 --batch-size 20 --validation 0 --patience 0 "
    "--ensemble-size 1 --components 2 --min-rounds 0 --simulations-per-round 20 --simulation-budget 25 --no-figures"
).split()


def write_package(folder: Path) -> None:
    """The four files and pyproject.toml, as its author has them."""
    (folder / "outside").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(textwrap.dedent(PYPROJECT))
    for name, text in {"rule": RULE, "network": NETWORK, "problem": PROBLEM, "tool": TOOL}.items():
        (folder / "outside" / f"{name}.py").write_text(textwrap.dedent(text).lstrip())


def install(package: Path, site: Path) -> None:
    """What installing a wheel of the package leaves in site-packages."""
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    shutil.copytree(package / project["name"], site / project["name"])
    information = site / f"{project['name']}-{project['version']}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (information / "entry_points.txt").write_text("\n".join(points))


class Environment:
    """A fresh environment with the package in it, and a folder to work in."""

    def __init__(self, folder: Path, cache: Path):
        venv.create(folder / "venv", symlinks=True)
        self.python, self.work = folder / "venv" / "bin" / "python", folder / "work"
        self.work.mkdir()
        site = next((folder / "venv").glob("lib/python*/site-packages"))
        borrowed = dict.fromkeys(sysconfig.get_paths()[name] for name in ("purelib", "platlib"))
        lines = [str(CHECKOUT), *(f"import site; site.addsitedir({path!r})" for path in borrowed)]
        (site / "borrowed.pth").write_text("\n".join(lines) + "\n")
        write_package(folder / "source")
        install(folder / "source", site)
        own = {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
            "TF_CPP_MIN_LOG_LEVEL": "3",
            "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=1",
        }
        self.variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | own

    def start(self, *words, **streams) -> subprocess.Popen:
        """A command of its own, in the working folder."""
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
        return subprocess.Popen(
            [str(self.python), *map(str, words)],
            cwd=self.work,
            env=self.variables,
            text=True,
            **streams,
        )

    def run(self, *words) -> str:
        """What a command that has to succeed prints."""
        process = self.start(*words)
        output, errors = process.communicate(timeout=900)
        assert process.returncode == 0, errors
        return output

    @functools.cached_property
    def session(self) -> subprocess.Popen:
        """The process of scripts and of our command line, where they need none of their own."""
        with (self.work / "session.txt").open("w") as errors:
            return self.start("-c", textwrap.dedent(SESSION), stdin=subprocess.PIPE, stderr=errors)

    def script(self, text: str) -> str:
        """What a script that has to succeed prints."""
        self.session.stdin.write(json.dumps(textwrap.dedent(text)) + "\n")
        self.session.stdin.flush()
        answer = self.session.stdout.readline()
        assert answer, (self.work / "session.txt").read_text()
        status, output, errors = json.loads(answer)
        assert status == 0, errors
        return output

    def jaxlfi(self, *words) -> str:
        """The same of our command line."""
        words = list(map(str, words))
        return self.script(f"import sys; from jaxlfi.cli.parser import main; sys.exit(main({words!r}))")

    def close(self) -> None:
        """End the process of scripts."""
        self.session.communicate(timeout=60)
        assert self.session.returncode == 0, (self.work / "session.txt").read_text()


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """The environment that all commands of this file share."""
    shared = Environment(tmp_path_factory.mktemp("outside"), tmp_path_factory.mktemp("programs"))
    yield shared
    shared.close()


@pytest.fixture(scope="module")
def inferred(environment) -> str:
    """A run that was interrupted and resumed."""
    words = ["infer", "line,noise=0.2,points=3", "--support", "tight", "--heuristic", "widen", "--gain", "0.25", "0.75"]
    process = environment.start("-m", "jaxlfi", *words, *TINY, "--rounds", "40", "--out", "run")
    begun, deadline = environment.work / "run" / "checkpoint" / "state.npz", time.monotonic() + 900
    while not begun.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 130 and "jaxlfi resume run" in errors, errors
    assert not (environment.work / "run" / "posterior.npz").exists()
    environment.jaxlfi("resume", "run", "--no-figures")
    return "run"


@pytest.fixture(scope="module")
def compared(environment) -> str:
    """A comparison of its heuristic with none."""
    words = ["compare", "line", "--configurations", "tight", "tight+widen", "--seeds", "1", "--rounds", "2"]
    environment.jaxlfi(*words, *TINY, "--out", "comparison")
    return "comparison"


def config(environment: Environment, folder: str) -> dict:
    return json.loads((environment.work / folder / "config.json").read_text())


def test_the_package_is_found_in_its_environment_only(environment):
    script = "import outside.rule, jaxlfi; print(outside.rule.__file__); print(jaxlfi.__file__)"
    ours, library = environment.run("-c", script).splitlines()
    assert Path(ours).is_relative_to(environment.python.parents[1])
    assert Path(library).parents[1] == CHECKOUT
    assert subprocess.run([sys.executable, "-c", "import outside"], capture_output=True, check=False).returncode != 0


def test_help_lists_its_flags_where_it_is_named_and_does_not_import_it_before(environment):
    script = (
        "import atexit, sys; import jaxlfi.cli.parser as cli; "
        "atexit.register(lambda: print([name for name in ('jax', 'numpy', 'outside') if name in sys.modules])); "
        "cli.main(['infer', '--help'])"
    )
    output = " ".join(environment.run("-c", script).split())
    assert output.endswith("[]") and "truncate, widen, or your own" in output
    named = environment.run("-m", "jaxlfi", "infer", "--heuristic", "widen", "--estimator", "independent", "--help")
    output = " ".join(named.split())
    assert "--gain X [X ...] widen: how far a bound moves (kappa; [0, 2]; default: 0.5)" in output
    assert "--units N units of the hidden layer" in output
    assert "line" in environment.jaxlfi("tasks", "line,points=7")


def test_infer_is_interrupted_and_resumed(environment, inferred):
    described = config(environment, inferred)
    assert (described["status"], described["task"]) == ("finished", "line,noise=0.2,points=3")
    assert described["heuristic"]["name"] == "widen"
    assert described["heuristic"]["hyperparameters"]["gain"]["array"] == [0.25, 0.75]
    assert described["settings"]["estimator"]["name"] == "independent"
    lines = (environment.work / inferred / "ledger.jsonl").read_text().splitlines()
    assert [json.loads(line)["round"] for line in lines] == list(range(40))
    assert len(json.loads(lines[0])["evidence"]["place"]) == 2


def test_load_gives_the_run_back(environment, inferred):
    script = f"""
        import jax, jaxlfi, json, numpy as np
        run = jaxlfi.load({inferred!r})
        draws = np.asarray(run.draws())
        log_prob = np.asarray(run.posterior.log_prob(draws))
        estimator = run.settings.estimator
        print(json.dumps([type(run.heuristic).__name__, type(estimator).__name__, estimator.units, run.task.name,
                          len(run.x), bool(np.isfinite(log_prob).all()), draws.mean(0).tolist()]))
    """
    *described, mean = json.loads(environment.script(script))
    assert described == ["Widen", "IndependentNetwork", 4, "line seen at 3 places", 3, True]
    np.testing.assert_allclose(mean, [0.5, 0.7], atol=0.6)


def test_its_command_is_one_of_ours(environment, inferred):
    name, slope = environment.jaxlfi("slope", inferred).split()
    assert name == "slope" and 0.1 < float(slope) < 10
    assert "slope     commands of its own: jaxlfi slope --help" in environment.run("-m", "jaxlfi", "--help")
    assert "the folder of a run" in environment.run("-m", "jaxlfi", "slope", "--help")
    process = environment.start("-m", "jaxlfi", "slope", "nowhere")
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 2
    assert errors == "jaxlfi slope: error: expected a run folder, got 'nowhere', which is not a folder\n"


def test_compare_runs_it_beside_ours(environment, compared):
    folder = environment.work / compared
    rows = (folder / "table.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ["tight", "tight+widen"]
    high = [
        np.load(folder / name / "seed_000" / "history.npz")["support_high"][-1, 0] for name in ("tight", "tight+widen")
    ]
    assert high[0] == 0.0 < high[1]  # the truth, 0.5, lies beyond the tight support


def test_grid_varies_its_hyperparameters(environment):
    words = ["grid", "line", "--heuristic", "widen", "--vary", "gain=0.25,1", "--seeds", "1", "--rounds", "2"]
    environment.jaxlfi(*words, *TINY, "--support", "tight", "--out", "grid")
    arrays = np.load(environment.work / "grid" / "grid.npz")
    assert arrays["axes"].tolist() == ["gain"] and arrays["theta_error"].shape == (2, 1)
    assert arrays["support_high"][0, 0, 0] < arrays["support_high"][1, 0, 0]


def test_diagnose_repeats_its_runs(environment, compared):
    words = [
        f"{compared}/tight+widen/seed_000",
        "--truths",
        "20",
        "--draws",
        "20",
        "--no-figures",
        "--out",
        "diagnostics",
    ]
    script = """
        import importlib
        importlib.import_module("jaxlfi.diagnostics.c2st").MAX_EPOCHS = 20  # the classifier would take longest
    """
    environment.script(script)
    output = environment.jaxlfi("diagnose", *words)
    assert "rank of slope" in output
    arrays = np.load(environment.work / "diagnostics" / "diagnostics.npz")
    assert arrays["draws"].shape == (20, 20, 2) and np.isfinite(arrays["log_prob"]).all()
