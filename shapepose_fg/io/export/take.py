"""The people of a result on one timeline, each with a row for every frame: the input of exports."""

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
from shapepose_fg.core.run_summary import covered_frames

_TO_Y_UP: dict[Axis, list[list[int]]] = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
"""The smallest rotation that takes each axis to y."""
_Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""(x, y, z) to (x, -z, y): the rotation that Blender's importers apply to a file whose y is up."""
_FORWARD_X = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""Rotation about y, with which a world whose z is up becomes (y, z, x), as Pose2Sim writes it."""
_LONGEST = 1_000_000
"""Maximum number of frames of a file with one rate: nine hours at 30 Hz. Beyond, times have another unit or a
hole."""
_BODY_BYTES = 2_000
"""Approximate memory of one person's body per frame while it is written, bytes."""
_OF_JOINTS = ("joints", "covariance", "velocity", "velocity_covariance")
"""Columns of a result that are NaN where no view saw a joint; those of `BODY` are where none saw the person."""
_FAR_M = 1000.0
"""Largest coordinate that a float of 32 bits keeps to a tenth of a millimetre, metres."""


@dataclass(frozen=True)
class Take:
    """P people over T frames; a person's row of a frame may be missing."""

    people: Reconstruction
    """The rows; joints that are left out are NaN in it."""
    persons: NDArray[np.int64]
    """(P,) identities."""
    rows: Index
    """(P, T) row of `people` of each person in each frame; -1 where there is none."""
    frames: NDArray[np.int64]
    """(T,) numbers of the frames, as in people.npz."""
    times_s: Array
    """(T,) rising times of the frames, seconds."""
    fps: float
    """Frame rate, Hz (`rate_of`)."""
    up: Axis
    """Axis of the world that points up."""
    rig: Rig | None = None
    """The cameras; None where they are unknown."""

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
        """The timeline of a result; ValueError where it has none.

        `fps` replaces the result's own times, and is needed where these are unknown. `seen_only` leaves out every
        joint that no view saw in that frame, and the bodies of rows where none was seen. With `identities` off, a
        result without identities is a Take too: a person is then a number within the frame.
        """
        if len(people) == 0:
            raise ValueError("the result has no people, so there is nothing to export")
        if identities and not people.run.get("configuration", {}).get("temporal", True):
            raise ValueError(
                "this result is frame by frame and has no identities; reconstruct with --temporal, or export"
                " csv or rrd"
            )
        people = _seen(people) if seen_only else people
        # All frames that were reconstructed, those without people too.
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
                f"person {people.person[lost[0]]} has two rows of frame {people.frame[lost[0]]}; correct them"
                " with `shapepose-fg tracks`"
            )
        times = _times(people, frames, fps)
        steps = np.diff(times) / np.diff(frames)
        if len(steps) > 0 and not 1 / MOST_FPS <= np.median(steps) <= 1 / LEAST_FPS:
            raise ValueError(f"frames are {np.median(steps):g} s apart by time_s; give --fps")
        rate = rate_of(times) if len(steps) > 0 else typed_rate(fps or _fps_of(people))
        return cls(people, persons.astype(np.int64), rows, frames, times, rate, up, rig)

    def column(self, name: str, person: int) -> NDArray[Any]:
        """(T, ...) a column of the result for one person; NaN, 0 in whole numbers, where there is no row."""
        values, rows = getattr(self.people, name), self.rows[person]
        column = np.full((len(rows), *values.shape[1:]), np.nan if values.dtype.kind == "f" else 0, values.dtype)
        column[rows >= 0] = values[rows[rows >= 0]]
        return column

    def near_origin(self) -> tuple["Take", Array]:
        """Return these people and cameras in the frame of a local origin, and (3,) that origin, whole metres of
        the world.

        It is for formats of seven digits, whose steps are centimetres 400 km from the world's origin. The local
        origin is the world's where no joint is farther than a kilometre from that.
        """
        every = self.people.joints.reshape(-1, 3)
        every = np.concatenate([every[np.isfinite(every).all(axis=1)], self.people.transl])
        every = every[np.isfinite(every).all(axis=1)]
        if len(every) == 0 or np.abs(every).max() <= _FAR_M:
            return self, np.zeros(3)
        origin = np.rint(np.median(every, axis=0))
        people = replace(self.people, joints=self.people.joints - origin, transl=self.people.transl - origin)
        return replace(self, people=people, rig=None if self.rig is None else _moved(self.rig, origin)), origin

    def at_one_rate(self) -> tuple["Take", int]:
        """Return these people at exactly `fps` frames a second, for formats that know no other rate, and a count.

        A frame goes to the nearest step, numbered on from the first; steps that no frame is near to are holes. The
        count is the number of frames left out because another is nearer to their step. InputError where that would
        be more than a million frames.
        """
        step = (self.times_s - self.times_s[0]) * self.fps
        if step[-1] >= _LONGEST:
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
        even = replace(self, rows=rows, frames=self.frames[0] + numbers, times_s=start + numbers / self.fps)
        return even, len(place) - len(kept)


def _moved(rig: Rig, origin: Array) -> Rig:
    """The cameras and their trajectories in a world whose origin is `origin` (3,) of theirs."""

    def local(pose: Array) -> Array:
        shifted = pose.copy()
        shifted[..., :3, 3] -= origin
        return shifted

    trajectories = tuple(replace(each, wTb=local(each.wTb)) for each in rig.trajectories)
    return replace(rig.at_poses(local(rig.wTc)), trajectories=trajectories)


def _check_memory(persons: int, frames: int) -> None:
    """InputError where joints of all people in all frames, and one person's body, do not fit in memory."""
    what = f"people.npz: {persons} people over {frames} frames"
    check_memory(what, frames * (2 * 8 * persons + _BODY_BYTES), "--frames, --person")


def _seen(people: Reconstruction) -> Reconstruction:
    """The people without joints that no view saw."""
    if not (people.known != Known.UNKNOWN).any():
        raise ValueError("people.npz does not contain how joints are known; leave out --seen-only")
    seen = Known.observed(people.known)
    columns: dict[str, Any] = {"known": np.where(seen, people.known, Known.UNKNOWN).astype(np.uint8)}
    for names, kept in ((_OF_JOINTS, seen), (BODY, seen.any(axis=1))):
        for name in names:
            value = getattr(people, name)
            columns[name] = np.where(kept.reshape(*kept.shape, *[1] * (value.ndim - kept.ndim)), value, np.nan)
    return replace(people, **columns)


def _times(people: Reconstruction, frames: NDArray[np.int64], fps: float | None) -> Array:
    """Times of the frames: frames without a row lie between those with one."""
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


def y_up(up: Axis) -> Array:
    """(3, 3) rotation from a world with the axis `up` upwards to y up: BVH and glTF.

    Z up becomes (x, z, -y), which Blender's importers undo: there the numbers are those of the world again.
    """
    return np.array(_TO_Y_UP[up], dtype=np.float64)


def z_up(up: Axis) -> Array:
    """(3, 3) rotation to z up, as AMASS has it; the identity where z is up."""
    return _Z_FROM_Y @ y_up(up)


def opensim_axes(up: Axis) -> Array:
    """(3, 3) rotation to y up in TRC and C3D: Pose2Sim's, so that the same cameras give the same numbers."""
    return _FORWARD_X @ y_up(up)
