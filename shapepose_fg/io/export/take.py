"""The input of exports: the people of a result on one timeline, each with an entry for every
frame.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Axis, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import LEAST_FPS, MOST_FPS, rate_of, typed_rate
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction
from shapepose_fg.core.result_files import check_memory
from shapepose_fg.core.run_summary import covered_frames, has_identities

_BODY_BYTES = 2_000
"""Approximate memory for one person's body per frame during export, bytes."""
_OF_JOINTS = ("joints", "covariance", "velocity", "velocity_covariance")
"""Columns of joints that `seen_only` sets to NaN if no view detected the joint; the columns of
`BODY` are NaN if no view detected the person."""


@dataclass(frozen=True)
class Take:
    """P people in T frames; a person may be missing in some frames."""

    people: Reconstruction
    """The rows; joints that are left out are NaN."""
    persons: NDArray[np.int64]
    """(P,) identities."""
    rows: Index
    """(P, T) row of `people` for each person and frame; -1 if there is none."""
    frames: NDArray[np.int64]
    """(T,) numbers of the frames, as in people.npz."""
    times_s: Array
    """(T,) increasing times of the frames, seconds."""
    fps: float
    """Frame rate, Hz (`rate_of`)."""
    up: Axis
    """Axis of the world that points up."""
    rig: Rig | None = None
    """The cameras; None if unknown."""

    @classmethod
    def of(
        cls,
        people: Reconstruction,
        up: Axis,
        *,
        rig: Rig | None = None,
        fps: float | None = None,
        seen_only: bool = False,
        identities: bool = True,
    ) -> "Take":
        """Make a take from a result; ValueError if it has no timeline.

        `fps` replaces the times of the result, and is required if these are unknown. `seen_only`
        leaves out every joint that no view detected in the frame, and the body if no joint was
        detected. With `identities` False, results without identities are accepted; `person` is then
        a number within the frame.
        """
        if len(people) == 0:
            raise ValueError("the result has no people, so there is nothing to export")
        if identities and not has_identities(people.run):
            raise ValueError(
                "this result is frame by frame and has no identities; reconstruct with "
                "--temporal, or export csv or rrd"
            )
        people = _seen(people) if seen_only else people
        # All reconstructed frames, including those without people.
        spans = [np.arange(span.start, span.stop) for span in covered_frames(people.run) or []]
        frames = np.unique(np.concatenate([people.frame, *spans])).astype(np.int64)
        persons, person = np.unique(people.person, return_inverse=True)
        _check_memory(len(persons), len(frames))
        rows = np.full((len(persons), len(frames)), -1, dtype=np.intp)
        place = np.searchsorted(frames, people.frame)
        rows[person, place] = np.arange(len(people))
        lost = np.flatnonzero(rows[person, place] != np.arange(len(people)))
        if len(lost) > 0:
            raise ValueError(
                f"person {people.person[lost[0]]} has two rows of frame {people.frame[lost[0]]}; "
                "correct them with `shapepose-fg tracks`"
            )
        times = _times(people, frames, fps)
        steps = np.diff(times) / np.diff(frames)
        if len(steps) > 0 and not 1 / MOST_FPS <= np.median(steps) <= 1 / LEAST_FPS:
            raise ValueError(f"frames are {np.median(steps):g} s apart by time_s; give --fps")
        rate = rate_of(times) if len(steps) > 0 else typed_rate(fps or _fps_of(people))
        return cls(people, persons.astype(np.int64), rows, frames, times, rate, up, rig)

    def column(self, name: str, person: int) -> NDArray[Any]:
        """(T, ...) a column of the result for one person; NaN (0 for integers) in frames without a
        row.
        """
        values, rows = getattr(self.people, name), self.rows[person]
        column = np.full(
            (len(rows), *values.shape[1:]), np.nan if values.dtype.kind == "f" else 0, values.dtype
        )
        column[rows >= 0] = values[rows[rows >= 0]]
        return column

    def near_origin(self) -> tuple["Take", Array]:
        """The take shifted to a local origin for single-precision formats, and that origin (3,), in
        whole metres of the world.

        In single precision, coordinates 400 km from the origin have steps of centimetres. The local
        origin is that of the world if no joint is farther than a kilometre from it.
        """
        every = self.people.joints.reshape(-1, 3)
        every = np.concatenate([every[np.isfinite(every).all(axis=1)], self.people.transl])
        every = every[np.isfinite(every).all(axis=1)]
        # Largest coordinate, m, that single precision represents to a tenth of a
        # millimetre.
        if len(every) == 0 or np.abs(every).max() <= 1000.0:
            return self, np.zeros(3)
        origin = np.rint(np.median(every, axis=0))
        people = replace(
            self.people, joints=self.people.joints - origin, transl=self.people.transl - origin
        )
        return replace(
            self, people=people, rig=None if self.rig is None else _moved(self.rig, origin)
        ), origin

    def at_one_rate(self) -> tuple["Take", int]:
        """The take at exactly `fps` frames a second, for formats with a constant rate, and the
        number of dropped frames.

        Each frame is assigned to the nearest time step, counted from the first; steps without a
        frame are gaps. A frame is dropped if another one is nearer to its step. InputError for more
        than a million frames.
        """
        step = (self.times_s - self.times_s[0]) * self.fps
        # Maximum number of frames of a file with a constant rate: nine hours at 30 Hz.
        # With more frames, the times have a wrong unit or a gap.
        if step[-1] >= 1_000_000:
            raise InputError(
                f"people.npz: the times cover {self.times_s[-1] - self.times_s[0]:.0f} s, which is"
                f" {step[-1]:.0f} frames at {self.fps:g} Hz; give --fps, or a part with --frames"
            )
        place = np.rint(step).astype(np.intp)
        nearest = np.lexsort((np.abs(step - place), place))
        kept = nearest[np.unique(place[nearest], return_index=True)[1]]
        count = int(place[-1]) + 1
        _check_memory(len(self.persons), count)
        rows = np.full((len(self.persons), count), -1, dtype=np.intp)
        rows[:, place[kept]] = self.rows[:, kept]
        numbers, start = np.arange(count), self.times_s[0]
        even = replace(
            self, rows=rows, frames=self.frames[0] + numbers, times_s=start + numbers / self.fps
        )
        return even, len(place) - len(kept)


