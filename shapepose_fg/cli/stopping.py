"""Ctrl-C and requests to end: the program stops, prints a sentence, and keeps what is done."""

import signal
import sys
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

    Signals that the parent process ignores stay ignored; in other threads than the main one nothing changes. Where
    Python cannot pass an exception on (a finaliser was running), the signal comes again a moment later.
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

    def again(number: int) -> None:
        nonlocal stopped
        stopped = False
        signal.pthread_kill(threading.main_thread().ident or 0, number)

    later: list[threading.Timer] = []

    def lost(unraisable: "sys.UnraisableHookArgs") -> None:
        if not isinstance(unraisable.exc_value, Stopped):
            return report(unraisable)
        later.append(threading.Timer(0.01, again, [unraisable.exc_value.number]))
        later[-1].start()

    report, sys.unraisablehook = sys.unraisablehook, lost
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    heard = [number for number in _SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for timer in later:
            timer.cancel()
            timer.join()
        for number in heard:
            signal.signal(number, before[number])
        sys.unraisablehook = report
