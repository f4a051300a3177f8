"""What all tests share: strict JAX, quick compiling, one deterministic hypothesis profile, one key a test."""

import os
import zlib

import hypothesis
import jax
import pytest

# Tests, and the processes they start, run for milliseconds what would be compiled for seconds. Half of that goes into
# the newer fusions of XLA, which later versions cannot do without.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
os.environ.setdefault("XLA_FLAGS", "")
if jax.__version_info__ < (0, 10):
    os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"

# A key consumed twice is an error, in the library and in what it calls.
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


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A typed key of the test's own: the same in every run, another in every test."""
    return jax.random.key(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture(autouse=True, scope="module")
def compiling(request: pytest.FixtureRequest):
    """Compile without most optimisations, but for modules that set `OPTIMISED`."""
    jax.config.update("jax_disable_most_optimizations", not getattr(request.module, "OPTIMISED", False))
