"""Polishing: a posterior refined by what a task knows about its simulator, such as a model for least squares."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from jaxlfi.distributions.mixture import GaussianMixture

Counted = Callable[[Sequence[int]], Iterable[int]]
"""Goes through places as they are, as a progress bar does."""
Polish = Callable[..., Any]
"""polish(task, observed, draws, box, counted) -> `Polished`, or None where it has nothing to say.

The arguments are the task, the observed trajectory, draws of the posterior and the box to stay in, in natural units,
and `Counted`.
"""


class Polished(NamedTuple):
    """A sharper posterior of a run's observation.

    Attributes:
        mixture: over inference space, before it is truncated; None where it cannot be trusted, so that the run keeps
            its own.
        sentences: how it was found, for the run's summary.
        steps: what to do next, for the same.
        simulations: that it took.
    """

    mixture: GaussianMixture | None
    sentences: tuple[str, ...]
    steps: tuple[str, ...]
    simulations: int
