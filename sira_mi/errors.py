"""The exception for input that the user can correct. Commands print its message as one line and exit with code 2."""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn


class InputError(Exception):
    """Bad input. The message is one line that says what is wrong and what to do."""


class CommandParser(argparse.ArgumentParser):
    """An argument parser that raises InputError."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; --help lists the options")


def check_range(name: str, value: float | None, low: float, high: float) -> None:
    """Raises InputError when an option's value is below `low`, above `high` or NaN; None is an option not given."""
    if value is not None and not low <= value <= high:
        raise InputError(f"--{name} is {value}; it must be {low} to {high}")


def check_writable(folder: Path) -> None:
    """Raises InputError when no file can be written to the folder of the option `--out`."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another --out") from error


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
