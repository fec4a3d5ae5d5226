"""The exception for input that the user can correct. Commands print its message as one line and exit with code 2."""

import argparse
import atexit
import io
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from sira_mi.interrupts import INTERRUPTED, handle_interrupts, was_interrupted


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
    with 130 when the user interrupts it. Works without standard streams, and where they hold ASCII only."""
    _open_streams()
    with handle_interrupts():
        try:
            code = main() or 0
            sys.stdout.flush()
        except BrokenPipeError:  # who reads the output wants no more of it
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 1
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or was_interrupted():
                code = _end("interrupted", INTERRUPTED)
            elif isinstance(error, InputError):
                code = _end(f"error: {error}", 2)
            else:
                raise
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # until all libraries have shut down
    sys.exit(code)


def _end(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return code


def _open_streams() -> None:
    """Opens the standard streams that the process was started without on the null device, so that no file of the
    command gets their descriptors; characters that a stream cannot encode are written as escapes."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  (as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
