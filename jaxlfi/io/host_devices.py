"""Present the processor to JAX as several devices, one per core, so that each takes its part of a batch of runs."""

import os

FLAG = "xla_force_host_platform_device_count"


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def divide(devices: int | None = None) -> None:
    """Let JAX see so many devices, by default one per core; call this before jax starts. A number already set is kept.

    Through the environment variable NPROC, XLA's pool gets at least one thread more than there are devices. Each device
    occupies one, and a callback's large arguments are copied by another of the same pool: with all threads in
    callbacks, the program would deadlock.
    """
    devices = devices or processors()
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{FLAG}={devices}".strip()
        os.environ.setdefault("NPROC", str(max(processors(), devices + 1)))
