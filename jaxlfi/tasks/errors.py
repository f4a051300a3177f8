"""Errors of simulations."""


class SimulatorError(ValueError):
    """A simulator that breaks its contract, or always fails."""


class ExecutorError(SimulatorError):
    """The processes or the cluster that made simulations are lost; what was simulated before is kept."""


class SimulatorWarning(UserWarning):
    """A simulator that can be used, but is unlikely to be what was meant."""
