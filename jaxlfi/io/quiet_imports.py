"""Imports of packages that print as they are imported."""

import contextlib
import io
from collections.abc import Iterator


@contextlib.contextmanager
def quiet_imports() -> Iterator[None]:
    """Suppress standard output, to which MJX, and so Brax, prints that Warp is not installed.

    Example:
        >>> with quiet_imports():
        ...     print("Failed to import warp")
    """
    with contextlib.redirect_stdout(io.StringIO()):
        yield
