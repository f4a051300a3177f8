"""Your own simulator: a damped spring, inferred from a wrong guess of its parameters.

    python examples/own_simulator.py

The guess excludes the true stiffness. EDGE moves the bound and finds it; with `heuristic=jaxlfi.Fixed()` the
posterior stays at the bound, and a warning names it.
"""

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


def main():
    """Infer stiffness and damping, and compare them with the truth."""
    task = jaxlfi.Task(
        simulate,
        names=("stiffness", "damping"),
        units=("N/m", "N s/m"),
        supports={"guess": jaxlfi.Support([1.0, 0.1], [4.0, 1.0])},
        feasible=jaxlfi.Support([0.1, 0.01], [20.0, 2.0]),
        truth=TRUTH,  # only used to report errors
        name="spring",
    )
    x_real = simulate(jax.random.key(1), TRUTH)
    run = jaxlfi.infer(
        jax.random.key(0), task, x_real, support="guess", heuristic=jaxlfi.Edge(), settings=SETTINGS, progress=True
    )
    print("upper bound of the stiffness, by round:", run.history["support_high"][:, 0].round(2))
    draws = run.posterior.sample(jax.random.key(2), 1000)
    print("           truth  posterior mean +- sd")
    for name, unit, true, values in zip(task.names, task.units, TRUTH, draws.T, strict=True):
        print(f"{name:10} {true:5.2f}  {values.mean():5.2f} +- {values.std():.2f} {unit}")
    for warning in run.warnings:
        print("warning:", warning)
    return draws


if __name__ == "__main__":
    main()
