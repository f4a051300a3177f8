"""A folder for one process at a time."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]  # nothing is locked there


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder, so that no other process writes results into it meanwhile.

    The lock is the system's, and on the folder itself: it leaves no file, moves with the folder, and ends with the
    process, however that ends. Where there are none (Windows, some network file systems), nothing is locked.

    Args:
        folder: that exists.

    Raises:
        BlockingIOError: where another process holds it.
    """
    if fcntl is None:
        yield
        return
    place = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BlockingIOError(
                f"{folder}: expected a folder that no other process works in, got one that another works in: wait "
                "for it to end, or stop it"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(place)
