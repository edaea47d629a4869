"""What each row of a result was solved from: per joint and view the detection, its residual, and its gate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.columns import check_codes, checked, code_names
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.result_files import check_id
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz_writer import Column, write_npz
from shapepose_fg.core.storage.saved_table import SavedTable

_CURE = "give the observations.npz of a reconstruction"


class Gate(IntEnum):
    """Whether a detection was used for a joint, and why not."""

    NOT_SEEN = 0
    """The view has no detection for this joint."""
    USED = 1
    """The detection is part of the solution."""
    TOO_FAR = 2
    """Farther than rho_2D from the projected joint (delta_ij = 0 in Eq. 2)."""
    CONTRADICTS_BODY = 3
    """Views agree on a place where the rest of the body cannot have the joint: they saw somebody else's."""
    BEHIND_CAMERA = 4
    """The joint is behind this camera, or nearer than 0.2 m."""
    NOT_PLACED = 5
    """The joint itself could not be placed: there is nothing to compare the detection with."""


_LATER: Any = None
"""In place of a column that is not given."""


@dataclass(frozen=True)
class ObservationTable:
    """The detections of N rows (person and frame), J joints and V views; row i is row i of people.npz."""

    frame: NDArray[np.int64]
    """(N,) frame of each row."""
    person: NDArray[np.int64]
    """(N,) identity of the person of each row."""
    joint_names: NDArray[np.str_]
    """(J,) names of the joints."""
    view_names: NDArray[np.str_]
    """(V,) names of the cameras."""
    candidate: NDArray[np.int32]
    """(N, J, V) which detection: its place among all those of its view in this frame; -1 for none, or not said."""
    xy: NDArray[np.float32]
    """(N, J, V, 2) where the detection lies, undistorted pixels; NaN where there is none."""
    confidence: NDArray[np.float32]
    """(N, J, V) the detector's score, 0 to 1; 0 where there is none."""
    residual_px: NDArray[np.float32]
    """(N, J, V, 2) projected joint minus detection, pixels; NaN where there is none, or no joint to project."""
    gate: NDArray[np.uint8]
    """(N, J, V) codes of `Gate`."""
    probability: NDArray[np.float32] = _LATER
    """(N, J, V) how probable it is that the detection is this person's, and nobody else's; 0 where there is none.
    1 where it is not said, as in files of before."""

    ROWS: ClassVar = "frame person candidate xy confidence residual_px gate probability".split()
    """The columns that have one entry per row."""

    def __post_init__(self) -> None:
        """Check every shape and type, once; and that a detection is there or not in all columns alike."""
        N, J, V = np.size(self.frame), np.size(self.joint_names), np.size(self.view_names)
        columns = {"frame": ((N,), np.int64), "person": ((N,), np.int64)}
        columns |= {"joint_names": ((J,), np.str_), "view_names": ((V,), np.str_)}
        columns |= {"candidate": ((N, J, V), np.int32), "xy": ((N, J, V, 2), np.float32)}
        columns |= {"confidence": ((N, J, V), np.float32), "residual_px": ((N, J, V, 2), np.float32)}
        columns |= {"gate": ((N, J, V), np.uint8), "probability": ((N, J, V), np.float32)}
        if self.probability is None:
            object.__setattr__(self, "probability", np.asarray(self.gate != Gate.NOT_SEEN, dtype=np.float32))
        for name, (shape, dtype) in columns.items():
            object.__setattr__(self, name, checked(name, getattr(self, name), shape, dtype))
        check_codes("gate", self.gate, Gate)
        self._check_values()
        seen = self.gate != Gate.NOT_SEEN
        # A score may be too small for a float32, and which detection it was need not be said.
        wrong = {
            "candidate": (self.candidate >= 0) & ~seen,
            "xy": np.isfinite(self.xy).all(axis=-1) != seen,
            "confidence": (self.confidence != 0) & ~seen,
        }
        for name, where in wrong.items():
            if where.any():
                row, joint, view = np.argwhere(where)[0].tolist()
                raise ValueError(
                    f"{name} and gate must agree on what was seen, at row {row}, {self.joint_names[joint]},"
                    f" view {self.view_names[view]} they do not"
                )

    def _check_values(self) -> None:
        """ValueError for scores that are none, errors without end, and two cameras or joints of one name."""
        if not ((self.confidence >= 0) & np.isfinite(self.confidence)).all():
            raise ValueError("confidence must be 0 or more")
        if not ((self.probability >= 0) & (self.probability <= 1)).all():
            raise ValueError("probability must be 0 to 1")
        if np.isinf(self.residual_px).any():
            raise ValueError("residual_px must be finite, or NaN where there is none")
        for name in ("joint_names", "view_names"):
            if len(set(getattr(self, name).tolist())) < len(getattr(self, name)):
                raise ValueError(f"{name} must differ from each other")

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of(
        cls,
        observations: Observations,
        place: NDArray[np.integer],
        joints: NDArray[np.float64],
        gate: NDArray[np.uint8],
        rig: Rig,
        *,
        frame: NDArray[np.integer],
        person: NDArray[np.integer],
        joint_names: Sequence[str],
    ) -> "ObservationTable":
        """The table of N solved rows: what they observed, and where their `joints` (N, J, 3) came to lie.

        `place` (N, J, V) is each detection's place among those of its view (`place_in_view`), `gate` (N, J, V)
        the codes of `Gate`; what was not seen is recorded as that, whatever is there, and what was not used
        because the joint is not placed, or behind the camera, as that.
        """
        seen = observations.seen
        projected, depth = (np.moveaxis(values, 0, 2) for values in rig.project(joints))
        gate = np.where(seen, gate, Gate.NOT_SEEN)
        free = seen & (gate != Gate.USED)
        gate = np.where(free & ~(depth > 0), Gate.BEHIND_CAMERA, gate)
        gate = np.where(free & np.isnan(joints).any(axis=-1, keepdims=True), Gate.NOT_PLACED, gate)
        ahead = np.asarray(seen & (depth > 0))[..., None]
        return cls(
            frame=frame.astype(np.int64),
            person=person.astype(np.int64),
            joint_names=np.array(joint_names, dtype=str),
            view_names=np.array(rig.names, dtype=str),
            candidate=np.where(seen, place, -1).astype(np.int32),
            xy=np.where(seen[..., None], observations.xy, np.nan).astype(np.float32),
            confidence=np.where(seen, observations.confidence, 0.0).astype(np.float32),
            residual_px=np.where(ahead, projected - observations.xy, np.nan).astype(np.float32),
            gate=gate.astype(np.uint8),
            probability=np.where(seen, observations.probability, 0.0).astype(np.float32),
        )

    @classmethod
    def empty(
        cls, joint_names: Sequence[str] = BODY_25.joints, view_names: Sequence[str] = ()
    ) -> "ObservationTable":
        """The table of a result without rows."""
        J, V = len(joint_names), len(view_names)
        none = np.zeros(0, dtype=np.int64)
        return cls(
            frame=none,
            person=none,
            joint_names=np.array(joint_names, dtype=str),
            view_names=np.array(view_names, dtype=str),
            candidate=np.zeros((0, J, V), dtype=np.int32),
            xy=np.zeros((0, J, V, 2), dtype=np.float32),
            confidence=np.zeros((0, J, V), dtype=np.float32),
            residual_px=np.zeros((0, J, V, 2), dtype=np.float32),
            gate=np.zeros((0, J, V), dtype=np.uint8),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["ObservationTable"]) -> "ObservationTable":
        """The rows of `parts`, one after the other; ValueError where joints or views differ."""
        if len(parts) == 0:
            return cls.empty()
        first = parts[0]
        for part in parts:
            for name in ("joint_names", "view_names"):
                if not np.array_equal(getattr(part, name), getattr(first, name)):
                    raise ValueError(f"parts must have the same {name}")
        return replace(
            first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.ROWS}
        )

    def rows(self, index: NDArray[Any]) -> "ObservationTable":
        """The rows that `index` picks: a mask (N,) or row numbers."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.ROWS})

    def observations(self, initial: NDArray[np.float64], time_s: NDArray[np.float64]) -> Observations:
        """The rows as they were given to be solved, dropped detections too: to solve them anew.

        `initial` (N, J, 3) is where to begin, `time_s` (N,) when the rows' frames were taken. Which detection each
        observation was is not told: there a view's detections are counted over all views, here in their own.
        """
        seen = self.gate != Gate.NOT_SEEN
        return Observations(
            xy=np.where(seen[..., None], self.xy, 0.0).astype(np.float64),
            confidence=np.where(seen, self.confidence, 0.0).astype(np.float64),
            initial=initial,
            track=self.person.astype(np.intp),
            frame=self.frame.astype(np.intp),
            time_s=np.repeat(time_s[:, None], len(self.view_names), axis=1),
            probability=np.where(seen, self.probability, 1.0).astype(np.float64),
        )

    @property
    def used(self) -> NDArray[np.bool_]:
        """(N, J, V) which detections are part of the solution."""
        return self.gate == Gate.USED

    def reasons(self) -> dict[str, int]:
        """How many detections have each gate, in words; those that were not seen are left out."""
        count = np.bincount(self.gate.ravel(), minlength=len(Gate))
        names = code_names(Gate).tolist()
        return {names[gate]: int(count[gate]) for gate in Gate if gate != Gate.NOT_SEEN}

    def columns(self) -> dict[str, Column]:
        """What observations.npz holds."""
        arrays = {name: getattr(self, name) for name in (*self.ROWS, "joint_names", "view_names")}
        return {name: Column.of(array) for name, array in (arrays | {"gate_names": code_names(Gate)}).items()}

    def save(self, file: str | Path) -> None:
        """Write the table as `file`, whole or not at all; NumPy alone reads it (docs/conventions.md)."""
        write_atomically(Path(file), lambda stream: write_npz(stream, self.columns()))

    @classmethod
    def load(cls, file: str | Path, run_id: object = None) -> "ObservationTable":
        """Read what `save` wrote; InputError, one sentence, on anything else.

        `run_id` is that of the people whose observations they must be (`result_files.check_id`).
        """
        opened = cls.open(Path(file), run_id)
        try:
            return cls(**opened.columns(None))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{file}: {error}; {_CURE}") from None
        finally:
            opened.close()

    @classmethod
    def open(cls, file: Path, run_id: object = None) -> SavedTable:
        """What `load` reads, of which rows come into memory when they are asked for."""
        opened = SavedTable(
            file,
            rows=cls.ROWS,
            shared=("joint_names", "view_names"),
            code_names={"gate_names": code_names(Gate)},
            added={"probability"},
            cure=_CURE,
        )
        try:
            check_id(run_id, opened.run_id, file)
        except InputError:
            opened.close()
            raise
        return opened


def place_in_view(candidate: NDArray[np.integer], view: NDArray[np.integer]) -> NDArray[np.int32]:
    """Detections counted among those of their own view, from where they are counted over all views of a frame.

    `candidate` of any shape holds rows of the frame's `Detections`, -1 for none (and stays so); `view` (D,) is
    `Detections.view`.
    """
    order = np.argsort(view, kind="stable")
    first = np.searchsorted(view[order], view[order])
    # One more place, at the end: what -1 leads to.
    place = np.full(len(view) + 1, -1, dtype=np.int32)
    place[order] = np.arange(len(view)) - first
    return place[candidate]
