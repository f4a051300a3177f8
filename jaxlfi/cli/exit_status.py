"""How a command ends: its exit status, and one line on stderr for bad input and interruptions."""

import sys
import traceback
from collections.abc import Callable


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
        print(f"{program}: error: {' '.join(str(error).split())}{go_on}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{program}: interrupted{advice()}", file=sys.stderr)
        return 130
    return 0
