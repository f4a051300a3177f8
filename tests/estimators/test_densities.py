"""Posteriors are normalised densities: 1 in total over their box, zero outside, and consistent with their draws."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import MASS_DRAWS
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.estimators.normaliser import identity
from jaxlfi.estimators.posterior import Posterior, truncated

X = jnp.array([0.4, 0.5, -0.7])
PLAIN, LOG = Space(("a", "b"), (False, False)), Space(("a", "b"), (False, True))


def check_density(posterior: Posterior, space: str, points: int = 120) -> None:
    """Check with the midpoint rule over the box in the units of the space, and with the mean log-density of draws."""
    box = posterior.support if space == "inference" else posterior.space.box_to_natural(posterior.support)
    low, high = np.asarray(box.low, np.float64), np.asarray(box.high, np.float64)
    axes = [low[d] + (high[d] - low[d]) * (np.arange(points) + 0.5) / points for d in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    outside = np.array([low - 0.1, [high[0], high[1] + 0.1]])
    drawn = posterior.sample(jax.random.key(4), 1000, space)
    theta = jnp.asarray(np.concatenate([grid, outside, drawn]), jnp.float32)
    value = np.asarray(posterior.log_prob(theta, space), np.float64)
    within, beyond, seen = np.split(value, [len(grid), len(grid) + 2])
    cell = np.prod((high - low) / points)
    mass = float(posterior.mass_inside)
    constant = 5 * np.sqrt((1 - mass) / (mass * MASS_DRAWS))  # five standard errors of the truncation constant
    assert np.sum(np.exp(within)) * cell == pytest.approx(1.0, abs=0.005 + constant)
    assert np.all(np.isneginf(beyond))
    mean = np.sum(np.exp(within) * within) * cell
    error = 4 * np.std(seen) / np.sqrt(len(seen)) + constant * (1 + abs(mean))
    assert np.mean(seen) == pytest.approx(mean, abs=0.03 + error)


ESTIMATORS = {
    "maf": MaskedFlow(hidden=(8, 8), transforms=1, ensemble_size=2, epochs=1),
    "nsf": SplineFlow(hidden=(8, 8), transforms=1, bins=4, ensemble_size=2, epochs=1),
    "mdn": MixtureNetwork(hidden=(8,), ensemble_size=2, components=2),
}


@functools.cache
def perturbed(name: str) -> Posterior:
    """An ensemble of two perturbed networks with both affine maps, in a box that truncates it."""
    estimator = ESTIMATORS[name]
    scale, box = Support([-10.0, 0.0], [10.0, 4.0]), Support([0.0, 0.5], [4.0, 2.5])

    @jax.jit
    def conditioned(key_start, key_noise):
        network = untrained(key_start, estimator, 3, scale, LOG)
        leaves, structure = jax.tree.flatten(network.params)
        keys = jax.random.split(key_noise, len(leaves))
        noisy = [leaf + 0.3 * jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
        network = network.replace(
            params=jax.tree.unflatten(structure, noisy),
            normaliser=identity(3, "zscore").replace(
                mean=jnp.array([1.0, 0.0, -1.0]), scale=jnp.array([2.0, 1.0, 0.5])
            ),
        )
        if network.theta_normaliser is not None:
            narrow = identity(2, "zscore").replace(mean=jnp.array([0.2, -0.3]), scale=jnp.array([0.15, 0.5]))
            network = network.replace(theta_normaliser=narrow)
        return network.condition(X, box)

    return conditioned(jax.random.key(0), jax.random.key(1))


@pytest.mark.slow
@pytest.mark.parametrize("space", ["inference", "natural"])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_density_of_a_network_is_that_of_its_draws(name, space):
    posterior = perturbed(name)
    assert 0.02 < float(posterior.mass_inside) < 0.9  # a box that truncates nothing would test nothing
    check_density(posterior, space)


def test_the_density_of_a_mixture_is_its_own_within_the_support():
    mixture = gaussian_linear.posterior(np.array([-0.6, -0.3], np.float32))
    box = Support([-1.0, -2.0], [0.5, 0.5])
    posterior = jax.jit(truncated, static_argnums=3)(mixture, mixture, box, PLAIN)
    check_density(posterior, "inference")
    inside = mixture.log_prob(box.centre[None])[0] - jnp.log(posterior.mass_inside)
    assert float(posterior.log_prob(box.centre)) == pytest.approx(float(inside), abs=1e-4)
