"""No adaptation: standard BayesSim on the support it was given."""

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics.base import Adaptation, Heuristic, adapted


class Fixed(Heuristic):
    """Keep the support as it is (the baseline of section V).

    Example:
        >>> Fixed()
        Fixed()
    """

    grows = False

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """The posterior on the previous support, without evidence or shifts."""
        return adapted(previous, posterior, previous.support, evidence={})
