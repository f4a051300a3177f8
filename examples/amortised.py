"""Amortised inference: after a run of one round, its network gives the posterior of any observation.

    python examples/amortised.py

100 truths are drawn from the prior and simulated, and the network gives the posterior of each. Intervals of 90 % should
contain nine in ten of the truths.
"""

import jax
import jax.numpy as jnp

import jaxlfi
from jaxlfi.envs.gaussian_linear import task

TRUTHS = 100
# The posterior is a single Gaussian, so one component is enough.
ESTIMATOR = jaxlfi.QUICK.estimator.replace(components=1, ensemble_size=2, prune=0.0, learning_rate=3e-3)
SETTINGS = jaxlfi.QUICK.replace(
    estimator=ESTIMATOR, rounds=1, simulations_per_round=4000, simulation_budget=4000, predictive=False
)


def main():
    """Infer once, then condition on all observations at once."""
    problem = task()
    key_run, key_truth, key_simulate, key_draw = jax.random.split(jax.random.key(0), 4)
    run = jaxlfi.infer(key_run, problem, heuristic=jaxlfi.Fixed(), settings=SETTINGS)
    truths = problem.supports["ok"].sample(key_truth, TRUTHS)
    observations = jax.vmap(problem.simulate)(jax.random.split(key_simulate, TRUTHS), truths)

    def interval(key, observation):
        draws = run.posterior_of(observation).sample(key, 200)
        return jnp.quantile(draws, jnp.array([0.05, 0.5, 0.95]), axis=0)

    intervals = jax.jit(jax.vmap(interval, out_axes=1))
    low, median, high = intervals(jax.random.split(key_draw, TRUTHS), observations)
    held = jnp.mean((low <= truths) & (truths <= high), axis=0)
    error = jnp.mean(jnp.abs(median - truths), axis=0)
    for d, name in enumerate(problem.names):
        print(
            f"{name:7} 90 % intervals hold {held[d]:.0%} of {TRUTHS} truths; they are {(high - low)[:, d].mean():.2f} "
            f"wide; medians are off by {error[d]:.2f}"
        )
    return held


if __name__ == "__main__":
    main()
