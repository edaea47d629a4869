"""The measurements of each row of a result: detections, residuals and gates per joint and view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.result_files import SavedTable, check_id
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import write_npz
from shapepose_fg.core.storage.schema import Column, Table, code_names


class Gate(IntEnum):
    """Whether a detection was used for a joint, and the reason if not."""

    NOT_SEEN = 0
    """The view has no detection for this joint."""
    USED = 1
    """The detection is part of the solution."""
    TOO_FAR = 2
    """Farther than rho_2D from the projected joint (delta_ij = 0 in Eq. 2)."""
    CONTRADICTS_BODY = 3
    """Several views agree on a position that contradicts the rest of the body: the detections
    belong to another person."""
    BEHIND_CAMERA = 4
    """The joint is behind this camera, or nearer than 0.2 m."""
    NOT_PLACED = 5
    """The joint has no position, so the detection cannot be compared with it."""


@dataclass(frozen=True)
class ObservationTable(Table):
    """The detections of N rows (person and frame), J joints and V views; row i is row i of
    people.npz.
    """

    frame: Annotated[Whole, Column("N", np.int64)]
    """(N,) frame of each row."""
    person: Annotated[Whole, Column("N", np.int64)]
    """(N,) identity of the person of each row."""
    joint_names: Annotated[NDArray[np.str_], Column("J", np.str_)]
    """(J,) names of the joints."""
    view_names: Annotated[NDArray[np.str_], Column("V", np.str_)]
    """(V,) names of the cameras."""
    candidate: Annotated[NDArray[np.int32], Column("N J V", np.int32)]
    """(N, J, V) index of the detection among those of its view in this frame; -1 for none, or if
    not recorded."""
    xy: Annotated[NDArray[np.float32], Column("N J V 2", np.float32, "px")]
    """(N, J, V, 2) detection, undistorted pixels; NaN if there is none."""
    confidence: Annotated[NDArray[np.float32], Column("N J V", np.float32, least=0, finite=True)]
    """(N, J, V) score of the detection, 0 to 1; 0 if there is none."""
    residual_px: Annotated[NDArray[np.float32], Column("N J V 2", np.float32, "px", most=1e30)]
    """(N, J, V, 2) projected joint minus detection, pixels; NaN if either is missing."""
    gate: Annotated[NDArray[np.uint8], Column("N J V", np.uint8, codes=Gate)]
    """(N, J, V) codes of `Gate`."""
    probability: Annotated[
        NDArray[np.float32],
        Column("N J V", np.float32, least=0, most=1, finite=True, missing=1.0),
    ] = None  # type: ignore[assignment]
    """(N, J, V) probability that the detection belongs to this person; 0 if there is none, 1 in
    files without this column."""
    lead_s: Annotated[
        NDArray[np.float32], Column("N V", np.float32, "s", finite=True, missing=0.0)
    ] = None  # type: ignore[assignment]
    """(N, V) time at which each view was exposed minus the row's time, seconds; 0 in older
    files."""

    ROWS: ClassVar = (
        "frame person candidate xy confidence residual_px gate probability lead_s".split()
    )

    def __post_init__(self) -> None:
        """Check shapes, types and ranges of values, and that the columns agree on which detections
        exist.
        """
        unsaid = self.probability is None
        super().__post_init__()
        seen = self.gate != Gate.NOT_SEEN
        if unsaid:
            object.__setattr__(self, "probability", seen.astype(np.float32))
        self.check_ranges()
        for name in self.shared():
            if len(set(getattr(self, name).tolist())) < len(getattr(self, name)):
                raise ValueError(f"{name} must differ from each other")
        if not all(map(str.isprintable, self.view_names.tolist())):
            raise ValueError("view_names must be printable, without line breaks")
        # A score may underflow in float32, and the index of the detection may be unknown.
        wrong = {
            "candidate": (self.candidate >= 0) & ~seen,
            "xy": np.isfinite(self.xy).all(axis=-1) != seen,
            "confidence": (self.confidence != 0) & ~seen,
        }
        for name, where in wrong.items():
            if where.any():
                row, joint, view = np.argwhere(where)[0].tolist()
                raise ValueError(
                    f"{name} and gate must agree on what was seen, but do not at row {row},"
                    f" {self.joint_names[joint]}, view {self.view_names[view]}"
                )

    @classmethod
    def of(
        cls,
        observations: Observations,
        place: Whole,
        joints: Array,
        gate: NDArray[np.uint8],
        rig: Rig,
        joint_names: Sequence[str],
        carried: Observations | None = None,
    ) -> "ObservationTable":
        """The table of N solved rows, from their observations and their solved `joints` (N, J, 3),
        metres.

        The rows have the observations' `frame`, and their `track` as `person`. `place` (N, J, V) is
        each detection's `Detections.place`, `gate` (N, J, V) are the codes of `Gate`; missing
        detections, joints without a position and points behind a camera get their own codes,
        independent of `gate`. `carried` are the observations extrapolated to the frames' times, for
        asynchronous views.
        """
        at_frame_times = observations if carried is None else carried
        seen = observations.seen
        if rig.moves:
            projected, depth = Views.of(rig, observations.time_s).pixels(joints)
        else:
            projected, depth = (np.moveaxis(values, 0, 2) for values in rig.project(joints))
        gate = np.where(seen, gate, Gate.NOT_SEEN)
        free = seen & (gate != Gate.USED)
        gate = np.where(free & ~(depth > 0), Gate.BEHIND_CAMERA, gate)
        gate = np.where(free & np.isnan(joints).any(axis=-1, keepdims=True), Gate.NOT_PLACED, gate)
        ahead = np.asarray(seen & (depth > 0))[..., None]
        return cls(
            frame=observations.frame,
            person=observations.track,
            joint_names=np.array(joint_names, dtype=str),
            view_names=np.array(rig.names, dtype=str),
            candidate=np.where(seen, place, -1),
            xy=np.where(seen[..., None], observations.xy, np.nan),
            confidence=np.where(seen, observations.confidence, 0.0),
            residual_px=np.where(ahead, projected - at_frame_times.xy, np.nan),
            gate=gate,
            probability=np.where(seen, observations.probability, 0.0),
            lead_s=observations.time_s - observations.time_s.mean(axis=1, keepdims=True),
        )

    @classmethod
    def empty(
        cls, joint_names: Sequence[str] = BODY_25.joints, view_names: Sequence[str] = ()
    ) -> Self:
        """The table of a result without rows."""
        return cls.without_rows(
            joint_names=np.array(joint_names, str), view_names=np.array(view_names, str)
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of `parts`, one after the other; ValueError if joints or views differ."""
        return super().concatenate(parts) if len(parts) > 0 else cls.empty()

    def observations(self, initial: Array, time_s: Array) -> Observations:
        """The rows as observations, gated detections included, for solving them again.

        `initial` (N, J, 3) are the initial joints, `time_s` (N,) the times of the rows' frames.
        `candidate` is not recovered: `Observations` counts detections over all views, this table in
        each view.
        """
        seen = self.gate != Gate.NOT_SEEN
        return Observations(
            xy=np.where(seen[..., None], self.xy, 0.0).astype(np.float64),
            confidence=np.where(seen, self.confidence, 0.0).astype(np.float64),
            initial=initial,
            track=self.person.astype(np.intp),
            frame=self.frame.astype(np.intp),
            time_s=time_s[:, None] + self.lead_s,
            probability=np.where(seen, self.probability, 1.0).astype(np.float64),
        )

    def unseen(self, frame: Whole) -> "ObservationTable":
        """Rows of the same people, without detections, in other frames: `frame` (N,)."""
        nothing = {
            name: np.full_like(getattr(self, name), np.nan) for name in ("xy", "residual_px")
        }
        nothing |= {
            name: np.zeros_like(getattr(self, name))
            for name in "confidence gate probability lead_s".split()
        }
        return replace(self, **nothing, frame=frame, candidate=np.full_like(self.candidate, -1))

    @property
    def used(self) -> Mask:
        """(N, J, V) which detections are part of the solution."""
        return self.gate == Gate.USED

    def reasons(self) -> dict[str, int]:
        """Number of detections per gate, by the name of the gate; missing detections are not
        counted.
        """
        count = np.bincount(self.gate.ravel(), minlength=len(Gate))
        names = code_names(Gate).tolist()
        return {names[gate]: int(count[gate]) for gate in Gate if gate != Gate.NOT_SEEN}

    def save(self, file: str | Path) -> None:
        """Write the table to `file` atomically; readable with NumPy (docs/results.md)."""
        write_atomically(Path(file), lambda stream: write_npz(stream, self.columns()))

    @classmethod
    def load(cls, file: str | Path, run_id: object = None) -> "ObservationTable":
        """Read a file written by `save`; InputError, one sentence, for any other content.

        `run_id` is that of the people to whom the observations must belong
        (`result_files.check_id`).
        """
        with cls.open(Path(file), run_id) as opened:
            return opened.read(None)

    @classmethod
    def open(cls, file: Path, run_id: object = None) -> "SavedTable[ObservationTable]":
        """Open a file that `load` can read; rows are read into memory only when requested."""
        opened = SavedTable(file, ObservationTable, "give the observations.npz of a reconstruction")
        try:
            check_id(run_id, opened.run_id, file)
        except InputError:
            opened.close()
            raise
        return opened