def _moved(rig: Rig, origin: Array) -> Rig:
    """The cameras and their trajectories relative to a new `origin` (3,), metres."""

    def local(pose: Array) -> Array:
        shifted = pose.copy()
        shifted[..., :3, 3] -= origin
        return shifted

    trajectories = tuple(replace(each, wTb=local(each.wTb)) for each in rig.trajectories)
    return replace(rig.at_poses(local(rig.wTc)), trajectories=trajectories)


def _check_memory(persons: int, frames: int) -> None:
    """Raise InputError if the joints of all people in all frames, and one person's body, do not fit
    in memory.
    """
    what = f"people.npz: {persons} people over {frames} frames"
    check_memory(what, frames * (2 * 8 * persons + _BODY_BYTES), "--frames, --person")


def _seen(people: Reconstruction) -> Reconstruction:
    """The people with joints that no view detected set to NaN."""
    if not (people.known != Known.UNKNOWN).any():
        raise ValueError("people.npz does not contain how joints are known; leave out --seen-only")
    seen = Known.observed(people.known)
    columns: dict[str, Any] = {
        "known": np.where(seen, people.known, Known.UNKNOWN).astype(np.uint8)
    }
    for names, kept in ((_OF_JOINTS, seen), (BODY, seen.any(axis=1))):
        for name in names:
            value = getattr(people, name)
            columns[name] = np.where(
                kept.reshape(*kept.shape, *[1] * (value.ndim - kept.ndim)), value, np.nan
            )
    return replace(people, **columns)


def _times(people: Reconstruction, frames: NDArray[np.int64], fps: float | None) -> Array:
    """Times of the frames; frames without a row are interpolated."""
    if fps is not None:
        return frames / typed_rate(fps)
    known, first = np.unique(people.frame, return_index=True)
    times = people.time_s[first]
    known, times = known[np.isfinite(times)], times[np.isfinite(times)]
    if len(known) == 0:
        raise ValueError("people.npz does not contain the times of its frames; give --fps")
    if (np.diff(times) <= 0).any():
        raise ValueError("time_s does not increase from frame to frame; give --fps")
    rate = (known[-1] - known[0]) / (times[-1] - times[0]) if len(known) > 1 else _fps_of(people)
    between = np.interp(frames, known, times)
    return between + (np.minimum(frames - known[0], 0) + np.maximum(frames - known[-1], 0)) / rate


def _fps_of(people: Reconstruction) -> float:
    """Frame rate according to run.json, Hz."""
    fps = people.run.get("time", {}).get("fps")
    if fps is None or not fps > 0:
        raise ValueError("one frame does not determine the frame rate; give --fps")
    return float(fps)
