"""Named summaries: what the network sees of a trajectory."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

Summary = Callable[[Array], Array]


def identity(trajectory: Float[Array, "..."]) -> Float[Array, " obs"]:
    """The trajectory itself, flattened."""
    return jnp.ravel(trajectory)


SUMMARIES: dict[str, Summary] = {"identity": identity}
"""Summaries by name; each maps one trajectory to a vector [S]."""


def named(name: str) -> Summary:
    """The summary of that name.

    Raises:
        ValueError: for a name that is not in `SUMMARIES`.
    """
    if name not in SUMMARIES:
        raise ValueError(f"summary: expected one of {sorted(SUMMARIES)}, got {name!r}")
    return SUMMARIES[name]
