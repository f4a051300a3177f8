"""A plain NumPy Gillespie simulator of the Lotka-Volterra process, as a reference for the fast one.

It simulates one trajectory at a time, one event at a time, in float64, and is written straight from the description in
Papamakarios and Murray (2016) and Gillespie (1977). It shares no code with the simulator under test.
"""

import numpy as np

# Change of (predators, prey) by each reaction.
STOICHIOMETRY = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


def simulate(
    rng: np.random.Generator,
    log_rates: np.ndarray,
    initial: tuple[int, int] = (50, 100),
    duration: float = 30.0,
    interval: float = 0.2,
    max_events: int = 10_000,
    record: str = "after",
) -> np.ndarray | None:
    """The trajectory [records, 2], or None if it needs more than `max_events` events."""
    rates = np.exp(np.asarray(log_rates, np.float64))
    state = np.array(initial)
    grid = interval * np.arange(round(duration / interval) + 1)
    trajectory = np.zeros((len(grid), 2))
    trajectory[0] = state
    time, events = 0.0, 0
    before = state.copy()
    for i in range(1, len(grid)):
        while time < grid[i]:
            x, y = state
            propensities = rates * np.array([x * y, x, y, x * y])
            total = propensities.sum()
            before = state.copy()
            if total == 0:
                time = np.inf
                break
            if events == max_events:
                return None
            time += rng.exponential(1 / total)
            state = state + STOICHIOMETRY[rng.choice(4, p=propensities / total)]
            events += 1
        trajectory[i] = state if record == "after" else before
    return trajectory


def nine_summaries(trajectory: np.ndarray) -> np.ndarray:
    """The nine summaries [9] in float64; correlations of a constant series are NaN."""
    trajectory = np.asarray(trajectory, np.float64)
    n = len(trajectory)
    mean, variance = trajectory.mean(axis=0), trajectory.var(axis=0, ddof=1)
    with np.errstate(invalid="ignore"):
        x, y = ((trajectory - mean) / np.sqrt(variance)).T
    autocorrelations = [s[:-lag] @ s[lag:] / (n - 1) for s in (x, y) for lag in (1, 2)]
    return np.array([*mean, *np.log(variance + 1), *autocorrelations, x @ y / (n - 1)])
