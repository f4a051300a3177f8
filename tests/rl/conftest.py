"""What tests of trainings share."""

import jax
import pytest


@pytest.fixture(scope="module")
def keys_of_brax():
    """Brax uses keys in its own way, which the checker takes for a reuse."""
    with jax.debug_key_reuse(False):
        yield
