"""How a command ends: its exit status, and one line on stderr for bad input and interruptions."""

import sys
import traceback
from collections.abc import Callable


def one_line(error: Exception) -> str:
    """What an error of bad input says, in one line; where a path caused it, what was expected instead."""
    text = " ".join(str(error).split()) or type(error).__name__
    of_path = getattr(error, "filename", None) is not None or text == "embedded null byte"
    return f"expected a file or folder that can be used, got {text}" if of_path and "expected" not in text else text


def exit_status(program: str, work: Callable[[], None], debug: bool = False, advice: Callable[[], str] = str) -> int:
    """Do a command's work.

    Args:
        program: its name, for errors.
        work: raises ValueError, OSError or ImportError for bad input.
        debug: show where an error came from.
        advice: what to say after "interrupted", and of a failing disk; asked then.

    Returns:
        0; 2 for bad input; 130 where it was interrupted.
    """
    try:
        work()
    except (ValueError, OSError, ImportError) as error:
        if debug:
            traceback.print_exception(error)
        go_on = advice() if isinstance(error, OSError) and not isinstance(error, BlockingIOError) else ""
        print(f"{program}: error: {one_line(error)}{go_on}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{program}: interrupted{advice()}", file=sys.stderr)
        return 130
    return 0
