"""The program `jaxlfi`: everything after its first milliseconds, imports included, can be interrupted."""

import os
import sys

from jaxlfi.cli import interrupts


def main() -> int:
    """Run the command line of this process; returns the exit status."""
    return interrupts.watched(_work)


def _work() -> int:
    from jaxlfi.cli import parser

    if "_ARGCOMPLETE" in os.environ:  # a shell asks for completions
        import argcomplete

        argcomplete.autocomplete(parser.parser())
    return parser.main(sys.argv[1:])
