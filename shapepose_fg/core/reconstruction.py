"""The result: the people of every frame, as arrays with one row per person and frame."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError, naming, optional
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.result_files import (
    OBSERVATIONS,
    PEOPLE,
    RUN,
    RUN_ID,
    SavedTable,
    check_id,
    write_result,
)
from shapepose_fg.core.rig_file import CAMERAS, is_replaceable, write_rig
from shapepose_fg.core.run_summary import RunEntries, check_frames, merged_run
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.skeleton import BODY_25, check_joint_names
from shapepose_fg.core.storage.files import BLOCK_FRAMES, ROWS_AT_ONCE, read_json
from shapepose_fg.core.storage.schema import Column, Table, code_names
from shapepose_fg.core.validation import validated


class Status(StrEnum):
    """Status of the reconstruction of one person in one frame."""

    OK = "ok"
    """Joints and body are determined."""
    TOO_FEW_VIEWS = "too few views"
    """No joint, or too few joints, are seen by two views: the position of the person is not
    determined."""
    BODY_UNDETERMINED = "body undetermined"
    """Joints are determined, but too few of them to fit a body; joints that no view saw are NaN."""
    CONTRADICTED = "views contradict"
    """Some views contradict each other, it is unknown which is wrong, and the others do not
    determine the person."""
    NOT_SOLVED = "not solved"
    """A joint diverged from its detections, or is not determined: `problems` in `run` names person,
    frame and joint."""


class Known(IntEnum):
    """How the position of one joint in one frame is known."""

    UNKNOWN = 0
    """The joint has no position (NaN), or the file is older than this column."""
    SEEN = 1
    """In this frame, detections of at least two views were used that very probably belong to the
    person (`estimation.window_solution.strong_detections`); in files older than `WEAK`, of at
    least one view."""
    BODY = 2
    """Without a detection in this frame: inferred from the body, which other joints determine."""
    MOTION = 3
    """Without a detection and without a body: interpolated by the motion model from other
    frames."""
    WEAK = 4
    """Detections were used, but not of two views that very probably belong to the person: only one
    view detected the joint, or scores or probabilities are low. Body and motion model contribute
    considerably to its position."""

    @classmethod
    def observed(cls, known: Whole) -> Mask:
        """Return for which joints (...) a detection of at least one view was used."""
        return np.isin(known, (cls.SEEN, cls.WEAK))


BODY = ("betas", "global_orient", "body_pose", "transl")
"""The columns of a result that describe the body."""
_LATER: Any = None
"""Default of a column that is not given: unknown values."""


@dataclass(frozen=True)
class Reconstruction(Table):
    """The people of a recording: N rows, one per person and frame, sorted as they were added."""

    frame: Annotated[Whole, Column("N", np.int64, most=MOST_NUMBER)]
    """(N,) frame of each row, counted from 0 in the file."""
    person: Annotated[Whole, Column("N", np.int64, most=MOST_NUMBER)]
    """(N,) identity of the person; with `temporal = false`, only a number within the frame."""
    joint_names: Annotated[NDArray[np.str_], Column("J", np.str_)]
    """(J,) names of the joints, as OpenPose writes them."""
    joints: Annotated[Array, Column("N J 3", unit="m", most=1e6)]
    """(N, J, 3) joint positions in the world, metres; NaN if unknown."""
    covariance: Annotated[Array, Column("N J 3 3", unit="m²", most=1e12)]
    """(N, J, 3, 3) covariance of each joint's position, square metres; NaN if unknown."""
    confidence: Annotated[Array, Column("N J", most=1e3)]
    """(N, J) mean confidence of a joint's observations over all views, 0 to 1."""
    betas: Annotated[Array, Column("N 10", most=1e3)]
    """(N, 10) shape of the body, standard deviations; NaN without a body."""
    global_orient: Annotated[Array, Column("N 3", unit="rad", most=1e3)]
    """(N, 3) orientation of the pelvis in the world, rotation vector (axis-angle), radians."""
    body_pose: Annotated[Array, Column("N 23 3", unit="rad", most=1e3)]
    """(N, 23, 3) rotation of every other body joint relative to its parent, rotation vector
    (axis-angle), radians."""
    transl: Annotated[Array, Column("N 3", unit="m", most=1e6)]
    """(N, 3) translation of the body, metres."""
    status: Annotated[NDArray[np.str_], Column("N", np.str_, stored=f"U{max(map(len, Status))}")]
    """(N,) one of the values of `Status`."""
    time_s: Annotated[Array, Column("N", unit="s", most=1e12, missing=np.nan)] = _LATER
    """(N,) time of the row's frame, seconds; NaN if unknown (the default)."""
    velocity: Annotated[Array, Column("N J 3", unit="m/s", most=1e9, missing=np.nan)] = _LATER
    """(N, J, 3) velocity of each joint in the world, m/s; NaN if unknown (the default)."""
    velocity_covariance: Annotated[
        Array, Column("N J 3 3", unit="(m/s)²", most=1e18, missing=np.nan)
    ] = _LATER
    """(N, J, 3, 3) covariance of each joint's velocity, (m/s)²; NaN if unknown (the default)."""
    known: Annotated[
        NDArray[np.uint8], Column("N J", np.uint8, missing=Known.UNKNOWN, codes=Known)
    ] = _LATER
    """(N, J) how each joint is known: codes of `Known`; `UNKNOWN` by default."""
    run: dict[str, Any] = field(default_factory=dict)
    """Origin of the result: configuration, versions, checksums, times (stored in run.json)."""
    observations: ObservationTable | None = None
    """Detections that each row was solved from (stored in observations.npz); None if not
    recorded."""
    shapes: SubjectShapes | None = None
    """Body shape and covariance of each identity, named by its number; `save` does not write
    them."""
    rig: Rig | None = None
    """The cameras with which the result was solved, set by `reconstruct`; None if unknown. `load`
    does not read them (`read_rig(folder / "cameras.json")`)."""

    ROWS: ClassVar = (
        "frame person time_s joints covariance velocity velocity_covariance known confidence"
        " betas global_orient body_pose transl status".split()
    )

    def __post_init__(self) -> None:
        """Check shapes and types of all columns, and that `observations` have the same rows."""
        super().__post_init__()
        check_joint_names(self.joint_names.tolist())
        unknown = set(np.unique(self.status).tolist()) - set(Status)
        if len(unknown) > 0:
            raise ValueError(f"status must be one of {[*map(str, Status)]}, got {sorted(unknown)}")
        for name in ("frame", "person", "joint_names") if self.observations is not None else ():
            if not np.array_equal(getattr(self.observations, name), getattr(self, name)):
                raise ValueError(
                    f"observations must have the same {name} as the people (see `relabelled`)"
                )

    @classmethod
    def empty(cls, joint_names: Sequence[str] = BODY_25.joints) -> Self:
        """A result without people."""
        return cls.without_rows(joint_names=np.array(joint_names))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of `parts`, one after the other.

        `run` is merged by `merged_run`: ValueError if configurations differ, or if two parts cover
        the same frame. `observations` are kept if every part with rows has them, `rig` if it is the
        same in all parts; `shapes` are dropped.
        """
        if len(parts) == 0:
            return cls.empty()
        filled = [part.observations for part in parts if len(part) > 0]
        tables = [table for table in filled if table is not None]
        together = ObservationTable.concatenate(tables) if 0 < len(tables) == len(filled) else None
        # A part without rows and without a run does not affect the merged run.
        runs = [part.run for part in parts if len(part) > 0 or len(part.run) > 0]
        rig = parts[0].rig if all(part.rig is parts[0].rig for part in parts) else None
        return super().concatenate(
            parts, observations=together, shapes=None, rig=rig, run=merged_run(runs)
        )

    def rows(self, index: NDArray) -> "Reconstruction":
        """The rows selected by `index`: a mask (N,) or row numbers."""
        columns = {name: getattr(self, name)[index] for name in self.ROWS}
        table = None if self.observations is None else self.observations.rows(index)
        return replace(self, **columns, observations=table)

    def check_ranges(self) -> None:
        """Raise ValueError for impossible values, and for a joint or body that is marked as known
        but is not.
        """
        super().check_ranges()
        ok, known = self.status == Status.OK, self.known != Known.UNKNOWN
        determined = np.isfinite(self.covariance).all(axis=(2, 3)) | ~ok[:, None]
        for name, wrong in (
            ("joints", (known & ~np.isfinite(self.joints).all(axis=2)).any(axis=1)),
            ("covariance", (known & ~determined).any(axis=1)),
            *((name, ok & ~with_body(getattr(self, name))) for name in BODY),
        ):
            if wrong.any():
                raise ValueError(
                    f"{name} must be numbers where joints are known, but are not in row "
                    f"{wrong.argmax()}"
                )

    def at(self, frame: int) -> "Reconstruction":
        """The people of one frame."""
        return self.rows(self.frame == frame)

    def with_run(self, **entries: Any) -> "Reconstruction":
        """Return these people with further `entries` in run.json."""
        return replace(self, run=self.run | entries)

    def relabelled(self, person: Whole) -> "Reconstruction":
        """Return these rows with other identities `person` (N,), also in `observations`."""
        table = None if self.observations is None else replace(self.observations, person=person)
        return replace(self, person=person, observations=table)

    def by_joint(self) -> dict[str, NDArray[Any]]:
        """A row for each joint with a position, sorted by frame, person and joint: frame, time_s,
        person, joint, x_m, y_m, z_m, sigma_m (root mean square), sigma_x_m ..., vx_m_s ..., known,
        confidence.
        """
        row, joint = np.nonzero(np.isfinite(self.joints).all(axis=2))
        order = np.lexsort((joint, self.person[row], self.frame[row]))
        row, joint = row[order], joint[order]
        covariance = self.covariance[row, joint]
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):
            axes = np.sqrt(np.where(variance >= 0, variance, np.nan))
        columns: dict[str, NDArray[Any]] = {
            name: getattr(self, name)[row] for name in ("frame", "time_s", "person")
        }
        columns |= {"joint": self.joint_names[joint]}
        columns |= dict(zip(("x_m", "y_m", "z_m"), self.joints[row, joint].T, strict=True))
        columns |= {"sigma_m": sigma_m(covariance)}
        columns |= dict(zip(("sigma_x_m", "sigma_y_m", "sigma_z_m"), axes.T, strict=True))
        moving = self.velocity[row, joint]
        columns |= dict(zip(("vx_m_s", "vy_m_s", "vz_m_s"), moving.T, strict=True))
        columns |= {"known": code_names(Known)[self.known[row, joint]]}
        return columns | {"confidence": self.confidence[row, joint]}

    def to_frame(self, library: str = "pandas") -> Any:
        """`by_joint` as a DataFrame of pandas or Polars. InputError if that is not installed."""
        return optional(library, "frames").DataFrame(self.by_joint())

    def counts(self) -> dict[str, Any]:
        """The entry of run.json about the rows: their number, and counts of statuses and of how
        joints are known.
        """
        return count_rows([(self.status, self.known)])

    def save(self, folder: str | Path, rig: Rig | None = None) -> None:
        """Write people.npz, run.json, observations.npz and cameras.json into `folder`, each
        atomically.

        `rig` are the cameras, by default `self.rig`; if both are None, an existing cameras.json
        stays. If the process is killed, each file is either the old or the new one, and `load`
        refuses files of different runs (docs/results.md). Without `observations`, those of an
        earlier result are removed. InputError if `load` would refuse the files, or if cameras.json
        belongs to another program; OSError if `folder` cannot be written; ValueError if `rig` does
        not have the cameras of the observations.
        """
        rig = self.rig if rig is None else rig
        if rig is not None and self.observations is not None:
            names = tuple(self.observations.view_names.tolist())
            if names != rig.names:
                raise ValueError(
                    f"rig must have the cameras of the observations, {names}, got {rig.names}"
                )
        observations = None if self.observations is None else self.observations.columns()
        cameras = Path(folder) / CAMERAS
        if rig is not None and not is_replaceable(cameras):
            raise InputError(
                f"{cameras}: this is not the rig file of a result and would be overwritten; give "
                "another folder"
            )
        write_result(Path(folder), self.columns(), observations, self.run, check_files)
        if rig is not None:
            write_rig(rig, cameras)

    @classmethod
    def load(cls, path: str | Path) -> "Reconstruction":
        """Read a result that `save` wrote; `path` is its folder, or the people.npz in it.
        InputError for any other content.

        `run` is empty without a run.json beside it, and `observations` are None without an
        observations.npz. Columns that are missing in files of earlier versions have unknown values.
        """
        with cls.open(path) as opened:
            return opened.rows()

    @classmethod
    def open(cls, path: str | Path) -> "OpenedReconstruction":
        """Open a result that `load` can read; rows are read into memory only when requested."""
        return OpenedReconstruction(Path(path))


class OpenedReconstruction(ExitStack):
    """An opened result: the columns `frame` and `person` are in memory, others are read row by row.

    As a context manager, it closes the files. If frames are read in increasing order, the files are
    decompressed only once. Rows are checked as by `Reconstruction.load`; checksums of the files
    only if all rows are read.
    """

    def __init__(self, path: Path) -> None:
        """Open the result `path`; InputError if there is none, or if its files are of two runs."""
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
                self._observed = self.enter_context(
                    ObservationTable.open(table, self._people.run_id)
                )
        except InputError:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def observed(self) -> bool:
        """Whether the result has the detections from which its rows were solved."""
        return self._observed is not None

    def at(self, frame: int) -> Reconstruction:
        """The people of one frame. The following frames are read into memory together with it."""
        if frame not in self._block[0]:
            block = range(frame, frame + BLOCK_FRAMES)
            self._block = block, self.frames(block.start, block.stop)
        return self._block[1].at(frame)

    def frames(self, start: int, stop: int) -> Reconstruction:
        """All people in the frames `start` to `stop` - 1."""
        return self.rows(np.flatnonzero((self.frame >= start) & (self.frame < stop)))

    def people(self, numbers: Iterable[int], *, observations: bool = True) -> Reconstruction:
        """All rows of the people with these `numbers`; see `rows`."""
        return self.rows(
            np.flatnonzero(np.isin(self.person, list(numbers))), observations=observations
        )

    def thinned(self, most_rows: int) -> tuple[Reconstruction, int]:
        """Every n-th frame, with n so large that there are at most `most_rows` rows; and n."""
        every = max(1, -(-len(self) // most_rows))
        return self.rows(None if every == 1 else np.flatnonzero(self.frame % every == 0)), every

    def __getattr__(self, name: str) -> Any:
        """A whole column, as in `Reconstruction`; it is read on access."""
        if name not in (*Reconstruction.ROWS, "joint_names"):
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
        return self._people.column(name)

    def rows(self, index: NDArray | None = None, *, observations: bool = True) -> Reconstruction:
        """The rows `index`: a mask (N,), increasing row numbers (R,), or all; with their
        observations, unless `observations` is False.

        InputError if a file is damaged, or if the rows would not fit in memory.
        """
        index = np.flatnonzero(index) if index is not None and index.dtype == bool else index
        people = self._people.read(index, run=self.run)
        if self._observed is None or not observations:
            return people
        table = self._observed.read(index)
        with naming(self._observed.file, "delete it or run the reconstruction again"):
            return replace(people, observations=table)


def check_files(people: Path, observations: Path | None) -> None:
    """Raise InputError if these new files of a result, before they are moved to their places,
    cannot be read.
    """
    with SavedTable(people, Reconstruction, _UNREADABLE) as rows, ExitStack() as opened:
        table = None if observations is None else ObservationTable.open(observations)
        if table is not None:
            opened.enter_context(table)
        for start in range(0, rows.count, ROWS_AT_ONCE):
            index = np.arange(start, min(start + ROWS_AT_ONCE, rows.count))
            rows.read(index, observations=None if table is None else table.read(index))


_UNREADABLE = "the result was not written, and the previous files are unchanged"


def _read_run(file: Path, people_id: object) -> dict[str, Any]:
    """The content of run.json, empty if there is none. InputError if it is invalid, or belongs to
    another run.
    """
    run, cure = read_json(file) if file.is_file() else {}, "restore it or delete it"
    validated(RunEntries, run, file, cure)
    with naming(file, cure):
        check_frames(run)
        try:
            json.dumps(run, allow_nan=False)
        except ValueError:
            raise ValueError("a number in it is not finite, or too large") from None
    check_id(people_id, run.pop(RUN_ID, None), file)
    return run


def with_body(*columns: Array) -> Mask:
    """(N,) mask of the rows with a body: all values of the `BODY` columns, (N, ...), are finite."""
    return np.logical_and.reduce(
        [np.isfinite(each).all(axis=tuple(range(1, each.ndim))) for each in columns]
    )


def count_rows(pieces: Iterable[tuple[NDArray[np.str_], NDArray[np.uint8]]]) -> dict[str, Any]:
    """`Reconstruction.counts` of rows that are given in pieces: `status` (R,) and `known` (R, J) of
    each.
    """
    status: Counter[str] = Counter()
    known = np.zeros(len(Known), dtype=np.int64)
    for their_status, their_known in pieces:
        status.update(their_status.tolist())
        known += np.bincount(their_known.ravel(), minlength=len(Known))
    order = (Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION, Known.UNKNOWN)
    joints = {kind.name.lower(): int(known[kind]) for kind in order}
    return {"found": status.total(), "status": dict(status), "joints": joints}


def sigma_m(covariance: Array) -> Array:
    """(...) standard deviation of positions with covariance (..., 3, 3): root mean square over
    the axes.
    """
    variance = np.trace(covariance, axis1=-2, axis2=-1) / 3
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.where(variance >= 0, variance, np.nan))
