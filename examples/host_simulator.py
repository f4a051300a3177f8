"""A simulator that JAX cannot trace: an epidemic in plain NumPy, called between the compiled parts of a round.

    python examples/host_simulator.py

It could just as well be a subprocess or a game engine. Failed simulations are reported, counted and left out.
"""

import jax
import numpy as np

import jaxlfi

TRUTH = np.array([0.5, 0.2])
DAYS, PEOPLE = 60, 1000
SETTINGS = jaxlfi.QUICK.replace(rounds=4, simulations_per_round=300, simulation_budget=400)


def epidemic(rng, theta):
    """Square roots of each day's new infections, shape [N, DAYS], and whether the epidemic started, shape [N].

    Args:
        rng: a numpy.random.Generator.
        theta: rates of infection and recovery [1/day], shape [N, 2].
    """
    infection, recovery = theta.T
    susceptible = np.full(len(theta), PEOPLE - 5)
    infected = np.full(len(theta), 5)
    cases = np.zeros((len(theta), DAYS))
    for day in range(DAYS):
        new = rng.binomial(susceptible, 1 - np.exp(-infection * infected / PEOPLE))
        healed = rng.binomial(infected, 1 - np.exp(-recovery))
        susceptible, infected = susceptible - new, infected + new - healed
        cases[:, day] = new
    return np.sqrt(cases), cases.sum(axis=1) >= 20  # the noise of square roots of counts is nearly constant


def main():
    """Infer both rates and R0, starting from a wide box."""
    task = jaxlfi.Task(
        jaxlfi.HostSimulator(epidemic),
        names=("infection", "recovery"),
        units=("1/day", "1/day"),
        supports={"wide": jaxlfi.Support([0.05, 0.05], [2.0, 1.0])},
        feasible=jaxlfi.Support([0.01, 0.01], [5.0, 5.0]),
        log=("infection", "recovery"),  # they span orders of magnitude
        truth=TRUTH,
        failures=("no outbreak",),
        name="epidemic",
    )
    (real,), _ = epidemic(np.random.default_rng(7), TRUTH[None])
    run = jaxlfi.infer(jax.random.key(0), task, real, heuristic=jaxlfi.Edge(), settings=SETTINGS, progress=True)
    draws = run.posterior.sample(jax.random.key(1), 1000)
    ratio = draws[:, 0] / draws[:, 1]
    print(f"simulations: {run.history['attempted'].sum()}, without an outbreak: {run.history['failed'][:, 0].sum()}")
    print("           truth  posterior mean +- sd")
    for name, true, values in [*zip(task.names, TRUTH, draws.T, strict=True), ("R0", TRUTH[0] / TRUTH[1], ratio)]:
        print(f"{name:10} {true:5.2f}  {values.mean():5.2f} +- {values.std():.2f}")
    return draws


if __name__ == "__main__":
    main()
