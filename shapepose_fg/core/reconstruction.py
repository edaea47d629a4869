"""The result: the people of every frame, as arrays with one row per person and frame."""

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.result_files import OBSERVATIONS, PEOPLE, RUN, RUN_ID, SavedTable, check_id, write_result
from shapepose_fg.core.rig_file import CAMERAS, is_replaceable, write_rig
from shapepose_fg.core.run_summary import check_run, merged_run
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.skeleton import BODY_25, check_joint_names
from shapepose_fg.core.storage.files import read_json
from shapepose_fg.core.storage.schema import Column, Table


class Status(StrEnum):
    """Status of the reconstruction of one person in one frame."""

    OK = "ok"
    """Joints and body are determined."""
    TOO_FEW_VIEWS = "too few views"
    """No joint is seen by two views, or too few are: the person's place is not determined."""
    BODY_UNDETERMINED = "body undetermined"
    """Joints are determined, but too few of them to fit a body; joints that no view saw are NaN."""
    CONTRADICTED = "views contradict"
    """Some views contradict each other, it is unknown which is wrong, and too few are left without them."""
    NOT_SOLVED = "not solved"
    """A joint diverged from its detections, or nothing determines it: `run` names person, frame and joint."""


class Known(IntEnum):
    """How the position of one joint in one frame is known."""

    UNKNOWN = 0
    """The joint is not placed (NaN); or the file is older than this column."""
    SEEN = 1
    """Two views' detections of the joint were used in this frame that are the person's as far as one can tell
    (`estimation.outcome.how_known`); in files from before `WEAK`, one view's."""
    BODY = 2
    """No detection in this frame: inferred from the body, which other joints place."""
    MOTION = 3
    """Neither: carried by motion from the frames before and after."""
    WEAK = 4
    """Fewer than two such views: a joint that one view saw, or whose detections have a low probability. Body
    and motion contribute as much."""

    @classmethod
    def observed(cls, known: Whole) -> Mask:
        """Return for which joints (...) the detection of at least one view was used."""
        return np.isin(known, (cls.SEEN, cls.WEAK))


BODY = ("betas", "global_orient", "body_pose", "transl")
"""The columns of a result that are a body."""
MOST_NUMBER = 2**53 - 1
"""The highest number of a frame or a person: the last whole number that all real ones below it are."""
_LATER: Any = None
"""Default of a column that is not given: unknown values."""


