"""Common clock of the cameras: it follows a jump only if most cameras jump together."""

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Given = TypeVar("Given")

JUMP_S = 2.0
"""Difference from the newest frame's time, s, above which a view's time is a jump; no lag is
longer."""


@dataclass
class CommonClock(Generic[Given]):
    """Holds back views with jumping times until other cameras confirm the jump.

    One camera, or one bad message, with a wrong time does not affect the others. After a pause of
    all cameras, or when their clock is set, the first views wait for those of the others, and are
    processed with them.
    """

    cameras: int
    """V, the number of cameras."""
    off: dict[int, int] = field(default_factory=dict)
    """By camera: number of consecutive views that were kept back."""
    _held: dict[int, tuple[float, Given]] = field(default_factory=dict)
    """By camera: the time and content of its newest view, if that is a jump."""
    _stay: set[int] = field(default_factory=set)
    """Cameras with a view that did not jump since the first one that is kept back."""
    _passed: int = 0
    """Number of views since the first one that is kept back."""
    _recent: deque[int] = field(default_factory=deque)
    """The cameras of the last views."""

    def admit(
        self, camera: int, time_s: float, now_s: float, given: Given
    ) -> tuple[list[Given], bool]:
        """The views to process now, in order of time, and whether the clock jumps with them.

        `given` is the content of the view of `camera` at `time_s`; `now_s` is the time of the
        newest frame, -inf before the first. If the view jumps and the others have not confirmed it,
        it is held back and the list is empty.
        """
        self._recent.append(camera)
        # Number of recent views, per camera, among which a camera must have one to
        # count as alive.
        if len(self._recent) > 4 * self.cameras:
            self._recent.popleft()
        if len(self._held) == 0:
            self._stay, self._passed = set(), 0
        self._passed += 1
        if not JUMP_S < abs(time_s - now_s) < float("inf"):
            self._held.pop(camera, None)
            self.off.pop(camera, None)
            self._stay.add(camera)
            return [given], False
        self._stay.discard(camera)
        self._held[camera] = time_s, given
        self.off[camera] = self.off.get(camera, 0) + 1
        # Maximum difference between the times of cameras that jump together, s.
        agree = [each for each, (at_s, _) in self._held.items() if abs(at_s - time_s) <= 1.0]
        # Number of views, per camera, during which active cameras may still confirm a
        # jump.
        waited = self._passed >= 2 * self.cameras or set(self._recent) <= set(agree)
        if len(agree) < 2 or len(agree) <= len(self._stay) or not waited:
            return [], False
        taken = [
            given
            for _, given in sorted((self._held[each] for each in agree), key=lambda each: each[0])
        ]
        self._held.clear()
        self.off.clear()
        return taken, True
