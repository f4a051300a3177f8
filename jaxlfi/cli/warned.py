"""Warnings of the package as the command line prints them: one line each."""

import contextlib
import sys
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def in_lines() -> Iterator[None]:
    """Print the package's own warnings as one line on stderr, without the place in the source; others as ever."""
    shown = warnings.showwarning

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        if category.__module__.partition(".")[0] == "jaxlfi":
            print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            shown(message, category, filename, lineno, file, line)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = shown
