"""What a run notes down for run.json, window by window: times, who is how probable, dropped, or not solved."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError

from shapepose_fg.core.detections import Input


@dataclass(frozen=True)
class Problem:
    """What went wrong with one joint of one person in one frame."""

    row: int
    """Row of the solution."""
    track: int
    """Who."""
    frame: int
    """When."""
    joint: int
    """Which joint, an index into the skeleton."""
    reason: str
    """What happened, in words."""


_Count = Annotated[int, Field(ge=0, lt=2**53)]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Frames = dict[str, list[_Count]]


class _Kept(BaseModel, extra="forbid"):
    """Notes as plain values."""

    frames: _Count
    seconds: dict[str, _Number]
    evidence: dict[_Count, tuple[_Number, Annotated[int, Field(gt=0)]]]
    probable: dict[str, _Count]
    dropped: _Frames
    thinned_frames: _Frames
    repeated_pictures: _Frames
    problems: list[Problem]
    factors: dict[str, tuple[_Count, _Count]] = {}


@dataclass
class Notes:
    """Notes about one window, or about a whole run."""

    frames: int = 0
    """Number of frames that the notes are about."""
    seconds: Counter[str] = field(default_factory=Counter)
    """Time per stage, over all processes."""
    evidence: dict[int, Sequence[float]] = field(default_factory=dict)
    """Sum of the evidence (`Observations.evidence`) of each track's rows, and the number of these rows."""
    probable: Counter[str] = field(default_factory=Counter)
    """Number of rows of single frames by their probability, in tenths rounded down."""
    dropped: dict[str, list[int]] = field(default_factory=dict)
    """The frames in which people were none, or too little is seen of, for each reason; a person, a frame."""
    thinned_frames: dict[str, list[int]] = field(default_factory=dict)
    """The frames of which something was left out, because it was too much."""
    repeated_pictures: dict[str, list[int]] = field(default_factory=dict)
    """The frames in which a camera, by its name, showed the picture before once more."""
    problems: list[Problem] = field(default_factory=list)
    """What could not be solved."""
    factors: dict[str, tuple[int, int]] = field(default_factory=dict)
    """How many factors each function of the user's made, and how many of them were inactive."""

    def add(self, other: "Notes") -> None:
        """Take in the notes of what comes next."""
        self.frames += other.frames
        for mine, more in ((self.seconds, other.seconds), (self.probable, other.probable)):
            mine.update(more)
        for kind in ("dropped", "thinned_frames", "repeated_pictures"):
            for name, frames in getattr(other, kind).items():
                getattr(self, kind).setdefault(name, []).extend(frames)
        for track, (evidence, rows) in other.evidence.items():
            before = self.evidence.get(track, [0.0, 0])
            self.evidence[track] = [before[0] + evidence, before[1] + rows]
        self.problems += other.problems
        for name, counts in other.factors.items():
            before = self.factors.get(name, (0, 0))
            self.factors[name] = before[0] + counts[0], before[1] + counts[1]

    def as_dict(self) -> dict[str, Any]:
        """Plain values; `from_dict` reads them back."""
        return {**vars(self), "problems": [asdict(each) for each in self.problems]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Notes":
        """What `as_dict` gave; ValueError where `values` are something else."""
        try:
            made: dict[str, Any] = vars(_Kept.model_validate(values))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            raise ValueError(f"notes: {'.'.join(map(str, problem['loc']))}: {problem['msg']}") from None
        return cls(**{**made, "seconds": Counter(made["seconds"]), "probable": Counter(made["probable"])})


class Notebook:
    """Notes that are being taken."""

    def __init__(self) -> None:
        self._notes = Notes()
        self._inner = 0.0
        self._frame: int | None = None
        self._searched: int | None = None

    def search(self, frame: int) -> None:
        """New people are sought in a frame, one of many that are looked at: what is thinned now is of this one."""
        self._searched = frame

    def thin(self, what: str, is_thinned: bool, frame: int | None = None) -> None:
        """Note down that some of a frame's detections, points or candidates were too many and left out."""
        frame = next((each for each in (frame, self._frame, self._searched) if each is not None), None)
        if is_thinned and frame is not None:
            noted = self._notes.thinned_frames.setdefault(what, [])
            noted += [frame] if frame not in noted[-1:] else []

    def repeat(self, cameras: Sequence[str], frame: int) -> None:
        """Note down the cameras whose picture of a frame is the one before."""
        for camera in cameras:
            self._notes.repeated_pictures.setdefault(camera, []).append(frame)

    def drop(self, reason: str, count: int) -> None:
        """Note down people of the present frame who were none, or too little is seen of.

        Over time there is no present frame: blocks of frames are looked at, each many times.
        """
        if self._frame is not None:
            self.drop_in(reason, [self._frame] * count)

    def drop_in(self, reason: str, frames: Sequence[int]) -> None:
        """Note down somebody who was not kept, in all of these frames."""
        self._notes.dropped.setdefault(reason, []).extend(frames)

    def watched(self, given: Sequence[Input]) -> Iterator[Input]:
        """Yield the frames; notes that are taken before the next one are about the frame yielded last."""
        for each in given:
            self._frame = each.frame
            yield each

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a block to a stage, but for that of stages inside it."""
        start, outside, self._inner = time.perf_counter(), self._inner, 0.0
        yield
        whole = time.perf_counter() - start
        self._notes.seconds[name] += whole - self._inner  # type: ignore[assignment]
        self._inner = outside + whole

    def torn_off(self) -> Notes:
        """What was noted since the last time, which is forgotten here."""
        notes, self._notes = self._notes, Notes()
        return notes
