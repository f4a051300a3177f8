"""Command lines to be pasted into a shell."""

import shlex
from pathlib import Path


def quoted(*words: str | Path) -> str:
    """A command whose words a shell reads as they are.

    Args:
        words: the program and its arguments; a path that begins with a hyphen must not be taken for a flag.

    Example:
        >>> print(quoted("jaxlfi", "resume", Path("runs/my rope")))
        jaxlfi resume 'runs/my rope'
    """
    dashed = lambda word: isinstance(word, Path) and str(word).startswith("-")
    return shlex.join(f"./{word}" if dashed(word) else str(word) for word in words)
