"""Existing simulations: given pairs of parameters and trajectories replace those of the first round.

    python examples/presimulated.py

Their parameters were not drawn uniformly, so the file also holds their density, and each pair is weighted.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxlfi
from jaxlfi.envs.gaussian_linear import posterior, task

PAIRS = 3000
# The posterior is a single Gaussian, so one component is enough.
ESTIMATOR = jaxlfi.QUICK.estimator.replace(components=1, ensemble_size=2, prune=0.0, learning_rate=3e-3)
SETTINGS = jaxlfi.QUICK.replace(estimator=ESTIMATOR, rounds=1)


def main():
    """Write a file of simulations, infer from it alone, and compare with the exact posterior."""
    problem = task()
    rng = np.random.default_rng(0)
    # An arbitrary design: half of the parameters are uniform, half favour small values of the first one.
    uniform, small = rng.uniform(-3, 3, (PAIRS, 2)), 6 * rng.beta(1.0, 2.0, PAIRS) - 3
    first, second = np.where(rng.random(PAIRS) < 0.5, uniform[:, 0], small), uniform[:, 1]
    theta = np.stack([first, second], axis=1)
    log_density = np.log(0.5 / 6 + 0.5 * 2 * (3 - first) / 36) - np.log(6)
    trajectory = jax.vmap(problem.simulate)(jax.random.split(jax.random.key(2), PAIRS), jnp.asarray(theta, jnp.float32))
    observed = problem.simulate(jax.random.key(1), problem.truth)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "simulations.npz"
        np.savez(path, theta=theta, trajectory=trajectory, log_density=log_density, low=[-3, -3], high=[3, 3])
        run = jaxlfi.infer(
            jax.random.key(0), problem, observed, heuristic=jaxlfi.Fixed(), settings=SETTINGS, simulations=path
        )  # on the command line: --simulations simulations.npz --rounds 1
    draws, exact = run.posterior.sample(jax.random.key(3), 1000), posterior(observed)
    weight = run.dataset.weight
    print(f"pairs used: {int(run.dataset.size)}, of weights {weight.min():.2f} to {weight.max():.2f}")
    print(f"truth                {problem.truth}")
    print(f"exact posterior      {np.round(exact.mean, 2)} +- {np.round(np.sqrt(np.diag(exact.covariance)), 2)}")
    print(f"inferred posterior   {np.mean(draws, axis=0).round(2)} +- {np.std(draws, axis=0).round(2)}")
    return exact, draws


if __name__ == "__main__":
    main()
