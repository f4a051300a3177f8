"""What results were made with: versions, platform and command line."""

import importlib.metadata
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

import jaxlfi

PACKAGES = ("jax", "jaxlib", "flax", "optax", "distrax", "numpy")


def environment() -> dict[str, Any]:
    """What a run was made with: versions, platform and command line."""
    return {
        "versions": versions(),
        "platform": {
            "system": platform.platform(),
            "processor": processor(),
            "backend": jax.default_backend(),
            "device": jax.devices()[0].device_kind,
            "cores": os.cpu_count(),
        },
        "command_line": command_line(sys.argv),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def versions() -> dict[str, str]:
    """Versions of Python, jaxlfi and the packages it computes with."""
    packages = {package: importlib.metadata.version(package) for package in PACKAGES}
    return {"python": platform.python_version(), "jaxlfi": jaxlfi.__version__} | packages


def command_line(argv: Sequence[str]) -> str:
    """A command as it is recorded with its results: without the folders of the machine it ran on.

    An absolute path is written relative to the working folder if it lies below it, and as its name alone otherwise.

    Example:
        >>> command_line(["/usr/bin/jaxlfi", "report", "/elsewhere/runs/edge"])
        'jaxlfi report edge'
    """

    def portable(argument: str) -> str:
        flag, equals, value = argument.partition("=") if argument.startswith("-") else ("", "", argument)
        path = Path(value)
        if not path.is_absolute():
            return argument
        inside = path.is_relative_to(Path.cwd())
        return flag + equals + (str(path.relative_to(Path.cwd())) if inside else path.name)

    return shlex.join([Path(argv[0]).name, *(portable(argument) for argument in argv[1:])])


def processor() -> str:
    """The processor's name as the system reports it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
