"""What Ctrl-C does: it ends a command in one line, and a long computation at the end of a step.

A KeyboardInterrupt inside a call of Dr.Jit or Mitsuba comes out as another exception, a RuntimeError as a rule. So a
command asks `was_interrupted`, and a computation that has something to save postpones the interrupt."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType

# Exit code of a process that an interrupt has ended.
INTERRUPTED = 130
# A terminal and the program that runs the command may both pass the same Ctrl-C on.
_SAME_SECONDS = 1.0

_first: float | None = None  # when the first Ctrl-C came, by time.monotonic()
_postponed = False


@contextlib.contextmanager
def handle_interrupts() -> Iterator[None]:
    """Within it the first Ctrl-C raises KeyboardInterrupt, at once or where `check_interrupt` is called next. A second
    one, a second or more later, ends the process with exit code 130.

    Changes nothing in a thread that is not the main one, within another `handle_interrupts`, and where Ctrl-C is
    ignored, as by `nohup`."""
    global _first
    installed = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or installed in (signal.SIG_IGN, None, _on_interrupt):
        yield
        return
    _first = None
    signal.signal(signal.SIGINT, _on_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, installed)


@contextlib.contextmanager
def postpone_interrupts() -> Iterator[None]:
    """`handle_interrupts` in which only `check_interrupt` and the end of the block raise KeyboardInterrupt."""
    global _postponed
    with handle_interrupts():
        _postponed = True
        try:
            yield
            check_interrupt()
        finally:
            _postponed = False


def check_interrupt() -> None:
    """Raises KeyboardInterrupt when Ctrl-C came within this `postpone_interrupts`."""
    if _postponed and was_interrupted():
        raise KeyboardInterrupt


def was_interrupted() -> bool:
    """Whether Ctrl-C came within this `handle_interrupts`."""
    return _first is not None


def _on_interrupt(number: int, frame: FrameType | None) -> None:
    global _first
    now = time.monotonic()
    if _first is None:
        _first = now
        if not _postponed:
            raise KeyboardInterrupt
        _say("\ninterrupted: stops after this step; Ctrl-C again stops at once\n")
    elif now - _first > _SAME_SECONDS:
        _say("\ninterrupted\n")
        os._exit(INTERRUPTED)


def _say(text: str) -> None:
    """Writes to standard error past its buffer, which the interrupted code may be in the middle of using."""
    with contextlib.suppress(OSError):
        os.write(2, text.encode())
