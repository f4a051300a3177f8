"""The command `jaxlfi r2s2r`: the loop of the task that its first word names, or else of the whip.

This module imports neither jax nor numpy, so that `--help` answers at once.
"""

import argparse
import sys
from collections.abc import Sequence

from jaxlfi.cli.command import Command
from jaxlfi.cli.exit_status import refuse
from jaxlfi.registry import LOOPS

WHIP = "whip"


class Loops:
    """Loops by the name of their task.

    Attributes:
        help: description in one line, for a list of commands.
    """

    help = "run the full Real2Sim2Real loop on a machine or a reference object"

    def parser(self) -> argparse.ArgumentParser:
        """The command line of the whip's loop, which mentions others."""
        return LOOPS.find(WHIP).parser()

    def chosen(self, words: Sequence[str]) -> tuple[Command, list[str]]:
        """The loop that words select, and its own words.

        Raises:
            ValueError: for a task without a loop.
        """
        words = list(words)
        named = bool(words) and not words[0].startswith("-")
        loop = LOOPS.find(words[0].partition(",")[0] if named else WHIP)
        return loop, words if named and "," in words[0] else words[named:]

    def __call__(self, words: Sequence[str] | None = None) -> int:
        """Run a loop.

        Returns:
            0; 2 for bad input; 130 if it was interrupted.
        """
        try:
            loop, own = self.chosen(sys.argv[1:] if words is None else words)
        except ValueError as error:
            return refuse("jaxlfi r2s2r", error)
        return loop(own)


main = Loops()
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
