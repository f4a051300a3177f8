"""Polishing: refining a posterior by a task's knowledge of its simulator, such as a model for least squares."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from jaxlfi.distributions.mixture import GaussianMixture

Counted = Callable[[Sequence[int]], Iterable[int]]
"""Iterates over places unchanged, as a progress bar does."""
Polish = Callable[..., Any]
"""polish(task, observed, draws, box, counted) -> `Polished`.

The arguments are the task, the observed trajectory, draws of the posterior and the box to stay in, in natural units,
and `Counted`.
"""


class Polished(NamedTuple):
    """A sharper posterior of a run's observation.

    Attributes:
        mixture: over inference space, before it is truncated; None if the posterior stays as it was.
        sentences: how it was found, or why there is none, for the run's summary.
        steps: what to do next, for the same.
        simulations: number of simulations that it took.
    """

    mixture: GaussianMixture | None
    sentences: tuple[str, ...]
    steps: tuple[str, ...]
    simulations: int
