"""Checks the arguments of diagnostics, and refuses invalid ones in one line."""

import operator
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.distributions.arguments import is_concrete

Truths = Float[Array | np.ndarray, "n dim"] | Int[Array | np.ndarray, "n dim"]
"""Parameters from which N observations were simulated."""
Draws = Float[Array | np.ndarray, "n draws dim"] | Int[Array | np.ndarray, "n draws dim"]
"""L draws from the posterior of each."""


def numbers(name: str, given: Any, sizes: Sequence[str], nan_only: bool = False) -> Any:
    """An array of numbers, on the host and in double precision where its values are known.

    Args:
        name: of the argument.
        given: its value.
        sizes: names of its axes, as in "[N, L, D]".
        nan_only: whether infinite numbers are allowed.

    Raises:
        ValueError: for a wrong number of axes, an axis without entries, or numbers that are NaN or infinite.
    """
    concrete = is_concrete(given)
    try:
        array = np.asarray(given, np.float64) if concrete else jnp.asarray(given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected an array of numbers, got {type(given).__name__}") from error
    if array.ndim != len(sizes) or 0 in array.shape:
        raise ValueError(f"{name}: expected shapes [{', '.join(sizes)}], got {list(array.shape)}")
    if concrete and (wrong := int(np.sum(np.isnan(array) if nan_only else ~np.isfinite(array)))):
        kind = "numbers that are not NaN" if nan_only else "finite numbers"
        raise ValueError(f"{name}: expected {kind}, got {wrong} others of {array.size}")
    return array


def truths_and_draws(truths: Any, draws: Any) -> tuple[Any, Any]:
    """Truths [N, D] and draws from the posterior of each, [N, L, D], checked.

    Raises:
        ValueError: for shapes that do not fit, numbers that are not finite, and uninformative draws of a parameter: all
            the same number, or all equal to their truth.
    """
    truths, draws = numbers("truths", truths, "ND"), numbers("draws", draws, "NLD")
    if truths.shape != (draws.shape[0], draws.shape[2]):
        raise ValueError(
            f"truths, draws: expected shapes [N, D] and [N, L, D], got {list(truths.shape)} and {list(draws.shape)}"
        )
    if is_concrete((truths, draws)):
        same = np.ptp(draws, axis=(0, 1)) == 0
        exact = (draws == truths[:, None]).all(axis=(0, 1))
        if (constant := np.flatnonzero(same | exact)).size:
            raise ValueError(f"draws: expected draws that vary, got none that do of parameter {constant[0] + 1}")
    return truths, draws


def checked_ranks(rank: Any, draws: Any, fewest: int = 2) -> np.ndarray:
    """Ranks of N >= 2 truths among L draws each, as whole numbers from 0 to L, shape [N].

    Args:
        rank: the given ranks.
        draws: the given L.
        fewest: smallest L.

    Raises:
        ValueError: for anything else.
    """
    given = numbers("rank", rank, "N")
    try:
        count = operator.index(draws)
    except TypeError as error:
        raise ValueError(f"draws: expected a whole number, got {draws!r}") from error
    if len(given) < 2 or count < fewest or np.min(given) < 0 or np.max(given) > count or np.any(given % 1):
        raise ValueError(
            f"rank, draws: expected at least two ranks from 0 to the number of draws, at least {fewest}, got "
            f"{len(given)} ranks from {np.min(given):g} to {np.max(given):g} and {count} draws"
        )
    return given.astype(int)
