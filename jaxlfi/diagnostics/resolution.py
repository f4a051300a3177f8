"""Resolution: summaries that do not vary among the simulations, as far as their precision can tell."""

from collections.abc import Sequence

import numpy as np

from jaxlfi.tasks.reference import RESOLVED

SHOWN = 3
"""Largest number of names in a warning; further ones are counted."""


def resolution_warnings(names: Sequence[str], x: np.ndarray) -> list[str]:
    """One line naming the summaries that are uninformative because they are the same in all simulations.

    A value other than zero may hide a spread that single precision cannot resolve: near 101,325 it resolves 0.008.

    Args:
        names: of the summaries, S of them.
        x: of the simulations, in the precision they were computed in, shape [N, S].

    Example:
        >>> resolution_warnings(["pressure"], np.full((3, 1), 101325, np.float32))[0].partition(":")[0]
        'summary pressure is 101325 in all simulations'
    """
    if len(x) < 2:
        return []
    largest = np.max(np.abs(x), axis=0)
    same = np.ptp(x, axis=0) <= RESOLVED * np.finfo(x.dtype).eps * largest
    named = np.flatnonzero(same & (largest > 0))
    if not named.size:
        return []
    listed = ", ".join(f"{names[s]} is {x[0, s]:.7g}" for s in named[:SHOWN])
    more = f" (and {named.size - SHOWN} more do not vary)" if named.size > SHOWN else ""
    remedy = "subtract a constant in the simulator, or wrap it in jaxlfi.HostSimulator, whose numbers are in double"
    single = f" If it should vary, {x.dtype} cannot resolve it: {remedy} precision." if x.dtype == np.float32 else ""
    return [f"summary {listed} in all simulations{more}: it says nothing of the parameters and is left out.{single}"]
