"""The exception for input that the user can correct. Commands print its message as one line and exit with code 2."""

import argparse
import sys
from collections.abc import Callable
from typing import NoReturn


class InputError(Exception):
    """Bad input. The message is one line that says what is wrong and what to do."""


class CommandParser(argparse.ArgumentParser):
    """An argument parser that raises InputError."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; --help lists the options")


def run_command(main: Callable[[], int | None]) -> None:
    """Runs a command's `main` and exits: with its return value or 0, with 2 and one line on stderr for an InputError,
    with 130 when the user interrupts it."""
    try:
        sys.exit(main() or 0)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
