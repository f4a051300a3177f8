"""What all tests share: strict JAX, quick compiling, one deterministic hypothesis profile, one key a test."""

import zlib

import hypothesis
import jax
import pytest

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
    """Compile without most optimisations, as tests run for milliseconds, but for modules that set `OPTIMISED`."""
    jax.config.update("jax_disable_most_optimizations", not getattr(request.module, "OPTIMISED", False))
    yield
    jax.config.update("jax_disable_most_optimizations", False)
