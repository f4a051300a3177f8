"""A command of the program, ours or another package's: its name, its purpose, its arguments and its work.

This module imports neither jax nor numpy, and modules with commands should not either before a command runs, so that
`--help` answers at once.
"""

import argparse
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from jaxlfi.cli import multi_process
from jaxlfi.cli.exit_status import exit_status, refuse


class OneLineParser(argparse.ArgumentParser):
    """A parser with errors in one line and no abbreviated flags: `--seed 3` is not `--seeds 3`."""

    def __init__(self, **kwargs: Any):
        """The same as argparse's, by keywords."""
        super().__init__(**{**kwargs, "allow_abbrev": False})

    def error(self, message: str) -> NoReturn:
        """One line on stderr, and exit status 2."""
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())} (see {self.prog} --help)\n")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """The values of a flag; argparse takes the value of `--flag=--` for none, and accepts that there is none."""
        values = super()._get_values(action, arg_strings)
        if values == [] and action.option_strings and action.nargs in (None, "+"):
            raise argparse.ArgumentError(action, "expected at least one argument")
        return values


@dataclasses.dataclass(frozen=True)
class Command:
    """A command; called with the words after its name, it does its work and returns the exit status.

    Attributes:
        name: name of the command.
        help: description in one line, for a list of commands.
        arguments: function that adds its arguments to a parser; one called `debug` shows where an error came from.
        run: function that does its work. Errors of bad input are ValueError, OSError and ImportError; it may return an
            exit status.
        description: description at the beginning of its own help.
        epilog: examples at the end of its own help.
        begun: function that returns how to continue interrupted work, for the end of a line.

    Example:
        >>> def arguments(parser):
        ...     parser.add_argument("name")
        >>> greet = Command("greet", "say hello", arguments, lambda arguments: print(f"hello, {arguments.name}"))
        >>> greet(["there"])
        hello, there
        0
    """

    name: str
    help: str
    arguments: Callable[[argparse.ArgumentParser], Any]
    run: Callable[[argparse.Namespace], int | None]
    description: str = ""
    epilog: str = ""
    begun: Callable[[argparse.Namespace], str] = lambda arguments: ""

    def parser(self) -> argparse.ArgumentParser:
        """The parser of its own command line."""
        top = OneLineParser(prog=f"jaxlfi {self.name}", **self._texts())
        self.arguments(top)
        return top

    def add_to(self, commands: "argparse._SubParsersAction") -> None:
        """Add it to a program of several commands."""
        self.arguments(commands.add_parser(self.name, help=self.help, **self._texts()))

    def _texts(self) -> dict[str, Any]:
        formatter = argparse.RawDescriptionHelpFormatter if self.epilog else argparse.HelpFormatter
        return {"description": self.description, "epilog": self.epilog or None, "formatter_class": formatter}

    def __call__(self, words: Sequence[str] | None = None) -> int:
        """Do its work.

        Returns:
            0, or what its work returned; 2 for bad input; 130 if it was interrupted.
        """
        parser = self.parser()
        try:
            arguments = parser.parse_args(words)
        except ValueError as error:
            return refuse(parser.prog, error)
        debug, begun = getattr(arguments, "debug", False), lambda: self.begun(arguments)
        work = lambda: exit_status(parser.prog, lambda: self.run(arguments), debug, begun)
        if getattr(arguments, "coordinator", None) is None:
            return work()
        return multi_process.work(work, begun, parser.prog, debug)
