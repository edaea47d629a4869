"""Ctrl-C and requests to end: the program stops, prints a sentence, and keeps what is done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """The user, or the system, asks the program to end; no `Exception`, so that nothing catches it."""

    def __init__(self, number: int, message: str = "") -> None:
        super().__init__(message)
        self.number = number
        """Number of the signal."""
        self.message = message
        """The state of the work, and how to resume it."""

    @property
    def exit_code(self) -> int:
        """The exit code that shells use for a program that was ended by this signal."""
        return 128 + self.number


@contextmanager
def stoppable() -> Iterator[None]:
    """Inside the block a signal raises `Stopped`, once: a second one does not disturb the clean-up.

    Signals that the parent process ignores stay ignored; in other threads than the main one nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stopped = False

    def stop(number: int, _: FrameType | None) -> None:
        nonlocal stopped
        if not stopped:
            stopped = True
            raise Stopped(number)

    before = {number: signal.getsignal(number) for number in _SIGNALS}
    heard = [number for number in _SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])
