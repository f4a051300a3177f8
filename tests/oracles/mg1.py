"""A plain NumPy single-server queue, one event at a time, as a reference for the vectorised one.

It has a calendar of events and a line of waiting jobs, in float64. It uses no recursion formula for waiting or
departure times, and shares no code with the simulator under test.
"""

import heapq
from collections import deque

import numpy as np


def run_queue(service: np.ndarray, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Serve jobs first come, first served.

    Args:
        service: service time of each job, shape [J].
        gaps: time between arrivals, the first since time 0, shape [J].

    Returns:
        times between departures (the first since time 0) and waits between arrival and start of service, [J] each.
    """
    service, arrivals = np.asarray(service, np.float64), np.cumsum(np.asarray(gaps, np.float64))
    calendar = [(time, 0, job) for job, time in enumerate(arrivals)]  # 0: a job arrives, 1: the server is done
    heapq.heapify(calendar)
    line, busy = deque(), False
    departures, waits = [], np.zeros(len(service))
    while calendar:
        now, done, job = heapq.heappop(calendar)
        if done:
            departures.append(now)
            busy = False
        else:
            line.append(job)
        if line and not busy:
            following = line.popleft()
            waits[following] = now - arrivals[following]
            heapq.heappush(calendar, (now + service[following], 1, following))
            busy = True
    return np.diff(departures, prepend=0.0), waits


def simulate(rng: np.random.Generator, theta: np.ndarray, jobs: int = 50) -> np.ndarray:
    """Times between departures [J] for service bounds theta_1, theta_2 (in either order) and arrival rate theta_3."""
    low, high = sorted(theta[:2])
    return run_queue(rng.uniform(low, high, jobs), rng.exponential(1 / theta[2], jobs))[0]
