"""Choice: one of several heuristics, selected by a leaf, so that runs in one batch can use different ones."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics.base import Adaptation, Heuristic


class Choice(Heuristic):
    """Apply `rules[index]`. The index is a leaf: `vmap` over it compares heuristics within one program.

    All rules are evaluated (they cost microseconds) and one result is kept. The evidence of every rule is kept under
    the rule's index ("0/mass_left"), so that the rules that were not chosen can be compared.

    Attributes:
        index: index of the rule to follow, shape [].
        rules: heuristics to choose from.
    """

    index: Int[Array, "*batch"] | int
    rules: tuple[Heuristic, ...]

    @property
    def grows(self) -> bool:  # type: ignore[override]  # its rules say, and only an instance has them
        """Whether any rule can let the support grow."""
        return any(rule.grows for rule in self.rules)

    @property
    def proposes_from_prior(self) -> bool:  # type: ignore[override]  # its rules say, and only an instance has them
        """Whether all rules always propose from the prior."""
        return all(rule.proposes_from_prior for rule in self.rules)

    @property
    def compares_components(self) -> bool:  # type: ignore[override]  # its rules say, and only an instance has them
        """Whether any rule compares components."""
        return any(rule.compares_components for rule in self.rules)

    def __call__(self, previous: Belief, posterior: GaussianMixture, feasible: Support) -> tuple[Belief, Adaptation]:
        """Evaluate every rule and keep the chosen one's belief and shifts."""
        outcomes = [rule(previous, posterior, feasible) for rule in self.rules]
        evidence = {
            f"{place}/{name}": seen
            for place, (_, adaptation) in enumerate(outcomes)
            for name, seen in adaptation.evidence.items()
        }
        kept = [(belief, adaptation.low_shift, adaptation.high_shift) for belief, adaptation in outcomes]
        belief, low_shift, high_shift = jax.tree.map(lambda *all_: jnp.stack(all_)[self.index], *kept)
        return belief, Adaptation(evidence, low_shift, high_shift)
