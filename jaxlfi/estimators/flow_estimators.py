"""Conditional normalizing flows as estimators (appendix A): masked autoregressive, and neural spline."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.base import Estimator, viewed
from jaxlfi.estimators.flows import MAF, NSF, PRECISION, SPREAD
from jaxlfi.estimators.mdn import ACTIVATIONS, REGRESSION
from jaxlfi.estimators.ridge import linear_gaussian, scaled_gaussian
from jaxlfi.fields import option


class FlowEstimator(Estimator):
    """Base of both kinds of flow.

    Attributes:
        hidden: units of each hidden layer of a conditioner; all must be equal.
        activation: "relu", "tanh" or "silu".
        transforms: number of successive maps from theta to the base.
    """

    hidden: tuple[int, ...] = option(default=(50, 50), low=1, help="units per hidden layer")
    activation: str = option(default="tanh", choices=tuple(ACTIVATIONS), help="activation function")
    transforms: int = option(default=5, low=1, help="number of transforms per flow")

    def check(self) -> "FlowEstimator":
        """Refuse settings that cannot work, by name; returns the settings."""
        super().check()
        if len(set(self.hidden)) != 1:
            raise ValueError(f"hidden: expected layers of equal width for a flow, got {self.hidden}")
        return self

    @property
    def layers(self) -> tuple[int, int, str]:
        """Units, hidden layers after the first, and activation of a conditioner."""
        return self.hidden[0], len(self.hidden) - 1, self.activation


class MaskedFlow(FlowEstimator):
    """A masked autoregressive flow (Papamakarios, Pavlakou and Murray 2017).

    Example:
        >>> MaskedFlow(transforms=3).check().transforms
        3
    """

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for D parameters."""
        return MAF(dim, self.transforms, *self.layers)


class SplineFlow(FlowEstimator):
    """A neural spline flow of coupling transforms (Durkan et al. 2019).

    Attributes:
        bins: number of pieces of each spline.
        tail_bound: half the splines' range, in standard deviations of theta; beyond, they are the identity.
        regression: how many networks of the ensemble, the last ones, start as the Gaussian around a ridge regression of
            the parameters on the summaries (`jaxlfi.estimators.ridge`). It is trained with the rest, so that they only
            have to learn how the posterior differs from it. With a `reduction` the regression is on each network's own
            inputs, and its width depends on them, too. These networks are better if the parameters are about linear in
            the summaries, but extrapolate more boldly: if the loss is the likelihood, the posterior weights both kinds
            by their log score on held-out simulations (`jaxlfi.estimators.stacking`). With an embedding no network
            starts from a regression, as the features are not known before.

    Example:
        >>> SplineFlow(bins=8).check().bins
        8
    """

    bins: int = option(default=10, low=1, high=999, help="number of pieces per spline")
    tail_bound: float = option(default=5.0, low=0.1, help="half-width of the splines' range, in standard deviations")
    regression: int = option(
        default=0, low=0, help="number of networks that start from a ridge regression on the summaries"
    )

    def begin(
        self,
        params: dict,
        theta: Float[Array, "n dim"],
        x: Float[Array, "n given"],
        valid: Bool[Array, " n"],
        views: np.ndarray | None,
    ) -> dict:
        """Fresh weights; some networks start as the Gaussian around a linear regression on their inputs."""
        if not self.regression or self.embedding != "none":
            return params

        def start(own: dict, view: Any, chosen: Any) -> dict:
            given, spread = viewed(x, view), jnp.zeros_like(own[SPREAD])
            if self.active_reduction == "none":
                coefficients, intercept, precision = linear_gaussian(given, theta, valid)
            else:
                coefficients, intercept, by_x, offset, precision = scaled_gaussian(given, theta, valid)
                spread = jnp.c_[by_x, offset]
            shift = jnp.c_[coefficients, intercept]
            raw = jnp.tril(precision, -1) + jnp.diag(jnp.log(jnp.diagonal(precision)))
            begun = own | {REGRESSION: shift, SPREAD: spread, PRECISION: raw}
            return jax.tree.map(lambda new, old: jnp.where(chosen, new, old), begun, own)

        chosen = np.arange(self.ensemble_size) >= self.ensemble_size - self.regression
        return {"params": jax.vmap(start)(params["params"], views, chosen)}

    @property
    def stacked(self) -> bool:
        """Whether some networks start from a regression and others do not, or networks see different inputs."""
        return super().stacked or (0 < self.regression < self.ensemble_size and self.embedding == "none")

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for D parameters."""
        return NSF(dim, self.transforms, *self.layers, self.bins, self.tail_bound)