@dataclass(frozen=True)
class Reconstruction(Table):
    """The people of a recording: N rows, one per person and frame, sorted as they were added."""

    frame: Annotated[Whole, Column("N", np.int64, most=MOST_NUMBER)]
    """(N,) frame of each row, counted from 0 in the file."""
    person: Annotated[Whole, Column("N", np.int64, most=MOST_NUMBER)]
    """(N,) identity of the person; without tracking, a number within the frame."""
    joint_names: Annotated[NDArray[np.str_], Column("J", np.str_)]
    """(J,) names of the joints, as OpenPose writes them."""
    joints: Annotated[Array, Column("N J 3", unit="m", most=1e6)]
    """(N, J, 3) joint positions in the world, metres; NaN where unknown."""
    covariance: Annotated[Array, Column("N J 3 3", unit="m²", most=1e12)]
    """(N, J, 3, 3) covariance of each joint's position, square metres; NaN where unknown."""
    confidence: Annotated[Array, Column("N J", most=1e3)]
    """(N, J) mean confidence of a joint's observations over all views, 0 to 1."""
    betas: Annotated[Array, Column("N 10", most=1e3)]
    """(N, 10) shape of the body, standard deviations; NaN where there is no body."""
    global_orient: Annotated[Array, Column("N 3", unit="rad", most=1e3)]
    """(N, 3) orientation of the pelvis in the world, axis times angle, radians."""
    body_pose: Annotated[Array, Column("N 23 3", unit="rad", most=1e3)]
    """(N, 23, 3) rotation of every other body joint against its parent, axis times angle, radians."""
    transl: Annotated[Array, Column("N 3", unit="m", most=1e6)]
    """(N, 3) translation of the body, metres."""
    status: Annotated[NDArray[np.str_], Column("N", np.str_, stored=f"U{max(map(len, Status))}")]
    """(N,) one of the values of `Status`."""
    time_s: Annotated[Array, Column("N", unit="s", most=1e12, missing=np.nan)] = _LATER
    """(N,) when the row's frame was taken, seconds; NaN where unknown, as it is where the column is not given."""
    velocity: Annotated[Array, Column("N J 3", unit="m/s", most=1e9, missing=np.nan)] = _LATER
    """(N, J, 3) velocity of each joint in the world, m/s; NaN where unknown or not given."""
    velocity_covariance: Annotated[Array, Column("N J 3 3", unit="(m/s)²", most=1e18, missing=np.nan)] = _LATER
    """(N, J, 3, 3) covariance of each joint's velocity, (m/s)²; NaN where unknown or not given."""
    known: Annotated[NDArray[np.uint8], Column("N J", np.uint8, missing=Known.UNKNOWN, codes=Known)] = _LATER
    """(N, J) how each joint is known: codes of `Known`; unknown where not given."""
    run: dict[str, Any] = field(default_factory=dict)
    """Origin of the result: configuration, versions, checksums, times (stored in run.json)."""
    observations: ObservationTable | None = None
    """Detections that each row was solved from (stored in observations.npz); None where they are not recorded."""
    shapes: SubjectShapes | None = None
    """The shape of each identity with its covariance, named by its number; `save` leaves them out."""
    rig: Rig | None = None
    """The cameras that it was solved with, from `reconstruct`; None where unknown. `load` does not read them
    (`read_rig(folder / "cameras.json")`)."""

    ROWS: ClassVar = (
        "frame person time_s joints covariance velocity velocity_covariance known confidence"
        " betas global_orient body_pose transl status".split()
    )

    def __post_init__(self) -> None:
        """Check every shape and type, once, and that `observations` are of these rows."""
        super().__post_init__()
        check_joint_names(self.joint_names.tolist())
        unknown = set(np.unique(self.status).tolist()) - set(Status)
        if len(unknown) > 0:
            raise ValueError(f"status must be one of {[*map(str, Status)]}, got {sorted(unknown)}")
        for name in ("frame", "person", "joint_names") if self.observations is not None else ():
            if not np.array_equal(getattr(self.observations, name), getattr(self, name)):
                raise ValueError(f"observations must have the same {name} as the people (see `relabelled`)")

    @classmethod
    def empty(cls, joint_names: Sequence[str] = BODY_25.joints) -> "Reconstruction":
        """Without people."""
        return cls.without_rows(joint_names=np.array(joint_names))

    @classmethod
    def concatenate(cls, parts: Sequence["Reconstruction"]) -> "Reconstruction":
        """The rows of `parts`, one after the other.

        `run` says what all parts together are (`merged_run`): ValueError where their configurations differ or
        two of them cover the same frame. `observations` are kept where every part that has rows has them, `rig`
        where it is the same of all parts, `shapes` are not.
        """
        if len(parts) == 0:
            return cls.empty()
        filled = [part.observations for part in parts if len(part) > 0]
        tables = [table for table in filled if table is not None]
        together = ObservationTable.concatenate(tables) if 0 < len(tables) == len(filled) else None
        # A part without rows and without a run has nothing to say of the whole.
        runs = [part.run for part in parts if len(part) > 0 or len(part.run) > 0]
        rig = parts[0].rig if all(part.rig is parts[0].rig for part in parts) else None
        return Reconstruction.joined(parts, observations=together, shapes=None, rig=rig, run=merged_run(runs))

    def rows(self, index: NDArray) -> "Reconstruction":
        """The rows that `index` picks: a mask (N,) or row numbers."""
        columns = {name: getattr(self, name)[index] for name in self.ROWS}
        table = None if self.observations is None else self.observations.rows(index)
        return replace(self, **columns, observations=table)

    def check_ranges(self) -> None:
        """ValueError for what no result gives: also for a joint or a body that is called known and is not."""
        super().check_ranges()
        ok, known = self.status == Status.OK, self.known != Known.UNKNOWN
        sure = np.isfinite(self.covariance).all(axis=(2, 3)) | ~ok[:, None]
        for name, wrong in (
            ("joints", (known & ~np.isfinite(self.joints).all(axis=2)).any(axis=1)),
            ("covariance", (known & ~sure).any(axis=1)),
            *((name, ok & ~with_body(getattr(self, name))) for name in BODY),
        ):
            if wrong.any():
                raise ValueError(
                    f"{name} must be numbers where joints are known, but are not in row {wrong.argmax()}"
                )

    def at(self, frame: int) -> "Reconstruction":
        """The people of one frame."""
        return self.rows(self.frame == frame)

    def with_run(self, **entries: Any) -> "Reconstruction":
        """Return these people with further entries in run.json."""
        return replace(self, run=self.run | entries)

    def relabelled(self, person: Whole) -> "Reconstruction":
        """Return these rows with other identities (N,), in `observations` too."""
        table = None if self.observations is None else replace(self.observations, person=person)
        return replace(self, person=person, observations=table)

    def counts(self) -> dict[str, Any]:
        """The entry of run.json about the rows: their number, statuses, and how their joints are known."""
        return count_rows([(self.status, self.known)])

    def save(self, folder: str | Path, rig: Rig | None = None) -> None:
        """Write people.npz, run.json, observations.npz and cameras.json into `folder`, each whole or not at all.

        `rig` are the cameras, by default those that it was solved with (`self.rig`); where neither is known, a
        cameras.json that is there stays. A process killed on the way leaves each file as it was or as it shall be,
        and `load` says where they do not belong together (docs/conventions.md). Without `observations`, those of
        an earlier result are removed. InputError where `load` would refuse them, or cameras.json is another
        program's; OSError where `folder` cannot be written; ValueError where `rig` are not the cameras of the
        observations.
        """
        rig = self.rig if rig is None else rig
        if rig is not None and self.observations is not None:
            names = tuple(self.observations.view_names.tolist())
            if names != rig.names:
                raise ValueError(f"rig must have the cameras of the observations, {names}, got {rig.names}")
        observations = None if self.observations is None else self.observations.columns()
        cameras = Path(folder) / CAMERAS
        if rig is not None and not is_replaceable(cameras):
            raise InputError(
                f"{cameras}: this is not the rig file of a result and would be overwritten; give another folder"
            )
        write_result(Path(folder), self.columns(), observations, self.run, check_files)
        if rig is not None:
            write_rig(rig, cameras)

    @classmethod
    def load(cls, path: str | Path) -> "Reconstruction":
        """Read what `save` wrote: its folder, or the people.npz in it. InputError on anything else.

        `run` is empty where there is no run.json beside it, and `observations` are None where there is no
        observations.npz. Columns that files of earlier versions lack are unknown.
        """
        with cls.open(path) as opened:
            return opened.rows()

    @classmethod
    def open(cls, path: str | Path) -> "OpenedReconstruction":
        """Open the result that `load` reads; its rows come into memory when they are read."""
        return OpenedReconstruction(Path(path))


