"""Singular value decomposition that cannot deadlock in batches on a CPU."""

import functools

import jax
from jaxtyping import Array, Float


def svd(x: Float[Array, "rows columns"]) -> tuple[Float[Array, "rows rank"], Array, Float[Array, "rank columns"]]:
    """Left vectors, singular values and right vectors, x = U diag(s) V', of rank min(rows, columns).

    CPUs use QR iteration. Divide and conquer, the method of `jnp.linalg.svd` there, hands the matrices of a batch to
    the threads it runs on itself, and waits for them: if two such batches run at once on two cores, both can wait for
    ever. Other platforms use their default method; TPUs have no QR iteration.
    """
    by = lambda algorithm: functools.partial(jax.lax.linalg.svd, full_matrices=False, algorithm=algorithm)
    ways = jax.lax.linalg.SvdAlgorithm
    left, values, right = jax.lax.platform_dependent(x, cpu=by(ways.QR), default=by(ways.DEFAULT))
    return left, values, right
