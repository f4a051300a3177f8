"""A prior, and parameters inferred as logarithms: radioactive decay, compared with the posterior on a fine grid.

    python examples/prior_and_log.py

The likelihood of this toy problem is known, so its exact posterior can be computed by brute force.
"""

import distrax
import jax
import jax.numpy as jnp

import jaxlfi

TRUTH = jnp.array([0.3, 5.0])
NOISE = 0.3
TIMES = jnp.arange(10.0)
BOX = jaxlfi.Support([0.05, 1.0], [2.0, 20.0])
# A normal prior over the logarithms is log-normal over the parameters.
PRIOR = distrax.MultivariateNormalDiag(jnp.log(jnp.array([0.5, 6.0])), jnp.array([0.7, 0.4]))
# The posterior of the logarithms is nearly Gaussian, so one component is enough.
ESTIMATOR = jaxlfi.QUICK.estimator.replace(components=1, ensemble_size=2, prune=0.0, learning_rate=3e-3)
SETTINGS = jaxlfi.QUICK.replace(
    estimator=ESTIMATOR, rounds=1, simulations_per_round=2000, simulation_budget=2000, predictive=False
)


def simulate(key, theta):
    """Ten noisy readings of a quantity that decays from `start` at `rate`."""
    rate, start = theta
    return start * jnp.exp(-rate * TIMES) + NOISE * jax.random.normal(key, TIMES.shape)


@jax.jit
def exact(observed):
    """Mean and standard deviation of the true posterior of the logarithms, by a sum over a grid."""
    axes = [jnp.linspace(low, high, 400) for low, high in zip(jnp.log(BOX.low), jnp.log(BOX.high), strict=True)]
    grid = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    clean = jnp.exp(grid[:, 1:]) * jnp.exp(-jnp.exp(grid[:, :1]) * TIMES)
    log_posterior = PRIOR.log_prob(grid) - 0.5 * jnp.sum(((observed - clean) / NOISE) ** 2, axis=1)
    weight = jax.nn.softmax(log_posterior)[:, None]
    mean = jnp.sum(weight * grid, axis=0)
    return mean, jnp.sqrt(jnp.sum(weight * (grid - mean) ** 2, axis=0))


def main():
    """Infer, and compare in inference space."""
    task = jaxlfi.Task(
        simulate,
        names=("rate", "start"),
        units=("1/s", "mg"),
        supports={"prior": BOX},  # everything here is in natural units ...
        feasible=BOX,
        log=("rate", "start"),
        prior=PRIOR,
        prior_space="inference",  # ... except the prior, which is over logarithms
        truth=TRUTH,
        name="decay",
    )
    observed = simulate(jax.random.key(3), TRUTH)
    run = jaxlfi.infer(jax.random.key(0), task, observed, heuristic=jaxlfi.Fixed(), settings=SETTINGS)
    draws = run.posterior.sample(jax.random.key(1), 1000, space="inference")
    mean, sd = exact(observed)
    print(f"{'':10} truth   exact posterior   inferred posterior")
    for d, label in enumerate(task.space.labels):
        print(
            f"{label:9} {jnp.log(TRUTH[d]):6.2f}   {mean[d]:5.2f} +- {sd[d]:.2f}     "
            f"{draws[:, d].mean():5.2f} +- {draws[:, d].std():.2f}"
        )
    print("most probable, in natural units:", run.posterior.map().round(2))
    return mean, sd, draws


if __name__ == "__main__":
    main()
