"""Handles Ctrl-C and SIGTERM: the program stops, prints a sentence, and saves finished work."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """Request by the user or the system to end the program. It is not an `Exception`, so that
    handlers of errors do not catch it.
    """

    def __init__(self, number: int, message: str = "") -> None:
        super().__init__(message)
        self.number = number
        """Number of the signal."""
        self.message = message
        """The state of the work, and how to resume it."""

    @property
    def exit_code(self) -> int:
        """Exit code for termination by this signal, as in shells."""
        return 128 + self.number


@contextmanager
def stoppable() -> Iterator[None]:
    """Inside the block, the first signal raises `Stopped`; further ones are ignored, so that they
    do not interrupt the clean-up.

    Signals that the parent process ignores stay ignored; outside the main thread nothing changes.
    If Python cannot propagate the exception (because a finaliser is running), the signal is sent
    again a moment later, or the exception is raised at the end of the block. If a library made
    another exception of it (such as an ImportError while its compiled module begins), that one is
    replaced by it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        if stopped:
            return
        stopped = True
        while frame is not None and frame.f_code is not lost.__code__:
            frame = frame.f_back
        if frame is None:
            raise Stopped(number)
        send_later(number)  # an exception of `lost` would be lost, too

    def again(number: int) -> None:
        nonlocal stopped
        stopped = False
        missed.clear()
        signal.pthread_kill(threading.main_thread().ident or 0, number)

    later: list[threading.Timer] = []
    missed: list[int] = []

    def send_later(number: int) -> None:
        missed.append(number)
        later.append(threading.Timer(0.01, again, [number]))
        later[-1].start()

    def settle() -> None:
        for timer in later:
            timer.cancel()
            timer.join()

    def lost(unraisable: "sys.UnraisableHookArgs") -> None:
        if not isinstance(unraisable.exc_value, Stopped):
            return report(unraisable)
        send_later(unraisable.exc_value.number)

    report, sys.unraisablehook = sys.unraisablehook, lost
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    heard = [number for number in _SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, stop)
    try:
        yield
        settle()
        if missed:
            raise Stopped(missed[0])
    except Exception as error:
        if (cause := _stop_behind(error)) is not None:
            raise cause from None
        raise
    finally:
        settle()
        for number in heard:
            signal.signal(number, before[number])
        sys.unraisablehook = report


def _stop_behind(error: BaseException) -> Stopped | None:
    """The `Stopped` from which an exception was made; None if there is none."""
    behind, seen = error, set[int]()
    while behind is not None and not isinstance(behind, Stopped) and id(behind) not in seen:
        seen.add(id(behind))
        behind = behind.__cause__ or behind.__context__
    return behind if isinstance(behind, Stopped) else None
