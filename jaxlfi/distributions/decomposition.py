"""Singular values that are found whatever else runs beside."""

import jax
from jaxtyping import Array, Float


def svd(x: Float[Array, "rows columns"]) -> tuple[Float[Array, "rows rank"], Array, Float[Array, "rank columns"]]:
    """Left vectors, singular values and right vectors, x = U diag(s) V', of rank min(rows, columns).

    By QR iteration. Divide and conquer, `jnp.linalg.svd`'s way on CPUs, hands the matrices of a batch to the threads it
    runs on itself, and waits for them: where two such batches run at once on two cores, both can wait for ever.
    """
    left, values, right = jax.lax.linalg.svd(x, full_matrices=False, algorithm=jax.lax.linalg.SvdAlgorithm.QR)
    return left, values, right
