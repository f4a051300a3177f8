"""The singular value decomposition: against NumPy, and with the routine that does not wait for its own threads."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.decomposition import svd


@pytest.mark.parametrize("shape", [(5, 3), (3, 5), (4, 4)])
def test_it_is_numpys(key, shape):
    x = jax.random.normal(key, (6, *shape))
    left, values, right = jax.jit(jax.vmap(svd))(x)
    np.testing.assert_allclose(values, np.linalg.svd(x, compute_uv=False), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(left * values[:, None] @ right, x, atol=1e-5)


def test_no_batch_is_handed_to_the_threads_it_runs_on():
    """With divide and conquer (sgesdd), two simultaneous batches on two cores can deadlock."""
    text = jax.jit(jax.vmap(svd)).lower(jnp.zeros((4, 30, 3))).as_text()
    assert "gesdd" not in text
    assert jax.default_backend() != "cpu" or "gesvd" in text


def test_nothing_else_decomposes_by_itself():
    root = Path(__file__).parents[2]
    files = [*root.glob("jaxlfi/**/*.py"), *root.glob("envs/**/*.py")]
    assert len(files) > 100
    inside = re.compile(r"(jnp|lax)\.linalg\.(svd|pinv|lstsq|cond|matrix_rank)\b")
    assert [file.name for file in files if inside.search(file.read_text())] == ["decomposition.py"]