class OpenedReconstruction(ExitStack):
    """A saved result, open: frames and people are in memory, other columns are read by rows.

    A context manager that closes the files. Reading frames in rising order decompresses the files once. Rows are
    checked as `Reconstruction.load` does; checksums of the files where all rows are read.
    """

    def __init__(self, path: Path) -> None:
        """InputError where there is no result, or its files are of two runs."""
        file = path / PEOPLE if path.is_dir() else path
        table = file.with_name(OBSERVATIONS)
        self._observed: SavedTable[ObservationTable] | None = None
        self._block = range(0), Reconstruction.empty()
        super().__init__()
        try:
            people = SavedTable(file, Reconstruction, "give the people.npz of a reconstruction")
            self._people = self.enter_context(people)
            self.frame, self.person = (self._people.column(name) for name in ("frame", "person"))
            """(N,) frame of each row, and identity of each row's person."""
            self.run = _read_run(file.with_name(RUN), self._people.run_id)
            """Content of run.json."""
            if table.is_file():
                self._observed = self.enter_context(ObservationTable.open(table, self._people.run_id))
        except InputError:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def observed(self) -> bool:
        """Whether the result has the detections that its rows were solved from."""
        return self._observed is not None

    def at(self, frame: int) -> Reconstruction:
        """The people of one frame. The next frames come into memory with it."""
        if frame not in self._block[0]:
            block = range(frame, frame + _BLOCK)
            self._block = block, self.frames(block.start, block.stop)
        return self._block[1].at(frame)

    def frames(self, start: int, stop: int) -> Reconstruction:
        """All people in the frames from `start` to before `stop`."""
        return self.rows(np.flatnonzero((self.frame >= start) & (self.frame < stop)))

    def people(self, numbers: Iterable[int], *, observations: bool = True) -> Reconstruction:
        """These people, in all their frames; see `rows`."""
        return self.rows(np.flatnonzero(np.isin(self.person, list(numbers))), observations=observations)

    def thinned(self, most_rows: int) -> tuple[Reconstruction, int]:
        """Every n-th frame, so that there are at most `most_rows` rows; and n."""
        every = max(1, -(-len(self) // most_rows))
        return self.rows(None if every == 1 else np.flatnonzero(self.frame % every == 0)), every

    def __getattr__(self, name: str) -> Any:
        """A whole column, as `Reconstruction` has it; it is read when it is accessed."""
        if name not in (*Reconstruction.ROWS, "joint_names"):
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
        return self._people.column(name)

    def rows(self, index: NDArray | None = None, *, observations: bool = True) -> Reconstruction:
        """The rows `index`, a mask (N,) or numbers (R,) that rise, or all; with what they were solved from, where
        that is wanted.

        InputError where a file is damaged, or they would not fit in memory.
        """
        index = np.flatnonzero(index) if index is not None and index.dtype == bool else index
        people = self._people.read(index, run=self.run)
        if self._observed is None or not observations:
            return people
        table = self._observed.read(index)
        with naming(self._observed.file, "delete it or run the reconstruction again"):
            return replace(people, observations=table)


def check_files(people: Path, observations: Path | None) -> None:
    """InputError where the files of a result, on the way to their places, could not be read again."""
    with SavedTable(people, Reconstruction, _UNREADABLE) as rows, ExitStack() as opened:
        table = None if observations is None else ObservationTable.open(observations)
        if table is not None:
            opened.enter_context(table)
        for start in range(0, rows.count, _CHECKED_ROWS):
            index = np.arange(start, min(start + _CHECKED_ROWS, rows.count))
            rows.read(index, observations=None if table is None else table.read(index))


_UNREADABLE = "the result was not written, and the previous files are unchanged"
_CHECKED_ROWS = 4096
"""Number of rows that are read at a time to check that a file is readable."""


def _read_run(file: Path, people_id: object) -> dict[str, Any]:
    """Content of run.json, if it is of the run with that id; empty where there is none."""
    run = read_json(file) if file.is_file() else {}
    with naming(file, "restore it or delete it"):
        if not isinstance(run, dict):
            raise ValueError("must hold an object")
        check_run(run)
    check_id(people_id, run.pop(RUN_ID, None), file)
    return run


def with_body(*columns: Array) -> Mask:
    """(N,) which rows have a body: all numbers of their `BODY` columns, each (N, ...), are known."""
    return np.logical_and.reduce([np.isfinite(each).all(axis=tuple(range(1, each.ndim))) for each in columns])


_BLOCK = 128
"""Frames that are read together by `OpenedReconstruction.at`; as many as detections are kept in."""


def count_rows(pieces: Iterable[tuple[NDArray[np.str_], NDArray[np.uint8]]]) -> dict[str, Any]:
    """`Reconstruction.counts` of rows that come piece by piece: `status` (R,) and `known` (R, J) of each."""
    status: Counter[str] = Counter()
    known = np.zeros(len(Known), dtype=np.int64)
    for their_status, their_known in pieces:
        status.update(their_status.tolist())
        known += np.bincount(their_known.ravel(), minlength=len(Known))
    order = (Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION, Known.UNKNOWN)
    joints = {kind.name.lower(): int(known[kind]) for kind in order}
    return {"found": status.total(), "status": dict(status), "joints": joints}


def sigma_m(covariance: Array) -> Array:
    """(...) standard deviation of positions with covariance (..., 3, 3): root mean square over the axes."""
    variance = np.trace(covariance, axis1=-2, axis2=-1) / 3
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(variance >= 0, variance, np.nan))
