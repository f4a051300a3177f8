"""Errors of simulations."""


class SimulatorError(ValueError):
    """A simulator that breaks its contract, or fails always."""


class ExecutorError(SimulatorError):
    """Processes or a cluster that simulations went through and that are lost; what was simulated before is kept."""


class SimulatorWarning(UserWarning):
    """A simulator that can be used, but is hardly what was meant."""
