"""Tables and the figure, from saved arrays."""

from pathlib import Path


def write(out: Path) -> None:
    pass
