"""A simulator in C: its command line becomes a task.

    cc -O2 -o examples/command/spring examples/command/spring.c -lm
    python examples/command/spring.py
    jaxlfi infer examples.command.spring:task --workers 2 --out runs/spring

Every simulation is a process of its own. One that crashes, hangs or writes invalid output is counted as failed, and the
round continues.
"""

import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

import jaxlfi

PROGRAM = Path(__file__).with_name("spring")
TRUTH = np.array([2.0, 0.3])
SETTINGS = jaxlfi.QUICK.replace(rounds=3, simulations_per_round=200, simulation_budget=250)


def task(program: str = str(PROGRAM)):
    """The spring as a task.

    Args:
        program: the compiled spring.c, or another simulator with the same arguments.
    """
    return jaxlfi.Task.from_command(
        f"{shlex.quote(program)} --theta {{theta}} --seed {{seed}}",
        names=("stiffness", "damping"),
        units=("N/m", "N s/m"),
        supports={"guess": jaxlfi.Support([0.5, 0.05], [5.0, 1.0])},
        feasible=jaxlfi.Support([0.05, 0.01], [20.0, 5.0]),
        timeout=10.0,
        truth=TRUTH,
        failures=("blew up",),
        name="spring",
    )


def main(program: str = str(PROGRAM)):
    """Infer both parameters of the spring."""
    with ThreadPoolExecutor(2) as executor:
        run = jaxlfi.infer(jax.random.key(0), task(program), settings=SETTINGS, executor=executor, progress=True)
    draws = run.posterior.sample(jax.random.key(1), 1000)
    for name, true, values in zip(run.task.names, TRUTH, draws.T, strict=True):
        print(f"{name:10} truth {true:4.2f}   posterior {values.mean():4.2f} +- {values.std():.2f}")
    return draws


if __name__ == "__main__":
    main()
