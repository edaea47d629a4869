"""Notes of a run for run.json, window by window: times, evidence, dropped people, unsolved
joints.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, ClassVar

from pydantic import (
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveInt,
    TypeAdapter,
    ValidationError,
)

from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.detections import Input


@dataclass(frozen=True)
class Problem:
    """A problem with one joint of one person in one frame."""

    row: int
    """Row of the solution."""
    track: int
    """The track."""
    frame: int
    """The frame."""
    joint: int
    """Index of the joint."""
    reason: str
    """Description of the problem."""


_Count = Annotated[NonNegativeInt, Field(le=MOST_NUMBER)]
_Frames = dict[str, list[_Count]]


@dataclass
class Notes:
    """Notes about one window, or about a whole run."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    frames: _Count = 0
    """Number of frames that the notes are about."""
    seconds: dict[str, FiniteFloat] = field(default_factory=dict)
    """Time per stage, s, summed over all processes."""
    evidence: dict[_Count, tuple[FiniteFloat, PositiveInt]] = field(default_factory=dict)
    """By track: sum of the evidence (`Observations.evidence`) of its rows, and number of these
    rows."""
    probable: dict[str, _Count] = field(default_factory=dict)
    """For frame-by-frame results: number of rows by probability, rounded down to tenths."""
    dropped: _Frames = field(default_factory=dict)
    """Frames in which people were dropped, by reason; one entry per dropped person."""
    thinned_frames: _Frames = field(default_factory=dict)
    """Frames in which there were too many detections, points or candidates and some were left out,
    by kind."""
    repeated_pictures: _Frames = field(default_factory=dict)
    """Frames in which a camera, by its name, repeated the previous picture."""
    problems: list[Problem] = field(default_factory=list)
    """Problems with joints."""
    factors: dict[str, tuple[_Count, _Count]] = field(default_factory=dict)
    """By user function: number of factors that it made, and number of these that were inactive."""

    def add(self, other: "Notes") -> None:
        """Add the notes of later frames."""
        for name, more in vars(other).items():
            setattr(self, name, _sum(getattr(self, name), more))

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; `from_dict` is the inverse."""
        return {**vars(self), "problems": [asdict(each) for each in self.problems]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Notes":
        """Make notes from the result of `as_dict`; ValueError for other values."""
        try:
            return TypeAdapter(cls).validate_python(values)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            raise ValueError(
                f"notes: {'.'.join(map(str, problem['loc']))}: {problem['msg']}"
            ) from None


def _sum(one: Any, other: Any) -> Any:
    """Numbers added, lists joined; of tuples and dicts entry by entry."""
    if isinstance(one, tuple):
        return tuple(map(_sum, one, other))
    if not isinstance(one, dict):
        return one + other
    both = {name: _sum(one[name], more) if name in one else more for name, more in other.items()}
    return one | both


class Notebook:
    """Collects notes while the pipeline runs."""

    def __init__(self) -> None:
        self._notes = Notes()
        self._inner = 0.0
        self._frame: int | None = None
        self._searched: int | None = None

    def search(self, frame: int) -> None:
        """Set the frame to which notes on thinning belong: the one in which new people are being
        searched for.
        """
        self._searched = frame

    def thin(self, what: str, is_thinned: bool, frame: int | None = None) -> None:
        """Note that some detections, points or candidates of a frame were left out because there
        were too many.
        """
        frame = next(
            (each for each in (frame, self._frame, self._searched) if each is not None), None
        )
        if is_thinned and frame is not None:
            noted = self._notes.thinned_frames.setdefault(what, [])
            noted += [frame] if frame not in noted[-1:] else []

    def repeat(self, cameras: Sequence[str], frame: int) -> None:
        """Note the cameras whose picture of a frame repeats the previous one."""
        for camera in cameras:
            self._notes.repeated_pictures.setdefault(camera, []).append(frame)

    def drop(self, reason: str, count: int) -> None:
        """Note that people of the current frame were dropped: false positives, or too few
        detections.

        With tracking there is no current frame, because blocks of frames are read several times:
        see `drop_in`.
        """
        if self._frame is not None:
            self.drop_in(reason, [self._frame] * count)

    def drop_in(self, reason: str, frames: Sequence[int]) -> None:
        """Note that a person was dropped in all `frames`."""
        self._notes.dropped.setdefault(reason, []).extend(frames)

    def watched(self, given: Sequence[Input]) -> Iterator[Input]:
        """Yield the frames, and set the current frame for the notes that are taken until the next
        one.
        """
        for each in given:
            self._frame = each.frame
            yield each

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage, without that of stages inside it."""
        start, outside, self._inner = time.perf_counter(), self._inner, 0.0
        yield
        whole = time.perf_counter() - start
        self._notes.seconds[name] = self._notes.seconds.get(name, 0.0) + whole - self._inner
        self._inner = outside + whole

    def flush(self) -> Notes:
        """Return the notes since the last call, and start new ones."""
        notes, self._notes = self._notes, Notes()
        return notes
