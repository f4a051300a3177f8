"""Shared by all tests: strict JAX, fast compilation, bounded memory, deterministic hypothesis, one key per test."""

import ctypes
import functools
import gc
import os
import signal
import sys
import zlib
from pathlib import Path

# With PYTHONDONTWRITEBYTECODE set, every worker and every process started by a test would spend seconds on compiling
# the Python modules that it imports. They share a bytecode cache instead, which is kept for the next run, as usual.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path.home() / ".cache/jaxlfi/bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

import hypothesis
import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

# Tests and the processes they start run programs for milliseconds that take seconds to compile. Half of it goes into
# the newer fusions of XLA, which later versions cannot do without, and a tenth of the rest into splitting the code.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
os.environ.setdefault("XLA_FLAGS", "")
jax.config.update("jax_disable_most_optimizations", True)  # also for what modules compute on import
# The source locations of operations take a twentieth of tracing and lowering, and no test reads them.
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
jax.config.update("jax_traceback_in_locations_limit", 0)
if jax.__version_info__ < (0, 10):
    os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

# Tracing allocates millions of objects: by default Python would look for cycles among them a thousand times per file.
gc.set_threshold(50_000, 20, 50)

# A background job of a shell ignores SIGINT, and so would its child processes, which tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A key consumed twice is an error, in the library and in the packages that it calls.
jax.config.update("jax_debug_key_reuse", True)
# jax_numpy_rank_promotion stays "allow": mixtures broadcast [D] against [K, D] throughout, by NumPy's rules.

hypothesis.settings.register_profile(
    "jaxlfi",
    derandomize=True,
    deadline=None,
    max_examples=25,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("jaxlfi")

MEMORY = min(max(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 5, 1600 * 2**20), 4600 * 2**20)
"""Memory in bytes beyond which a process drops, between two files, the programs it compiled, which take most of it.

It is a fifth of the machine's, within limits, as dropped programs have to be traced and read again.
"""

MAX_MEMORY = MEMORY + 100 * 2**20
"""Memory in bytes beyond which it does so between two tests of one file, which mostly use the same programs."""


LONG = (
    "test_estimators", "test_infer", "test_fitting", "test_formats", "test_architecture", "test_heuristics",
    "test_jump_process", "test_algorithm", "test_posterior_statistics", "test_priors", "test_cli",
    "test_environment", "test_executors", "test_flows", "test_accelerators", "test_figures", "test_lowered",
    "test_truncated_mixture", "test_every_command", "test_posterior", "test_oracles", "test_recommendation",
    "test_staged", "test_training", "test_resume", "test_heuristics_contract", "test_mg1", "test_mixture_algebra",
    "test_regression",
)  # fmt: skip
"""Test files that take twenty seconds of CPU time or more, in the order in which they begin: the longest first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with long files, so that no worker is left alone with one at the end."""
    place = {name: number for number, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONG)))


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A typed key for one test: the same in every run and folder, different in every test."""
    test = request.node.nodeid.partition("::")[2]
    return jax.random.key(zlib.crc32(f"tests/{request.path.name}::{test}".encode()))


@pytest.fixture(autouse=True, scope="session")
def compiled_once(tmp_path_factory: pytest.TempPathFactory):
    """A cache of compiled programs, shared by the workers and the processes of tests, which mostly compile."""
    base = tmp_path_factory.getbasetemp()
    folder = str((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "xla")
    for name, value in (("jax_compilation_cache_dir", folder), ("jax_persistent_cache_min_compile_time_secs", 0)):
        os.environ[name.upper()] = str(value)
        jax.config.update(name, value)
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # processes do not report programs that they find compiled
    compilation_cache.reset_cache()  # so that the folder is used


@pytest.fixture(autouse=True, scope="module")
def own_devices():
    """Restore the variables with which commands set the number of devices: later files start processes, too."""
    kept = {name: os.environ.get(name) for name in ("XLA_FLAGS", "NPROC")}
    yield
    for name, value in kept.items():
        os.environ.pop(name, None)
        os.environ.update({} if value is None else {name: value})


@pytest.fixture(autouse=True, scope="module")
def compiling(request: pytest.FixtureRequest):
    """Compile without most optimisations, except in modules that set `OPTIMISED`; drop programs once they are many."""
    jax.config.update("jax_disable_most_optimizations", not getattr(request.module, "OPTIMISED", False))
    yield
    if resident() > MEMORY:
        forget()


@pytest.fixture(autouse=True)
def forgetting():
    """Drop programs within a file whose tests keep compiling new ones."""
    yield
    if resident() > MAX_MEMORY:
        forget()


@pytest.fixture(autouse=True, scope="session")
def kept_programs():
    """Keep the programs of all runs, not only the last few: files mostly use the same ones, and memory is bounded."""
    from jaxlfi.bayessim import programs  # late, as in `forget`
    from jaxlfi.io import executables

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executables, "KEPT", 10_000)
        patch.setattr(programs, "_program", functools.lru_cache(maxsize=None)(programs._program.__wrapped__))
        yield


def forget() -> None:
    """Drop every compiled program, and return the memory to the system."""
    from jaxlfi.bayessim import programs  # late, so that shapes are checked from its first import on

    programs.forget()
    jax.clear_caches()
    gc.collect()
    getattr(ctypes.CDLL(None), "malloc_trim", int)(0)  # glibc keeps what is freed between blocks still in use


def resident() -> int:
    """Bytes of memory that this process occupies; 0 if the system does not say."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if pages.exists() else 0
