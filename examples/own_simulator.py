"""Your own simulator: a damped spring, from a guess of its parameters that is wrong.

    python examples/own_simulator.py

The guess excludes the true stiffness. A fixed support then gives a posterior at its bound, and says so; EDGE moves the
bound and finds the spring.
"""

import warnings

import jax
import jax.numpy as jnp

import jaxlfi

TRUTH = jnp.array([6.0, 0.5])
SETTINGS = jaxlfi.QUICK.replace(rounds=5)


def simulate(key, theta):
    """Displacement [mm] of a mass of 1 kg, released at 100 mm and measured at 40 times."""
    stiffness, damping = theta

    def step(state, _):
        place, velocity = state
        velocity = velocity - 0.05 * (stiffness * place + damping * velocity)
        place = place + 0.05 * velocity
        return (place, velocity), place

    _, places = jax.lax.scan(step, (100.0, 0.0), length=120)
    return places[2::3] + 2.0 * jax.random.normal(key, (40,))


def spring():
    """Stiffness and damping, each in its unit; the guess stops short of the true stiffness of 6 N/m."""
    return jaxlfi.Task(
        simulate,
        names=("stiffness", "damping"),
        units=("N/m", "N s/m"),
        supports={"guess": jaxlfi.Support([1.0, 0.1], [4.0, 1.0])},
        feasible=jaxlfi.Support([0.1, 0.01], [20.0, 2.0]),
        truth=TRUTH,
        name="spring",
    )


def main():
    """Infer with the support as it is and with EDGE, and compare both with the truth."""
    task, key = spring(), jax.random.key(0)
    x_real = simulate(jax.random.key(1), TRUTH)
    posteriors = {}
    for label, heuristic in {"fixed": jaxlfi.Fixed(), "EDGE": jaxlfi.Edge()}.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jaxlfi.SupportWarning)  # printed below
            run = jaxlfi.infer(key, task, x_real, support="guess", heuristic=heuristic, settings=SETTINGS)
        posteriors[label] = draws = run.posterior.sample(jax.random.key(2), 1000)
        low, high = run.belief.support.low, run.belief.support.high
        print(f"\n{label}: truth, posterior mean +- sd, final support")
        for d, (name, unit) in enumerate(zip(task.names, task.units, strict=True)):
            print(
                f"  {name:9} {TRUTH[d]:5.2f}  {draws[:, d].mean():5.2f} +- {draws[:, d].std():.2f} {unit:5}  "
                f"[{low[d]:.2f}, {high[d]:.2f}]"
            )
        for warning in run.warnings:
            print(f"  warning: {warning}")
    return posteriors


if __name__ == "__main__":
    main()
