"""The processor as several devices of JAX, one a core, so that each takes its part of a batch of runs."""

import os

FLAG = "xla_force_host_platform_device_count"


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def divide(devices: int | None = None) -> None:
    """Let JAX see so many devices, by default one a core; call it before jax starts. A number already set is kept.

    XLA's threads become one more than devices. Each device takes one; the large arguments of a callback are copied by
    another, and where all were taken by callbacks, they would wait for the copies for ever.
    """
    devices = devices or processors()
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{FLAG}={devices}".strip()
        os.environ.setdefault("NPROC", str(max(processors(), devices + 1)))  # how XLA is told the number of threads
