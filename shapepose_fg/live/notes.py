"""Rate limit for the notes of a running service."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

_AT_ONCE = 10
"""Number of notes that are passed on at once before the limit applies."""


class SparingNotes(AbstractContextManager["SparingNotes"]):
    """Passes on the first ten notes, then one per second, with the number of skipped ones.

    A context manager; on exit it reports the remaining number.
    """

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note, self._said_s, self._more, self._left = (
            note,
            time.monotonic(),
            0,
            float(_AT_ONCE),
        )

    def __call__(self, text: str) -> None:
        now_s = time.monotonic()
        # One note a second; further ones are counted.
        self._left = min(self._left + now_s - self._said_s, float(_AT_ONCE))
        self._said_s = now_s
        if self._left < 1:
            self._more += 1
            return
        self._left -= 1
        self._count()
        self._note(text)

    def __exit__(self, *_error: object) -> None:
        self._count()

    def _count(self) -> None:
        if self._more > 0:
            self._note(f"{self._more} more notes were left out")
        self._more = 0
