"""Likelihood networks as estimators."""

import flax.linen as nn

from jaxlfi.estimators.likelihood import Likelihood
from jaxlfi.estimators.mdn import ACTIVATIONS, MDN
from jaxlfi.fields import option


class MixtureLikelihood(Likelihood):
    """A mixture density network of the summary given the parameters.

    Attributes:
        hidden: units of each hidden layer.
        activation: "relu", "tanh" or "silu".

    Example:
        >>> MixtureLikelihood(hidden=(64, 64), components=2).check().of_summaries
        True
    """

    hidden: tuple[int, ...] = option((50, 50), low=1, help="units of each hidden layer")
    activation: str = option("tanh", choices=tuple(ACTIVATIONS), help="relu, tanh or silu")

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for S summaries."""
        return MDN(self.components, dim, self.hidden, self.activation)
