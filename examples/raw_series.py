"""A raw time series without given summaries: an embedding network is trained together with the posterior.

    python examples/raw_series.py

The recording of a vibrating machine begins at a random phase, so no single reading is informative about the frequency
or the damping. The network sees all readings, and convolutions over time find both.
"""

import jax
import jax.numpy as jnp

import jaxlfi

TIMES = jnp.linspace(0.0, 6.0, 40)
TRUTH = jnp.array([4.0, 0.3])
ESTIMATOR = jaxlfi.QUICK.estimator.replace(embedding="series", ensemble_size=2)
SETTINGS = jaxlfi.QUICK.replace(
    estimator=ESTIMATOR, rounds=2, simulations_per_round=400, simulation_budget=400, predictive=False
)


def simulate(key, theta):
    """Displacement [mm] at 40 times, with an unknown initial phase."""
    frequency, damping = theta
    key_phase, key_noise = jax.random.split(key)
    phase = jax.random.uniform(key_phase, maxval=2 * jnp.pi)
    clean = 10 * jnp.exp(-damping * TIMES) * jnp.cos(frequency * TIMES + phase)
    return clean + 0.5 * jax.random.normal(key_noise, TIMES.shape)


def main():
    """Infer frequency and damping from the raw recording."""
    box = jaxlfi.Support([1.0, 0.0], [6.0, 1.0])
    task = jaxlfi.Task(
        simulate,  # the summary is the trajectory itself by default: summary="identity"
        names=("frequency", "damping"),
        units=("rad/s", "1/s"),
        supports={"prior": box},
        feasible=box,
        name="vibration",
    )
    x_real = simulate(jax.random.key(1), TRUTH)
    run = jaxlfi.infer(jax.random.key(0), task, x_real, heuristic=jaxlfi.Fixed(), settings=SETTINGS)
    draws = run.posterior.sample(jax.random.key(2), 1000)
    print("           truth  posterior mean +- sd")
    for name, unit, true, values in zip(task.names, task.units, TRUTH, draws.T, strict=True):
        print(f"{name:10} {true:5.2f}  {values.mean():5.2f} +- {values.std():.2f} {unit}")
    return draws


if __name__ == "__main__":
    main()
