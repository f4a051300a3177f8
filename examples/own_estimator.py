"""Your own density estimator: a class of settings and a Flax module.

    python examples/own_estimator.py
    jaxlfi infer gaussian_linear --estimator examples.own_estimator:Laplace --steps 1000 --out runs/laplace

The module maps a normalised summary to a conditional density: any pytree with `log_prob` and `sample`. The base class
provides the ensemble, its training and the mixture that heuristics see. Here: independent Laplace distributions.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

import jaxlfi
from jaxlfi.envs.gaussian_linear import posterior, task
from jaxlfi.estimators.base import Estimator
from jaxlfi.fields import option


@struct.dataclass
class LaplaceDensity:
    """Independent Laplace distributions.

    Attributes:
        location: locations, shape [D].
        log_scale: logarithms of the scales, shape [D].
    """

    location: jax.Array
    log_scale: jax.Array

    def log_prob(self, theta):
        """Log-density of theta, which may have any leading axes."""
        distance = jnp.abs(theta - self.location) * jnp.exp(-self.log_scale)
        return -jnp.sum(distance + self.log_scale + jnp.log(2.0), axis=-1)

    def sample(self, key, n):
        """`n` draws, shape [n, D]."""
        return self.location + jnp.exp(self.log_scale) * jax.random.laplace(key, (n, *self.location.shape))


class LaplaceModule(nn.Module):
    """A network from a summary to its density."""

    dim: int
    units: int

    @nn.compact
    def __call__(self, x):
        """The density of one normalised summary, shape [S]."""
        hidden = nn.tanh(nn.Dense(self.units)(x))
        return LaplaceDensity(nn.Dense(self.dim)(hidden), nn.Dense(self.dim)(hidden))


class Laplace(Estimator):
    """Settings of the family; those of training are inherited."""

    units: int = option(default=32, low=1, help="units of the hidden layer")

    def module(self, dim):
        """The Flax network of one ensemble member."""
        return LaplaceModule(dim, self.units)


def main():
    """Compare the family with the exact posterior, which it can match in location and scale but not in correlation."""
    problem = task()
    observed = problem.simulate(jax.random.key(1), problem.truth)
    estimator = Laplace(ensemble_size=2, epochs=0, steps=1000, learning_rate=3e-3, components=2)
    settings = jaxlfi.Settings(
        estimator, rounds=1, simulations_per_round=2000, simulation_budget=2000, restriction="reject"
    )
    run = jaxlfi.infer(jax.random.key(0), problem, observed, heuristic=jaxlfi.Fixed(), settings=settings)
    draws, exact = run.posterior.sample(jax.random.key(1), 1000), posterior(observed)
    print(f"truth                {problem.truth}")
    print(f"exact posterior      {np.round(exact.mean, 2)} +- {np.round(np.sqrt(np.diag(exact.covariance)), 2)}")
    print(f"inferred posterior   {np.mean(draws, axis=0).round(2)} +- {np.std(draws, axis=0).round(2)}")
    print(f"mass of the density inside the support: {run.posterior.mass_inside:.3f}")
    return exact, draws


if __name__ == "__main__":
    main()
