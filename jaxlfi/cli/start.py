"""The program `jaxlfi`: everything after its first milliseconds, imports included, can be interrupted."""

import sys

from jaxlfi.cli import interrupts


def main() -> int:
    """Run the command line of this process; returns the exit status."""
    return interrupts.watched(_work)


def _work() -> int:
    from jaxlfi.cli import parser

    return parser.main(sys.argv[1:])
