"""How a command ends: its exit status, and one line on stderr for bad input, interruptions and warnings."""

import contextlib
import re
import shutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxlfi.cli import interrupts
from jaxlfi.io.shell import quoted
from jaxlfi.tasks.errors import ExecutorError


def one_line(error: Exception) -> str:
    """The message of an error of bad input, in one line; if a path caused it, with what was expected instead."""
    text = re.sub(r"\s*[\r\n]+\s*", " ", str(error)).strip() or type(error).__name__  # names keep their spaces
    of_path = getattr(error, "filename", None) is not None or text == "embedded null byte"
    return f"expected a file or folder that can be used, got {text}" if of_path and "expected" not in text else text


def exit_status(
    program: str, work: Callable[[], int | None], debug: bool = False, advice: Callable[[], str] = str
) -> int:
    """Do a command's work.

    Args:
        program: name of the command, for errors.
        work: function that raises ValueError, OSError or ImportError for bad input, and may return an exit status.
        debug: show where an error came from.
        advice: function that returns what to say after "interrupted" and about a failing disk; called only then.

    Returns:
        0, or what the work returned; 2 for bad input; 130 if it was interrupted.

    Raises:
        BrokenPipeError: if nobody reads the output.
    """
    with interrupts.advising(program, advice):
        try:
            return work() or 0
        except (ValueError, OSError, ImportError) as error:
            if interrupts.is_unread(error):
                raise
            go_on = advice() if isinstance(error, OSError) and not isinstance(error, BlockingIOError) else ""
            return refuse(program, error, debug, go_on)
        except KeyboardInterrupt:
            return interrupts.report()


def refuse(program: str, error: Exception, debug: bool = False, advice: str = "") -> int:
    """Report an error in one line with advice, and on request where it came from; returns 2."""
    if debug:
        traceback.print_exception(error)
    print(f"{program}: error: {one_line(error)}{advice}", file=sys.stderr)
    return 2


def resuming(folder: Path) -> str:
    """How to continue with a folder, for the end of a line."""
    return f"; continue with: {quoted('jaxlfi', 'resume', folder)}"


@contextlib.contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Print the package's own warnings as one line on stderr, without the place in the source; others are unchanged."""
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


@contextlib.contextmanager
def removed_if(folder: Path, empty: Callable[[], bool]) -> Iterator[None]:
    """Remove a folder that this command made if the command fails and left nothing to continue from.

    A full disk, a lost cluster and another process that continues the work are not the work's fault: in these cases the
    folder is kept, with all that it has.
    """
    try:
        yield
    except (ExecutorError, OSError):
        raise
    except Exception:
        if empty():
            shutil.rmtree(folder)
        raise
