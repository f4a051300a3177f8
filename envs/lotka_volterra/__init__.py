"""Lotka-Volterra: the Markov jump process of sections III to V, and as differential equations (`ode`)."""

import numpy as np

from jaxlfi.distributions.support import Support
from jaxlfi.envs.lotka_volterra.jump_process import SUMMARY_NAMES, JumpProcess, lotka_volterra_nine, make_simulator
from jaxlfi.tasks.task import Task

NAMES = ("ln predator birth", "ln predator death", "ln prey birth", "ln prey death")
"""theta_1..theta_4 of the paper, natural logarithms of rates."""

TRUTH = np.log([0.01, 0.5, 1.0, 0.01])
"""theta_gt, in log-rates."""


def _cube(low: float, high: float) -> Support:
    return Support([low] * 4, [high] * 4)


FEASIBLE = _cube(-6.0, 4.0)
"""Phi of section V."""

SUPPORTS = {
    "ok": _cube(-5.0, 2.0),
    "misspecified": Support([-3.0, -5.0, -5.0, -5.0], [2.0, -1.5, 2.0, 2.0]),
    "broad": _cube(-6.0, 4.0),
    "broader": _cube(-6.0, 5.0),
    "broadest": _cube(-7.0, 7.0),
}
"""The named supports of section III-A, in log-rates. "misspecified" excludes the truth in theta_1 and theta_2."""


def task(process: JumpProcess = JumpProcess()) -> Task:
    """The Markov jump process of Papamakarios and Murray with its nine summaries.

    theta are log-rates, like the paper's supports and discrepancies; a simulation fails only if it takes more than
    `process.max_events` events.

    Args:
        process: initial populations, duration, recording and maximum number of events; by default the paper's.
    """
    return Task(
        make_simulator(process),
        name="lotka_volterra",
        names=NAMES,
        units=("ln(1/time)",) * 4,
        supports=SUPPORTS,
        feasible=FEASIBLE,
        summary=lotka_volterra_nine,
        truth=TRUTH,
        failures=("too_many_events",),
        summary_names=SUMMARY_NAMES,
        channels=("predators", "prey"),
        times=np.arange(process.intervals + 1) * process.interval,
    )
