"""Your own heuristic: one class with one method.

    python examples/own_heuristic.py
    jaxlfi infer gaussian_linear --support misspecified --heuristic examples.own_heuristic:Surround --out runs/surround

`Surround` puts the box around the posterior's central interval, with a margin. The support widens or narrows with the
posterior.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxlfi
from jaxlfi.envs.gaussian_linear import posterior, task
from jaxlfi.fields import hyperparameter
from jaxlfi.heuristics import Heuristic, adapted

# The posterior is a single Gaussian, so one component is enough.
ESTIMATOR = jaxlfi.QUICK.estimator.replace(components=1, ensemble_size=2, prune=0.0, learning_rate=3e-3)
SETTINGS = jaxlfi.QUICK.replace(estimator=ESTIMATOR, rounds=4)


class Surround(Heuristic):
    """A box around the central interval of every marginal, with a margin on either side.

    Fields made by `hyperparameter` are checked, can be mapped over with `vmap`, and become flags of the command line.
    """

    outside: float = hyperparameter(default=0.01, help="posterior mass left beyond each bound", low=0.001, below=0.5)
    margin: float = hyperparameter(default=0.5, help="width added on either side, as a fraction of the interval", low=0)

    def __call__(self, previous, posterior, feasible):
        """All D dimensions are computed at once: no Python branches on values."""
        low = posterior.marginal_quantile(self.outside)
        high = -posterior.mirror().marginal_quantile(self.outside)
        margin = self.margin * (high - low)
        # Clip to Phi last: if the interval lies outside Phi, a tenth of Phi's width remains at the bound.
        least = 0.1 * feasible.width
        support = jaxlfi.Support(
            jnp.clip(low - margin, feasible.low, feasible.high - least),
            jnp.clip(high + margin, feasible.low + least, feasible.high),
        )
        return adapted(previous, posterior, support, evidence={"interval_low": low, "interval_high": high})


def main():
    """Start from a box that excludes the truth, on a task whose posterior is known exactly."""
    problem = task()
    observed = problem.simulate(jax.random.key(1), problem.truth)
    exact = posterior(observed)
    run = jaxlfi.infer(
        jax.random.key(0), problem, observed, support="misspecified", heuristic=Surround(), settings=SETTINGS
    )
    draws = run.posterior.sample(jax.random.key(1), 1000)
    print(f"support at first: {problem.supports['misspecified'].low} to {problem.supports['misspecified'].high}")
    for index, (low, high) in enumerate(zip(run.history["support_low"], run.history["support_high"], strict=True)):
        print(f"  after round {index}: {low.round(2)} to {high.round(2)}")
    print(f"truth                {problem.truth}")
    print(f"exact posterior      {np.round(exact.mean, 2)} +- {np.round(np.sqrt(np.diag(exact.covariance)), 2)}")
    print(f"inferred posterior   {np.mean(draws, axis=0).round(2)} +- {np.std(draws, axis=0).round(2)}")
    return exact, draws


if __name__ == "__main__":
    main()
