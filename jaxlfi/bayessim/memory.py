"""How many runs of a batch fit in the available memory."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

PROGRAM_PER_STATE = 10
"""Bytes that a compiled round needs per byte of its runs' states: 7 for the `quick` preset on Lotka-Volterra."""
FRACTION = 0.6
"""Fraction of the free memory that a batch may use: other processes need some, and its size is an estimate."""


def state_bytes(tree: Any) -> int:
    """Bytes of a pytree of arrays, or of their shapes."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def budget() -> float:
    """Bytes that a batch may use on each device."""
    return FRACTION * free_memory(jax.local_devices())


def even_length(size: int, most: int, devices: int) -> int:
    """The length of the fewest equal chunks of at most `most` runs, if possible a multiple of the devices.

    Example:
        >>> even_length(size=27, most=20, devices=2)
        14
    """
    step = devices if most >= devices else 1
    chunks = math.ceil(size / (most // step * step))
    return min(size, step * math.ceil(size / chunks / step))


def free_memory(devices: Sequence[Any]) -> float:
    """Bytes free on each device; the devices of a CPU share the machine's memory."""
    stats = [device.memory_stats() for device in devices]
    if all(stats):
        return min(own["bytes_limit"] - own["bytes_in_use"] for own in stats)
    return _host_memory() / len(devices)


def _host_memory() -> float:
    """Bytes that the system reports as available, within the limit of the control group."""
    free = [0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]  # if the system reports nothing better
    meminfo, group = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
    if meminfo.exists():
        free = [
            1024.0 * int(line.split()[1])
            for line in meminfo.read_text().splitlines()
            if line.startswith("MemAvailable")
        ]
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        free.append(float(int(limit) - int(used)))
    except (OSError, ValueError):  # no control group, or one without a limit ("max")
        pass
    return min(free)
