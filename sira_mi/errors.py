"""The one exception for input that a user can mend; commands print it as one line and exit with code 2."""

import argparse
import sys
from collections.abc import Callable


class InputError(Exception):
    """Bad input: the message is one clear line that says what was wrong and what to do."""


class CommandParser(argparse.ArgumentParser):
    """A parser of command lines whose errors are `InputError`s."""

    def error(self, message):
        raise InputError(f"{message}; --help lists the options")


def run_command(main: Callable[[], int | None]) -> None:
    """Runs a command's `main` and exits: its return value or 0; 2 with one line on stderr for an `InputError`;
    130 when the user interrupts before there is anything to keep."""
    try:
        sys.exit(main() or 0)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
